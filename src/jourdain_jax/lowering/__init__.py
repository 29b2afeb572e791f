"""Lowering: a scene's equations as a short scalar program.

    scene -> jaxpr -> graph of scalars -> elimination of dependent speeds -> normal forms -> straight-line code

It removes structural zeros and ones, which XLA cannot remove from products of dense matrices, and
coordinates without influence.
"""
