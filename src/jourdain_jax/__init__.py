"""Differentiable dynamics of holonomic and nonholonomic mechanical systems, by Jourdain's principle of
virtual power.

Importing this package switches JAX to 64-bit floats, unless the environment variable JAX_ENABLE_X64 is 0. If
JAX has not computed anything yet, the import also

- requests at least 16 threads on the CPU, unless PJRT_NPROC or NPROC is set;
- lets XLA compile a small loop on the CPU into one function, unless XLA_FLAGS contains
  `xla_backend_extra_options`.

Public names are imported on first use; `__init__.pyi` lists them.
"""

import os as _os

import jax as _jax
import lazy_loader as _lazy_loader

if _os.environ.get("JAX_ENABLE_X64", "1").lower() not in ("0", "false", "off"):
    _jax.config.update("jax_enable_x64", True)

# A batched LAPACK call of jaxlib 0.10 waits, in a thread of the pool, for work that is queued on the same
# pool. If all threads make such calls, they wait for ever (observed with two cores and batches of a few
# thousand). jaxlib 0.11 no longer splits batches.
if not {"PJRT_NPROC", "NPROC"} & _os.environ.keys():
    _os.environ["PJRT_NPROC"] = str(max(16, _os.cpu_count() or 1))

# By default, XLA compiles a loop into one function only if its body touches less than 1 kB. Otherwise it
# starts each operation of the body separately, which takes ten times as long as the arithmetic of a step (a
# motion of one disc takes 2.9 ms, with this option 0.22 ms).
if "xla_backend_extra_options" not in _os.environ.get("XLA_FLAGS", ""):
    _option = "--xla_backend_extra_options=xla_cpu_small_while_loop_byte_threshold=1048576"
    _os.environ["XLA_FLAGS"] = f"{_os.environ.get('XLA_FLAGS', '')} {_option}".strip()

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
