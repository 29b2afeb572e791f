"""Quantities at one state: accelerations, constraint forces, power, and the equations reduced by ignorable
coordinates.

They need the findings of `structure`, so they stand above `equations`. Open `accelerations.py` first.
"""
