"""Scenes from SymPy's mechanics, URDF and MJCF files.

`urdf.py` and `mjcf.py` read files into a tree of links (`tree.py`), from which `tree_scene.py` makes a scene.
Open `tree_scene.py` first, or `sympy_scene.py`.
"""
