"""Integration of a motion: our loop over steps and its adjoint, explicit and implicit methods, events, knots
of the inputs.
"""
