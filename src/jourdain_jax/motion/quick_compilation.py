"""A function compiled with options of XLA that save compile time where they cost no running time.

XLA's newer fusion emitters on the CPU take up to twice as long to compile a scalar program of thousands of operations, for code that is no faster
(measured: one motion of a bicycle, 5.0 s against 3.1 s; in batches of dense matrices they are faster, so these are left alone).
"""

from collections.abc import Callable
from functools import lru_cache
from typing import Any

import equinox as eqx
import jax
from jax.extend.core import get_opaque_trace_state

_OPTIONS: dict[str, Any] = {"xla_cpu_use_fusion_emitters": False}
MOST_STRUCTURES = 1024  # of arguments, arrays left out, for which one function is kept compiled
_RUN_SELDOM: dict[str, Any] = _OPTIONS | {"xla_backend_optimization_level": 0}


def compiled(f: Callable, **options) -> Callable:
    """As `equinox.filter_jit`, at a tenth of its costs per call; what was compiled is dropped with the function that is returned. `options`: of `jax.jit`."""

    @lru_cache(maxsize=MOST_STRUCTURES)
    def program(treedef, others) -> Callable:
        def on_arrays(arrays):
            found, kept = _parted(f(*_whole(arrays, treedef, others)))
            return found, _Kept(kept)

        on_arrays.__name__ = getattr(f, "__name__", "on_arrays")
        return jax.jit(on_arrays, **options)

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
    are = [eqx.is_array(x) for x in leaves]
    return [x for x, is_one in zip(leaves, are, strict=True) if is_one], (
        treedef,
        tuple(_AN_ARRAY if is_one else x for x, is_one in zip(leaves, are, strict=True)),
    )


def _whole(arrays, treedef, rest):
    """The tree of these parts."""
    left = iter(arrays)
    return jax.tree.unflatten(treedef, [next(left) if x is _AN_ARRAY else x for x in rest])


def quickly_compiled(f: Callable, compiler: Callable = compiled, run_seldom: bool = False) -> Callable:
    """`f`, compiled by `compiler`; on a CPU with the quick options, but for calls inside another transformation: JAX takes options of whole programs only.

    `run_seldom`: what `f` costs is its compilation.
    """
    plain, quick = compiler(f), compiler(f, compiler_options=_RUN_SELDOM if run_seldom else _OPTIONS)

    def run(*arguments):
        return (quick if jax.default_backend() == "cpu" and nothing_is_traced() else plain)(*arguments)

    return run


def nothing_is_traced() -> bool:
    """Whether this call stands outside of every transformation: no function around it is being traced, and so no argument."""
    return get_opaque_trace_state(convention="flax") == _NOTHING_TRACED


with jax.ensure_compile_time_eval():
    _NOTHING_TRACED = get_opaque_trace_state(convention="flax")
