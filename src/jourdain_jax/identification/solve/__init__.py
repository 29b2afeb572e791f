"""The objective of a fit and its minimum.

    layout, unknowns, body_inertia, ties   the meaning of the numbers of a vector theta
    run_residuals, run_groups              Jacobian and residuals [J r] of all runs, compiled per structure
    problem, loss                          F(theta) and its derivatives
    arrow                                  the linearised problem, run by run
    levenberg_marquardt                    steps within bounds
    shooting, piecewise                    runs that are cut into pieces

Open `problem.py` first.
"""
