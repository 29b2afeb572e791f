"""Lower the equations of motion of a scene to a short scalar program.

    scene -> jaxpr -> graph of scalars -> elimination of the constraints -> normal forms -> straight-line code

Lowering removes structural zeros and ones, which XLA would keep in products of dense matrices, and
coordinates that have no effect. Open `lower.py` first, then `appell.py` and `partial_velocities.py`.
"""
