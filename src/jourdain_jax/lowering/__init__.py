"""Lowering: a scene's equations as a short scalar program.

    scene -> jaxpr -> graph of scalars -> elimination of the constraints -> normal forms -> straight-line code

This removes structural zeros and ones, which XLA keeps in products of dense matrices, and coordinates on
which nothing depends. Open `lower.py` first, then `appell.py` and `partial_velocities.py`.
"""
