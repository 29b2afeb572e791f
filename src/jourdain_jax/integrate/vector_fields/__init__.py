"""The integrated rates: one `VectorField` in three forms, by a scalar program, or by dense matrices in the
minimal or the full state. Open `field.py` first.
"""
