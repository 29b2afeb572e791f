"""Scenes imported from SymPy's mechanics, URDF and MJCF files."""
