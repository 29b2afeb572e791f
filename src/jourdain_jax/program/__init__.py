"""Scalar programs: a graph of expressions, its derivatives and normal forms, its values, and code
generated from it.

    jaxpr -> `interpret.py` -> `graph.py` -> `derivative.py`, `polynomial.py`
          -> `emit.py` (JAX), `evaluate.py` (NumPy), `source.py` (Python, C, SymPy)

`eager.py` evaluates a traced function on NumPy without compilation, for a single evaluation. Nodes are
immutable; add operations to `graph.py` and `calculus/scalar_operations.py` together. Open `graph.py` first.
"""
