"""Uncertainty of a fit, and densities of the same runs: `information.py` (covariance), `standard_errors.py`
(intervals, profiles), `likelihood.py`, `log_density.py`, `filtering.py`. Open `information.py` first.
"""
