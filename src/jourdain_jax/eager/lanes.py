"""A traced function run on NumPy, one operation after another: for one set of arguments, or for many lanes at once, traced for one of them.

With JAX's `vmap` of what was traced in its place, a first result took 7 % longer (tilting disc, bicycle), and 32 trailers were lowered in 4.0 s of processor
time in place of 1.9: every number of lanes would be traced by itself.
An array has an axis of lanes first, or none where all lanes share it. Primitives without a rule here run lane by lane.
"""

from collections.abc import Callable
from functools import lru_cache, wraps
from typing import NamedTuple

import jax
import numpy as np

from jourdain_jax.calculus.jaxprs import called, evaluated, needed_only
from jourdain_jax.eager.indexing import gathered
from jourdain_jax.eager.numpy_backend import ENTRYWISE, RULES_WITH_LANES, applied, linear_solve


class _Value(NamedTuple):
    array: np.ndarray
    by_lane: bool  # whether it has an axis of lanes, the first one


def uncompiled(f: Callable) -> Callable:
    """`f`, of trees of arrays, run on NumPy; also while something else is being traced."""
    return uncompiled_lanes(f, shared=None)


def uncompiled_lanes(f: Callable, shared: int | None = 0) -> Callable:
    """`f`, of trees of arrays of one lane, run on NumPy for arrays with an axis of lanes first.

    The first `shared` arguments are those of all lanes; None: all are, and there are no lanes.
    """

    @lru_cache(maxsize=64)
    def traced(treedef, shapes):
        arrays = [jax.ShapeDtypeStruct(shape, jax.dtypes.canonicalize_dtype(dtype)) for shape, dtype in shapes]
        closed, shape = jax.make_jaxpr(f, return_shape=True)(*jax.tree.unflatten(treedef, arrays))
        return needed_only(closed), jax.tree.structure(shape)

    @wraps(f)
    def run(*arguments):
        leaves, treedef = jax.tree.flatten(arguments)
        without = len(jax.tree.leaves(arguments[:shared]))
        arrays = [np.asarray(x) for x in leaves]
        closed, structure = traced(treedef, tuple((x.shape[i >= without :], x.dtype) for i, x in enumerate(arrays)))
        with np.errstate(all="ignore"):
            if without == len(arrays):
                return jax.tree.unflatten(structure, evaluated(closed, arrays, applied))
            count = len(arrays[without])
            found = _run(closed, [_Value(x, i >= without) for i, x in enumerate(arrays)], count)
        return jax.tree.unflatten(structure, [_of_all(x, count) for x in found])

    return run


def _run(closed, arguments: list[_Value], count: int) -> list[_Value]:
    return evaluated(closed, arguments, lambda equation, inputs: _applied(equation, inputs, count), lambda x, aval: _Value(np.asarray(x, aval.dtype), False))


def _applied(equation, inputs: list[_Value], count: int) -> list[_Value]:
    """Results of an equation."""
    if not any(x.by_lane for x in inputs):
        return [_Value(x, False) for x in applied(equation, [x.array for x in inputs])]
    name, params = equation.primitive.name, equation.params
    inner = called(name, params)
    if inner is not None:
        return _run(inner, inputs, count)
    if name == "cond" and not inputs[0].by_lane:
        return _run(params["branches"][int(inputs[0].array)], inputs[1:], count)
    if name == "custom_linear_solve":
        return _run(*linear_solve(params, inputs), count)
    found = None
    if name in ENTRYWISE and name != "unvmap_any":
        found = np.asarray(ENTRYWISE[name](*_aligned(equation, inputs)), equation.outvars[0].aval.dtype)
    elif name in RULES_WITH_LANES:
        found = RULES_WITH_LANES[name](equation, 1, *(_of_all(x, count) for x in inputs))
    elif name == "gather":
        found = _gather(equation, *(_of_all(x, count) for x in inputs))
    if found is None:
        found = _one_by_one(equation, inputs, count)
    return [_Value(x, True) for x in (found if isinstance(found, list) else [found])]


def _one_by_one(equation, inputs: list[_Value], count: int) -> list[np.ndarray]:
    lanes = [applied(equation, [x.array[k] if x.by_lane else x.array for x in inputs]) for k in range(count)]
    return [np.stack(x) for x in zip(*lanes, strict=True)]


def _of_all(x: _Value, count: int) -> np.ndarray:
    return x.array if x.by_lane else np.broadcast_to(x.array, (count, *x.array.shape))


def _aligned(equation, inputs: list[_Value]) -> list[np.ndarray]:
    """The inputs with as many axes after that of the lanes: a scalar may stand beside arrays."""
    most = max(v.aval.ndim for v in equation.invars)
    axes = [(1,) * (most - v.aval.ndim) for v in equation.invars]
    pairs = zip(inputs, axes, strict=True)
    return [x.array.reshape((*x.array.shape[: x.by_lane], *more, *x.array.shape[x.by_lane :])) if more else x.array for x, more in pairs]


def _gather(equation, x, indices):
    """What is gathered, by its places where those are the same in all lanes and lie in the array."""
    if np.any(indices != indices[:1]):
        return None
    places = np.asarray(gathered(equation, np.arange(x[0].size).reshape(x.shape[1:]), indices[0]))
    if places.dtype.kind != "i" or np.any(places < 0) or np.any(places >= x[0].size):
        return None
    return x.reshape(len(x), -1)[:, places]
