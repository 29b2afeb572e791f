"""Identification of parameters from measurements: `fit`, its uncertainty and its report.

    data       what was measured: experiments, sensors, channels, first guesses and priors
    solve      residuals of all runs, F(theta) = sum rho(w) + sum n log sigma + priors, and its minimum
    inference  how well the minimum is known: covariance, intervals, densities, filters
    report     `Fit`: values, warnings, text and page

A motion enters only through `solve/runs.py`. Open `fit.py` first.
"""
