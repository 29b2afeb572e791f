"""Evaluation of traced functions on NumPy without compilation, for single evaluations.

In a copy of this code with XLA at its quickest in its place (optimisation level 0), a first result took 67 % longer for a tilting disc and 63 % for a bicycle
(`bench/compile_time.py`): comparing a scalar program with dense matrices means running what is never run again.
"""
