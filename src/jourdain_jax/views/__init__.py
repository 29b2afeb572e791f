"""Pictures of motions: quantities against time, bodies in space (matplotlib), and 3D views for a browser.

Nothing here changes a motion. Open `quantities.py` first, or `show.py` with the page in `viewer`.
"""
