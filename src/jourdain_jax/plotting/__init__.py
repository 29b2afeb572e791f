"""Pictures of motions: quantities against time, bodies in space (by matplotlib, the extra `plot`), and 3D views for a browser."""
