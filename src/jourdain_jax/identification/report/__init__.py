"""Results of a fit: `Fit` with its warnings and text, its page, and fits that are resumed.

Open `fit_result.py` first.
"""
