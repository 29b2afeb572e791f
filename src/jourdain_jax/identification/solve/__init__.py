"""The objective of a fit and its minimum.

    layout, unknowns, body_inertia         the meaning of the numbers of a vector theta
    shooting, run_groups                   Jacobian and residuals [J r] of all runs, compiled per structure
    problem                                F(theta) and its derivatives
    arrow                                  the linearised problem, run by run
    levenberg_marquardt                    losses, and steps within bounds
    shooting, piecewise                    runs that are cut into pieces

Open `problem.py` first.
"""
