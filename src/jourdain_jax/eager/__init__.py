"""Evaluation on NumPy: a second, slow way of running what JAX traced, for what is looked at once."""
