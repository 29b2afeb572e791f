"""Motions in JAX, from the source of a step (`motion/native/step.py`), where machine code is not available.
"""
