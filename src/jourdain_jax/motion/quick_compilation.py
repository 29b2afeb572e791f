"""A function compiled with options of XLA that save compile time where they cost no running time.

XLA's newer fusion emitters on the CPU take up to twice as long to compile a scalar program of thousands of operations, for code that is no faster
(measured: one motion of a bicycle, 5.0 s against 3.1 s; in batches of dense matrices they are faster, so these are left alone).
"""

from collections.abc import Callable
from functools import lru_cache
from typing import Any

import equinox as eqx
import jax
import jaxlib.version

from jourdain_jax.calculus.reals import is_array_type, nothing_is_traced

# From jaxlib 0.11.1 on, XLA has these emitters alone.
QUICK: dict[str, Any] = {"xla_cpu_use_fusion_emitters": False} if jaxlib.version.__version_info__ < (0, 11, 1) else {}
RUN_SELDOM: dict[str, Any] = QUICK | {"xla_backend_optimization_level": 0}  # where a function's costs are those of its compilation
MOST_STRUCTURES = 1024  # of arguments, arrays left out, for which one function is kept compiled


def compiled(f: Callable, compiler_options: dict | Callable | None = None) -> Callable:
    """As `equinox.filter_jit`, at a tenth of its costs per call; what was compiled is dropped with the function that is returned.

    `compiler_options`: as of `jax.jit`, or a function that chooses them, called once for arguments of one structure, with a mark in place of each array.
    """

    @lru_cache(maxsize=MOST_STRUCTURES)
    def program(treedef, others) -> Callable:
        def on_arrays(arrays):
            found, kept = _parted(f(*_whole(arrays, treedef, others)))
            return found, _Kept(kept)

        on_arrays.__name__ = getattr(f, "__name__", "on_arrays")
        chosen = compiler_options(*jax.tree.unflatten(treedef, others)) if callable(compiler_options) else compiler_options
        return jax.jit(on_arrays, compiler_options=chosen)

    def run(*arguments):
        arrays, structure = _parted(arguments)
        found, kept = program(*structure)(arrays)
        return _whole(found, *kept.value)

    return run


class _Kept(eqx.Module):
    """What is no array in what a compiled function returns."""

    value: tuple = eqx.field(static=True)


_AN_ARRAY = object()


def _parted(tree) -> tuple[list, tuple]:
    """The arrays of a tree, and what is left of it."""
    leaves, treedef = jax.tree.flatten(tree)
    return [x for x in leaves if is_array_type(type(x))], (treedef, tuple([_AN_ARRAY if is_array_type(type(x)) else x for x in leaves]))


def _whole(arrays, treedef, rest):
    """The tree of these parts."""
    left = iter(arrays)
    return jax.tree.unflatten(treedef, [next(left) if x is _AN_ARRAY else x for x in rest])


def quickly_compiled(f: Callable, compiler: Callable = compiled, options: dict | Callable = QUICK) -> Callable:
    """`f`, compiled by `compiler`; on a CPU with these options, but for calls inside another transformation: JAX takes options of whole programs only.

    `options`: as the compiler takes them.
    """
    plain, quick = compiler(f), compiler(f, compiler_options=options)

    def run(*arguments):
        return (quick if jax.default_backend() == "cpu" and nothing_is_traced() else plain)(*arguments)

    return run
