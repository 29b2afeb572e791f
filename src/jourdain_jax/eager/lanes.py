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
from jourdain_jax.eager.numpy_backend import ENTRYWISE, RULES, applied, traced_for_use


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
    rule = _LANES.get(name)
    found = None
    if name in ENTRYWISE and name != "unvmap_any":
        found = np.asarray(ENTRYWISE[name](*_aligned(equation, inputs)), equation.outvars[0].aval.dtype)
    elif rule is not None:
        found = rule(equation, *(_of_all(x, count) for x in inputs))
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


def _reshaped(equation, x, *dynamic):
    return x.reshape(len(x), *equation.outvars[0].aval.shape)


def _broadcast_in_dim(equation, x, *dynamic):
    shape = [1] * len(equation.params["shape"])
    for axis, place in enumerate(equation.params["broadcast_dimensions"]):
        shape[place] = x.shape[1 + axis]
    return np.broadcast_to(x.reshape(len(x), *shape), (len(x), *equation.params["shape"]))


def _slice(equation, x):
    p = equation.params
    return x[(slice(None), *(slice(*s) for s in zip(p["start_indices"], p["limit_indices"], p["strides"] or (1,) * (x.ndim - 1), strict=True)))]


def _dot_general(equation, a, b):
    (over_a, over_b), (batch_a, batch_b) = [[tuple(i + 1 for i in part) for part in pair] for pair in equation.params["dimension_numbers"]]
    free_a = [i for i in range(1, a.ndim) if i not in (*over_a, *batch_a)]
    free_b = [i for i in range(1, b.ndim) if i not in (*over_b, *batch_b)]
    batch = [len(a), *(a.shape[i] for i in batch_a)]
    contracted = int(np.prod([a.shape[i] for i in over_a]))
    left = np.transpose(a, (0, *batch_a, *free_a, *over_a)).reshape(*batch, int(np.prod([a.shape[i] for i in free_a])), contracted)
    right = np.transpose(b, (0, *batch_b, *over_b, *free_b)).reshape(*batch, contracted, int(np.prod([b.shape[i] for i in free_b])))
    return _reshaped(equation, left @ right)


def _select(equation, which, *cases):
    if len(cases) != 2:
        return None
    which = which.reshape(*which.shape, *(1,) * (cases[0].ndim - which.ndim))
    return np.where(np.asarray(which, bool), cases[1], cases[0])


def _gather(equation, x, indices):
    """By the places of what is taken, where those are the same in all lanes and lie in the array."""
    if np.any(indices != indices[:1]):
        return None
    places = np.asarray(RULES["gather"](equation, np.arange(x[0].size).reshape(x.shape[1:]), indices[0]))
    if places.dtype.kind != "i" or np.any(places < 0) or np.any(places >= x[0].size):
        return None
    return x.reshape(len(x), -1)[:, places]


def _reduced(function: Callable, of_nothing=None) -> Callable:
    def reduced(equation, x):
        start = {} if of_nothing is None or x.dtype.kind != "f" else {"initial": of_nothing}
        return np.asarray(function(x, axis=tuple(i + 1 for i in equation.params["axes"]), **start), equation.outvars[0].aval.dtype)

    return reduced


_LANES: dict[str, Callable] = {
    **dict.fromkeys(("reshape", "squeeze", "expand_dims"), _reshaped),
    **{name: RULES[name] for name in ("integer_pow", "lu", "cholesky", "svd")},
    "broadcast_in_dim": _broadcast_in_dim,
    "slice": _slice,
    "dot_general": _dot_general,
    "select_n": _select,
    "gather": _gather,
    "triangular_solve": lambda e, *x: None if e.params["conjugate_a"] else RULES["triangular_solve"](e, *x),
    "transpose": lambda e, x: np.transpose(x, (0, *(i + 1 for i in e.params["permutation"]))),
    "concatenate": lambda e, *xs: np.concatenate(xs, axis=e.params["dimension"] + 1),
    "stack": lambda e, *xs: np.stack(xs, axis=e.params["axis"] + 1),
    "unstack": lambda e, x: list(np.moveaxis(x, e.params["axis"] + 1, 0)),
    "split": lambda e, x: np.split(x, np.cumsum(e.params["sizes"])[:-1], axis=e.params["axis"] + 1),
    "reduce_sum": _reduced(np.sum),
    "reduce_max": _reduced(np.max, -np.inf),
    "reduce_min": _reduced(np.min, np.inf),
    "reduce_and": _reduced(np.bitwise_and.reduce),
    "reduce_or": _reduced(np.bitwise_or.reduce),
}
