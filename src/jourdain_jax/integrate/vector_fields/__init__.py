"""The rates that are integrated: a `VectorField` by a scalar program, or by dense matrices with the minimal
or the full state. Open `field.py` first.
"""
