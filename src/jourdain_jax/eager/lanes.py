"""A function traced for one lane, run on NumPy for many at once.

With JAX's `vmap` of what was traced in its place, a first result took 7 % longer (tilting disc, bicycle), and 32 trailers were lowered in 4.0 s of processor
time in place of 1.9: every number of lanes would be traced by itself.
An array has an axis of lanes first, or none where all lanes share it. Primitives without a rule here run lane by lane.
"""

from collections.abc import Callable
from functools import lru_cache, wraps
from typing import NamedTuple

import jax
import numpy as np
from jax.extend.core import Literal

from jourdain_jax.calculus.jaxprs import called
from jourdain_jax.eager.indexing import gathered
from jourdain_jax.eager.numpy_backend import ENTRYWISE, RULES_WITH_LANES, applied, traced_for_use


class _Value(NamedTuple):
    array: np.ndarray
    by_lane: bool  # whether it has an axis of lanes, the first one


def uncompiled_lanes(f: Callable, shared: int = 0) -> Callable:
    """`f`, of trees of arrays of one lane, run on NumPy for arrays with an axis of lanes first; the first `shared` arguments are those of all lanes."""

    @lru_cache(maxsize=64)
    def traced(treedef, shapes):
        return traced_for_use(f, jax.tree.unflatten(treedef, [jax.ShapeDtypeStruct(*s) for s in shapes]))

    @wraps(f)
    def run(*arguments):
        leaves, treedef = jax.tree.flatten(arguments)
        without = len(jax.tree.leaves(arguments[:shared]))
        values = [_Value(np.asarray(x), i >= without) for i, x in enumerate(leaves)]
        count = len(values[without].array)
        closed, shape = traced(treedef, tuple((x.array.shape[x.by_lane :], x.array.dtype) for x in values))
        with np.errstate(all="ignore"):
            found = _run(closed, values, count)
        return jax.tree.unflatten(jax.tree.structure(shape), [_of_all(x, count) for x in found])

    return run


def _run(closed, arguments: list[_Value], count: int) -> list[_Value]:
    jaxpr = closed.jaxpr
    values = {v: _Value(np.asarray(x), False) for v, x in zip(jaxpr.constvars, closed.consts, strict=True)} | dict(zip(jaxpr.invars, arguments, strict=True))
    for equation in jaxpr.eqns:
        inputs = [_Value(np.asarray(x.val, x.aval.dtype), False) if isinstance(x, Literal) else values[x] for x in equation.invars]
        if any(x.by_lane for x in inputs):
            results = _applied(equation, inputs, count)
        else:
            results = [_Value(x, False) for x in applied(equation, [x.array for x in inputs])]
        values |= zip(equation.outvars, results, strict=True)
    return [_Value(np.asarray(x.val, x.aval.dtype), False) if isinstance(x, Literal) else values[x] for x in jaxpr.outvars]


def _applied(equation, inputs: list[_Value], count: int) -> list[_Value]:
    """Results of an equation of which some inputs differ from lane to lane."""
    name, params = equation.primitive.name, equation.params
    inner = called(name, params)
    if inner is not None:
        return _run(inner, inputs, count)
    if name == "cond" and not inputs[0].by_lane:
        return _run(params["branches"][int(inputs[0].array)], inputs[1:], count)
    if name == "custom_linear_solve":
        lengths = params["const_lengths"]
        of_solve = inputs[lengths.matvec + lengths.vecmat :][: lengths.solve]
        return _run(params["jaxprs"].solve, [*of_solve, *inputs[sum(lengths) :]], count)
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
