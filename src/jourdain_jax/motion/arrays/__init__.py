"""The source of a step (`motion/native/step.py`) run on arrays of JAX: motions of what has no scalar program, or no machine code."""
