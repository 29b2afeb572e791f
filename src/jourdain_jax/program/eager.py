"""Functions that are traced and evaluated in NumPy, operation by operation.

A first call takes a tenth of the time of a compilation.
"""

from collections.abc import Callable
from functools import lru_cache, wraps
from inspect import signature
from typing import TypeVar

import equinox as eqx
import jax
import numpy as np

from jourdain_jax.calculus.jaxprs import evaluated, needed_only
from jourdain_jax.calculus.reals import described, has_unit, is_traced
from jourdain_jax.program.numpy_backend import applied

F = TypeVar("F", bound=Callable)


def eval_numpy(f: Callable) -> Callable:
    """Run `f` uncompiled on concrete arguments and return NumPy arrays, even during another trace.

    `lanes`: further arguments with a leading batch axis; `f` receives one sample of each.
    """

    @lru_cache(maxsize=32)
    def program(treedef, rest, x64):
        return uncompiled_lanes(
            lambda numbers, *lane: f(*eqx.combine(numbers, jax.tree.unflatten(treedef, rest)), *lane),
            shared=1,
        )

    @wraps(f)
    def run(*arguments, lanes=()):
        arguments = jax.tree.map(_as_known, arguments)
        numbers, others = eqx.partition(arguments, eqx.is_array)
        rest, treedef = jax.tree.flatten(others, is_leaf=lambda x: x is None)
        return program(treedef, tuple(rest), jax.config.jax_enable_x64)(numbers, *lanes)

    vars(run)["cache_clear"] = program.cache_clear
    return run


def _as_known(x):
    """Return a number as a NumPy array, and any other value unchanged. Booleans are unchanged, because they
    decide which code is traced.

    **Raises** ValueError for a quantity with a unit.
    """
    if has_unit(x):
        raise ValueError(f"an argument is {described(x)}, expected real numbers; give numbers in SI units")
    return np.asarray(x) if eqx.is_array_like(x) and not isinstance(x, bool) else x


def eager_if_concrete(f: F) -> F:
    """Run `f` uncompiled if its arguments are concrete, which makes a first call at a prompt ten times
    faster. Otherwise trace it as usual.

    Inside `f` the scene's numbers are traced, so choices that depend on them (rank, independent speeds) must
    be arguments.
    """
    known, parameters = eval_numpy(f), signature(f)

    @wraps(f)
    def run(*given, **named):
        bound = parameters.bind(*given, **named)
        bound.apply_defaults()
        arguments = bound.args
        return f(*arguments) if is_traced(arguments) else jax.device_put(known(*arguments))

    vars(run)["cache_clear"] = vars(known)["cache_clear"]
    return run  # type: ignore[return-value]


def uncompiled_lanes(f: Callable, shared: int | None = 0) -> Callable:
    """Run `f`, a function of trees of arrays, in NumPy over a leading batch axis.

    All samples share the first `shared` arguments (None: all of them, without a batch axis).
    """

    @lru_cache(maxsize=64)
    def traced(treedef, shapes, first: int = 0, count: int = 0):
        arrays = _arrays(
            [
                ((count,) * (i >= first and count > 0) + shape, dtype)
                for i, (shape, dtype) in enumerate(shapes)
            ]
        )

        def one(*leaves):
            return f(*jax.tree.unflatten(treedef, leaves))

        def of_all(*leaves):
            axes = [None if i < first else 0 for i in range(len(leaves))]
            return jax.vmap(one, axes)(*leaves) if count else one(*leaves)

        def one_by_one(*leaves):  # for callbacks that take one sample at a time
            return jax.lax.map(lambda lane: one(*leaves[:first], *lane), leaves[first:])

        try:
            closed, shape = jax.make_jaxpr(of_all, return_shape=True)(*arrays)
        except NotImplementedError:
            closed, shape = jax.make_jaxpr(one_by_one, return_shape=True)(*arrays)
        return needed_only(closed), jax.tree.structure(shape)

    @wraps(f)
    def run(*arguments):
        leaves, treedef = jax.tree.flatten(arguments)
        first = len(jax.tree.leaves(arguments[:shared]))
        arrays = [np.asarray(x) for x in leaves]
        shapes = tuple((x.shape[i >= first :], x.dtype) for i, x in enumerate(arrays))
        batch = (first, len(arrays[first])) if first < len(arrays) else ()
        closed, structure = traced(treedef, shapes, *batch)
        with np.errstate(all="ignore"):
            return jax.tree.unflatten(structure, evaluated(closed, arrays, applied))

    return run


def _arrays(shapes) -> list[jax.ShapeDtypeStruct]:
    return [jax.ShapeDtypeStruct(shape, jax.dtypes.canonicalize_dtype(dtype)) for shape, dtype in shapes]
