"""Scenes from SymPy's mechanics, URDF and MJCF files.

Files are read by `urdf.py` and `mjcf.py` (geoms: `mjcf_geoms.py`) into a tree of links (`tree.py`), of which `tree_scene.py` makes a
scene. Open `tree_scene.py` first, or `sympy_scene.py`.
"""
