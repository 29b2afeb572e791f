"""Motions on arrays of JAX, by the source of a step (`motion/native/step.py`), where there is no machine code."""
