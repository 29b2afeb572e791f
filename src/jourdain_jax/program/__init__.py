"""Scalar programs: a graph of expressions with derivatives, normal forms, NumPy evaluation and code
generation.
"""
