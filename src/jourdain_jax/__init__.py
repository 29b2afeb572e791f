"""Differentiable dynamics of holonomic and nonholonomic mechanical systems, by Jourdain's principle of
virtual power.

Importing this package switches JAX to 64-bit floats, unless the environment variable JAX_ENABLE_X64 is 0, and
changes nothing else. The first use of a public name or package that computes then calls `configure` with its
defaults, if JAX has not computed anything yet.

Public names are imported on first use; `__init__.pyi` lists them.
"""

import os as _os

import jax as _jax
import lazy_loader as _lazy_loader

if _os.environ.get("JAX_ENABLE_X64", "1").lower() not in ("0", "false", "off"):
    _jax.config.update("jax_enable_x64", True)

from jourdain_jax.calculus.lazy_imports import module_on_first_use as _module_on_first_use
from jourdain_jax.calculus.lazy_imports import version_of as _version_of
from jourdain_jax.scene.printing import show_scenes_with as _show_scenes_with

_public, __dir__, __all__ = _lazy_loader.attach_stub(__name__, __file__)
_GONE = {
    "Built": "it is `Model`, which `build` returns",
    "MuntheKaas": (
        "the default solvers renormalise quaternions after each step; they are as accurate and take "
        "half of the time"
    ),
}
_MOVED = ("identification", "studies", "equations", "analysis")


def __getattr__(name: str) -> object:
    """Import a public name. Raise an AttributeError for other names, with the new place of a former name."""
    if name in __all__:
        return _public(name)
    places = [
        f"it is `jj.{place}.{name}`" for place in _MOVED if name[:1] != "_" and name in _public(place).__all__
    ]
    advice = _GONE.get(name, "".join(places))
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}" + f": {advice}" * bool(advice))


_pictures = _module_on_first_use("jourdain_jax.views.pictures")
_show_scenes_with(lambda scene: _pictures.scene_picture(scene))
__version__ = _version_of("jourdain-jax")
