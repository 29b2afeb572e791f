"""Quantities at one state: accelerations, constraint forces, power, and the equations reduced by ignorable
coordinates.

They need the results of `structure`, so they are not in `equations`. Open `accelerations.py` first.
"""
