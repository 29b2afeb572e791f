"""A traced function run on NumPy, one operation after another: for one set of arguments, or for a batch, by
JAX's `vmap`.
"""

from collections.abc import Callable
from functools import lru_cache, wraps

import jax
import numpy as np

from jourdain_jax.calculus.jaxprs import evaluated, needed_only
from jourdain_jax.eager.numpy_backend import applied


def uncompiled_lanes(f: Callable, shared: int | None = 0) -> Callable:
    """`f`, of trees of arrays of one lane, run on NumPy for arrays with an axis of lanes first.

    The first `shared` arguments are those of all lanes; None: all are, and there are no lanes.
    """

    @lru_cache(maxsize=64)
    def traced(treedef, shapes, first: int = 0, count: int = 0):
        arrays = _arrays([((count,) * (i >= first and count > 0) + shape, dtype) for i, (shape, dtype) in enumerate(shapes)])

        def one(*leaves):
            return f(*jax.tree.unflatten(treedef, leaves))

        def of_all(*leaves):
            return jax.vmap(one, [None if i < first else 0 for i in range(len(leaves))])(*leaves) if count else one(*leaves)

        def one_by_one(*leaves):  # callbacks that take one lane at a time
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
        closed, structure = traced(treedef, shapes, first, len(arrays[first])) if first < len(arrays) else traced(treedef, shapes)
        with np.errstate(all="ignore"):
            return jax.tree.unflatten(structure, evaluated(closed, arrays, applied))

    return run


def _arrays(shapes) -> list[jax.ShapeDtypeStruct]:
    return [jax.ShapeDtypeStruct(shape, jax.dtypes.canonicalize_dtype(dtype)) for shape, dtype in shapes]
