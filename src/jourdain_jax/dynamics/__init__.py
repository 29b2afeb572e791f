"""Quantities at one state: accelerations, constraint forces, power, and the equations reduced by ignorable
coordinates.

They use the findings of `structure`, so this package is above `equations`. Open `accelerations.py` first.
"""
