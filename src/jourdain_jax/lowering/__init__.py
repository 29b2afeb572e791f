"""Lowering: a scene's equations as a short scalar program.

    scene -> jaxpr -> graph of scalars -> elimination of the constraints -> normal forms -> straight-line code

Structural zeros and ones, which XLA cannot remove from products of dense matrices, vanish here; so do
coordinates on which nothing depends. Open `lower.py` first, then `appell.py`.
"""
