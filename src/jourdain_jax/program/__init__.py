"""Scalar programs: a graph of expressions, derivatives and normal forms on it, its values on NumPy arrays, and code from it."""
