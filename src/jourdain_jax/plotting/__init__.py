"""Pictures of motions: quantities against time, bodies in space (by matplotlib, the extra `plot`), and 3D views for a browser."""

from jourdain_jax.plotting.scene_picture import scene_svg
from jourdain_jax.scene.printing import show_scenes_with

show_scenes_with(scene_svg)
