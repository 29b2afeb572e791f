"""Evaluation of traced functions with NumPy, without compilation.

Replacing it by XLA at optimisation level 0 lengthened a first result by 67 % for a tilting disc and 63 % for
a bicycle (`bench/compile_time.py`): checking a scalar program against dense matrices would compile code that
runs only once.
"""
