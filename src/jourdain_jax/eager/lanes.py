"""A traced function run on NumPy, one operation after another: for one set of arguments, or for many lanes at once, by JAX's `vmap`."""

from collections.abc import Callable
from functools import lru_cache, wraps

import jax
import numpy as np
from jax.extend.core import jaxpr_as_fun

from jourdain_jax.calculus.jaxprs import evaluated, needed_only
from jourdain_jax.eager.numpy_backend import applied


def uncompiled_lanes(f: Callable, shared: int | None = 0) -> Callable:
    """`f`, of trees of arrays of one lane, run on NumPy for arrays with an axis of lanes first.

    The first `shared` arguments are those of all lanes; None: all are, and there are no lanes.
    """

    @lru_cache(maxsize=64)
    def traced(treedef, shapes, first: int = 0, count: int = 0):
        if not count:
            closed, shape = jax.make_jaxpr(f, return_shape=True)(*jax.tree.unflatten(treedef, _arrays(shapes)))
            return needed_only(closed), jax.tree.structure(shape)
        closed, structure = traced(treedef, shapes)
        one = jaxpr_as_fun(closed)
        arrays = _arrays([(shape if i < first else (count, *shape), dtype) for i, (shape, dtype) in enumerate(shapes)])
        axes = [None if i < first else 0 for i in range(len(shapes))]
        try:
            return jax.make_jaxpr(jax.vmap(one, in_axes=axes))(*arrays), structure
        except NotImplementedError:  # callbacks that take one lane at a time
            return jax.make_jaxpr(lambda *x: jax.lax.map(lambda lane: one(*x[:first], *lane), x[first:]))(*arrays), structure

    @wraps(f)
    def run(*arguments):
        leaves, treedef = jax.tree.flatten(arguments)
        first = len(jax.tree.leaves(arguments[:shared]))
        arrays = [np.asarray(x) for x in leaves]
        shapes = tuple((x.shape[i >= first :], x.dtype) for i, x in enumerate(arrays))
        closed, structure = traced(treedef, shapes, first, len(arrays[first])) if first < len(arrays) else traced(treedef, shapes)
        with np.errstate(all="ignore"):
            return jax.tree.unflatten(structure, evaluated(closed, arrays, applied))

    return run


def _arrays(shapes) -> list[jax.ShapeDtypeStruct]:
    return [jax.ShapeDtypeStruct(shape, jax.dtypes.canonicalize_dtype(dtype)) for shape, dtype in shapes]
