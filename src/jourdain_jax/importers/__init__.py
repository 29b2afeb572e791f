"""Scenes from what other tools write: SymPy's mechanics, URDF and MJCF files."""
