"""Pictures of motions: quantities against time, bodies in space. Needs the extra `plot` (matplotlib)."""
