"""Compiled functions with a tenth of the overhead of `equinox.filter_jit`, and with options of XLA where compiling takes longer than running."""

from collections.abc import Callable
from functools import lru_cache
from typing import Any

import equinox as eqx
import jax
import jaxlib.version

from jourdain_jax.calculus.reals import is_array_type, nothing_is_traced

# Where a function's costs are those of its compilation. Before jaxlib 0.11.1, XLA's new emitters can be left out: a first motion of a disc
# from kept object code then takes 1.55 s in place of 1.75; later versions have these emitters alone.
_EMITTERS: dict[str, Any] = {"xla_cpu_use_fusion_emitters": False} if jaxlib.version.__version_info__ < (0, 11, 1) else {}
RUN_SELDOM = {"xla_backend_optimization_level": 0} | _EMITTERS


def compiled(f: Callable, options: dict | Callable | None = None) -> Callable:
    """Compile as `equinox.filter_jit` does; compiled programs live as long as the returned function.

    `options`: for XLA on a CPU, or a function that chooses them, called once for arguments of one structure with a mark in place of each array. They have
    no effect in calls inside another transformation: JAX takes options of whole programs only.
    """

    @lru_cache(maxsize=1024)  # structures of arguments, arrays left out
    def program(treedef, others, with_options: bool) -> Callable:
        def on_arrays(arrays):
            found, kept = _parted(f(*_whole(arrays, treedef, others)))
            return found, _Kept(kept)

        on_arrays.__name__ = getattr(f, "__name__", "on_arrays")
        chosen = options(*jax.tree.unflatten(treedef, others)) if callable(options) else options
        return jax.jit(on_arrays, compiler_options=chosen if with_options else None)

    def run(*arguments):
        arrays, structure = _parted(arguments)
        with_options = options is not None and jax.default_backend() == "cpu" and nothing_is_traced()
        found, kept = program(*structure, with_options)(arrays)
        return _whole(found, *kept.value)

    vars(run)["cache_clear"] = program.cache_clear
    return run


class _Kept(eqx.Module):
    """The parts of a result that are no arrays."""

    value: tuple = eqx.field(static=True)


_AN_ARRAY = object()


def _parted(tree) -> tuple[list, tuple]:
    """Split a tree into its arrays and the rest."""
    leaves, treedef = jax.tree.flatten(tree)
    return [x for x in leaves if is_array_type(type(x))], (treedef, tuple([_AN_ARRAY if is_array_type(type(x)) else x for x in leaves]))


def _whole(arrays, treedef, rest):
    """Put a tree together from its parts."""
    left = iter(arrays)
    return jax.tree.unflatten(treedef, [next(left) if x is _AN_ARRAY else x for x in rest])
