"""Measured bicycles: parameter files, linear stability and its uncertainty."""
