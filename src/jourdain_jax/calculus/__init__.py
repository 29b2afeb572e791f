"""Mathematics without physics: rotations, pseudo-inverses, Newton's method, derivative rules of JAX.

Also utilities for all packages: checks of numbers, files, imports on first use, inspection of functions.
Nothing here knows a scene. Open `reals.py` first (numbers from users), then `derivatives.py` (rules for
both modes).
"""
