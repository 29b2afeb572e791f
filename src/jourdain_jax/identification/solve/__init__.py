"""The objective of a fit and its minimum.

    layout, unknowns   which numbers a vector theta stands for      runs      [J r] of all runs, compiled once per structure
    problem            F(theta) and its derivatives                 arrow     the linearised problem, run by run
    levenberg_marquardt   steps within bounds                       shooting, piecewise   runs that are cut into pieces

Open `problem.py` first.
"""
