"""Uncertainty of a fit, and probability densities of its runs.

    information, planned_information    covariance of a fit, and of a plan
    standard_errors                     intervals, and sigmas that are estimated
    bound_limits                        intervals by profiles, and at bounds
    likelihood, log_density, correlated_noise    densities of measurements

Open `information.py` first.
"""
