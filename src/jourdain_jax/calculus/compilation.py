"""Compilation with little overhead per call, and JAX's default modes.

Compiled functions have a tenth of the overhead of `equinox.filter_jit`, and cheaper XLA options where
compiling takes longer than running. Inside the package, JAX's default promotion of types and ranks applies
even if the user has set stricter modes.
"""

from collections.abc import Callable
from functools import lru_cache, partial, wraps
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.extend.core
import jaxlib.version

from jourdain_jax.calculus.configuration import configure_by_default
from jourdain_jax.calculus.progress import announced
from jourdain_jax.calculus.reals import is_array_type, nothing_is_traced

configure_by_default()  # every module that computes imports this one

F = TypeVar("F", bound=Callable)


def with_usual_promotion(function: F) -> F:
    """Return `function` wrapped so that it always runs and is traced with JAX's default type promotion."""

    @wraps(function)
    def called(*args, **kwargs):
        with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
            return function(*args, **kwargs)

    return called  # type: ignore[return-value]


# For functions whose cost is mostly compilation. Before jaxlib 0.11.1, XLA's new emitters can be disabled: a
# first motion of a disc from cached object code then takes 1.55 s instead of 1.75. Later versions have only
# these emitters.
_EMITTERS: dict[str, Any] = (
    {"xla_cpu_use_fusion_emitters": False} if jaxlib.version.__version_info__ < (0, 11, 1) else {}
)
RUN_SELDOM = {"xla_backend_optimization_level": 0} | _EMITTERS


def compiled(f: Callable, options: dict | Callable | None = None) -> Callable:
    """Compile like `equinox.filter_jit`; compiled programs live as long as the returned function.

    `options`: XLA options for CPUs, or a function that returns them. The function is called once per
    structure of arguments, with a placeholder for each array. Inside another transformation options are
    ignored, because JAX accepts them only for whole programs.
    """

    name = getattr(f, "__name__", "on_arrays")

    @lru_cache(maxsize=1024)  # structures of arguments without arrays
    def program(treedef, others, with_options: bool) -> Callable:
        def on_arrays(arrays):
            found, kept = _parted(f(*_whole(arrays, treedef, others)))
            return found, _Kept(kept)

        on_arrays.__name__ = name
        chosen = options(*jax.tree.unflatten(treedef, others)) if callable(options) else options
        return jax.jit(on_arrays, compiler_options=chosen if with_options else None)

    def run(*arguments):
        arrays, structure = _parted(arguments)
        with_options = options is not None and jax.default_backend() == "cpu" and nothing_is_traced()
        known = program.cache_info().misses
        call = program(*structure, with_options)
        if program.cache_info().misses == known:
            found, kept = call(arrays)
        else:
            with announced(f"compiling `{name.strip('_')}` by XLA"):
                found, kept = call(arrays)
        return _whole(found, *kept.value)

    vars(run)["cache_clear"] = program.cache_clear
    return run


compiled_quickly = partial(compiled, options=RUN_SELDOM)


class _Kept(eqx.Module):
    """Static parts of a result."""

    value: tuple = eqx.field(static=True)


_AN_ARRAY = object()


def _parted(tree) -> tuple[list, tuple]:
    """Split a tree into its arrays and the rest."""
    leaves, treedef = jax.tree.flatten(tree)
    others = tuple([_AN_ARRAY if is_array_type(type(x)) else x for x in leaves])
    return [x for x, other in zip(leaves, others, strict=True) if other is _AN_ARRAY], (treedef, others)


def _whole(arrays, treedef, rest):
    """Rebuild a tree from its parts."""
    left = iter(arrays)
    return jax.tree.unflatten(treedef, [next(left) if x is _AN_ARRAY else x for x in rest])


def nan_is_a_mark():
    """Return a context in which `jax_debug_nans` is off, for computations that mark failures by NaN."""
    return jax.debug_nans(False)


def with_nan_as_a_mark(f: F) -> F:
    """Return `f` wrapped to run with `jax_debug_nans` off."""

    @wraps(f)
    def run(*arguments, **named):
        if not jax.config.jax_debug_nans:
            return f(*arguments, **named)
        with nan_is_a_mark():
            return f(*arguments, **named)

    return run  # type: ignore[return-value]
