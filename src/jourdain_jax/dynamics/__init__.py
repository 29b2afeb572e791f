"""Quantities at one state: accelerations, constraint forces, power, and the equations reduced by ignorable
coordinates.
"""
