"""Results of a fit: `Fit` with its statistics, warnings, text and page, and fits that are resumed.

Open `fit_result.py` first.
"""
