"""Textbook scenes, and their registry by name.

A new model is a class in a module about its kind, a line in `__init__.pyi`, and a name in `registry.py`.
Open `discs.py` first.
"""

import lazy_loader as _lazy_loader

__getattr__, __dir__, __all__ = _lazy_loader.attach_stub(__name__, __file__)
