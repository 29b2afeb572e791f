"""JAX primitives on NumPy arrays. A single evaluation takes less time than a compilation.

Primitives without a rule here run one by one in JAX, which takes tens of milliseconds each to compile.
"""

import os
from collections.abc import Callable
from pathlib import Path

import jax
import numpy as np

from jourdain_jax.calculus.jaxprs import called, evaluated, parts_of_scan
from jourdain_jax.calculus.markers import MAPS
from jourdain_jax.calculus.scalar_operations import VALUES
from jourdain_jax.program.entry_places import gathered, scattered

MOST_TURNS = 5000  # tuning: iteration limit of a `while_loop`, beyond which it counts as endless
_NOT_THE_USERS = (str(Path(__file__).parents[1]), f"{os.sep}site-packages{os.sep}")


def applied(equation, inputs) -> list[np.ndarray]:
    """Return the results of one equation of a jaxpr."""
    name, params = equation.primitive.name, equation.params
    inner = called(name, params)
    if inner is not None:
        return evaluated(inner, inputs, applied)
    if name in _CONTROL:
        return _CONTROL[name](equation, inputs)
    if name in _ENTRYWISE:
        with_type = _ENTRYWISE[name](*inputs)
        return [np.asarray(with_type, equation.outvars[0].aval.dtype)]
    if name in RULES:
        result = RULES[name](equation, *inputs)
        if result is not None:
            return result if isinstance(result, list) else [result]
    with jax.ensure_compile_time_eval():
        result = equation.primitive.bind(*inputs, **params)
    return [np.asarray(x) for x in (result if equation.primitive.multiple_results else [result])]


# Control flow: all values are known, so branches are taken and loops are run.


def _scan(equation, inputs) -> list[np.ndarray]:
    params, (fixed, carried) = equation.params, parts_of_scan(equation)
    constants, carry, xs = inputs[:fixed], inputs[fixed : fixed + carried], inputs[fixed + carried :]
    outs: list[list] = [[] for _ in range(len(params["jaxpr"].jaxpr.outvars) - carried)]
    order = range(params["length"])
    before: list[np.ndarray] = []  # carry of the previous iteration
    for done, i in enumerate(reversed(order) if params["reverse"] else order, 1):
        result = evaluated(params["jaxpr"], [*constants, *carry, *(x[i] for x in xs)], applied)
        before_last, before, carry = before, carry, result[:carried]
        in_cycle = _equal(carry, before_last) and (params["length"] - done) % 2 == 0
        if not xs and not outs and (in_cycle or _equal(carry, before)):
            return carry  # a fixed point or a cycle of two: further iterations change nothing
        for out, y in zip(outs, result[carried:], strict=True):
            out.append(y)
    avals = [v.aval for v in params["jaxpr"].jaxpr.outvars[carried:]]
    stacked = [
        np.stack(out[::-1] if params["reverse"] else out) if out else np.zeros((0, *a.shape), a.dtype)
        for out, a in zip(outs, avals, strict=True)
    ]
    return [*carry, *stacked]


def _equal(a: list[np.ndarray], b: list[np.ndarray]) -> bool:
    return len(a) == len(b) and all(np.array_equal(x, y) for x, y in zip(a, b, strict=True))


def _while(equation, inputs) -> list[np.ndarray]:
    params = equation.params
    a, b = params["cond_nconsts"], params["body_nconsts"]
    of_condition, of_body, carry = inputs[:a], inputs[a : a + b], inputs[a + b :]
    for _ in range(MOST_TURNS):
        going = np.asarray(evaluated(params["cond_jaxpr"], [*of_condition, *carry], applied)[0])
        if not np.any(going):
            return carry
        new = evaluated(params["body_jaxpr"], [*of_body, *carry], applied)
        pairs = zip(new, carry, strict=True)
        carry = new if going.ndim == 0 else [np.where(_shaped_for(n, going), n, o) for n, o in pairs]
    if np.all(going):
        raise ValueError(
            f"a `while_loop` in {_where(equation)} does not end after {MOST_TURNS} iterations; check its "
            "condition or bound it, such as `lambda state: (state[0] < 50) & ...`"
        )
    # some samples have ended; the results of the others are unknown, so NaN
    unknown = lambda x: np.where(_shaped_for(x, going), np.nan, x).astype(x.dtype)
    return [unknown(x) if x.dtype.kind == "f" else x for x in carry]


def _shaped_for(x: np.ndarray, going: np.ndarray) -> np.ndarray:
    return going.reshape(going.shape + (1,) * (x.ndim - going.ndim))


def _where(equation) -> str:
    """Return the user's function from which an equation comes."""
    traceback = equation.source_info.traceback
    for frame in traceback.frames if traceback is not None else ():
        if not any(part in frame.file_name for part in _NOT_THE_USERS):
            return (
                f"`{frame.function_name.rpartition('.')[2]}` (line {frame.line_num} of"
                f" {os.path.basename(frame.file_name)})"
            )
    return "a function of the scene"


def _linear_solve(equation, inputs) -> list[np.ndarray]:
    params, lengths = equation.params, equation.params["const_lengths"]
    of_solve = inputs[lengths.matvec + lengths.vecmat :][: lengths.solve]
    return evaluated(params["jaxprs"].solve, [*of_solve, *inputs[sum(lengths) :]], applied)


def _linear_map(equation, inputs) -> list[np.ndarray]:
    count = equation.params["count"]
    return evaluated(
        jax.make_jaxpr(equation.params["linear"].apply)(inputs[:count], inputs[count:]), inputs, applied
    )


_CONTROL: dict[str, Callable] = {
    "scan": _scan,
    "while": _while,
    "cond": lambda equation, inputs: evaluated(
        equation.params["branches"][int(inputs[0])], inputs[1:], applied
    ),
    "jourdain_linear_map": _linear_map,
    "custom_lin": lambda equation, inputs: inputs,
    "custom_linear_solve": _linear_solve,
    "custom_vmap_call": lambda equation, inputs: evaluated(equation.params["call"], inputs, applied),
    "jourdain_lanes_first": lambda equation, inputs: inputs,
    "jourdain_entries": lambda equation, inputs: list(*inputs),
    **{p.name: lambda equation, inputs, f=f: f(np, *inputs, **equation.params) for p, f in MAPS},
}

_ENTRYWISE: dict[str, Callable] = {
    **VALUES,
    "add_any": np.add,
    "square": np.square,
    "rsqrt": lambda x: 1 / np.sqrt(x),
    "and": np.bitwise_and,
    "or": np.bitwise_or,
    "xor": np.bitwise_xor,
    "not": np.invert,
    "copy": lambda x: x,
    "copy_p": lambda x: x,
    "stop_gradient": lambda x: x,
    "unvmap_any": np.any,
    "convert_element_type": lambda x: x,
}
del _ENTRYWISE["select"], _ENTRYWISE["round"]


def _round(equation, x):
    if equation.params["rounding_method"] == jax.lax.RoundingMethod.TO_NEAREST_EVEN:
        return np.rint(x)
    whole = np.trunc(x)
    return whole + np.copysign(np.abs(x - whole) >= 0.5, x)  # half away from zero


def as_matrices(equation, a, b) -> tuple[np.ndarray, np.ndarray]:
    """Return the operands of `dot_general` as matrices with batch axes first. The result is their matrix
    product, to be reshaped.
    """
    (over_a, over_b), (batch_a, batch_b) = equation.params["dimension_numbers"]
    free_a = [i for i in range(a.ndim) if i not in (*over_a, *batch_a)]
    free_b = [i for i in range(b.ndim) if i not in (*over_b, *batch_b)]
    batch, contracted = [a.shape[i] for i in batch_a], int(np.prod([a.shape[i] for i in over_a]))
    left = np.transpose(a, (*batch_a, *free_a, *over_a)).reshape(
        *batch, int(np.prod([a.shape[i] for i in free_a])), contracted
    )
    right = np.transpose(b, (*batch_b, *over_b, *free_b)).reshape(
        *batch, contracted, int(np.prod([b.shape[i] for i in free_b]))
    )
    return left, right


def _broadcast_in_dim(equation, x, *dynamic):
    shape = [1] * len(equation.params["shape"])
    for axis, place in enumerate(equation.params["broadcast_dimensions"]):
        shape[place] = x.shape[axis]
    return np.broadcast_to(x.reshape(shape), equation.params["shape"])


def _slice(equation, x):
    p = equation.params
    strides = p["strides"] or (1,) * x.ndim
    return x[tuple(slice(*s) for s in zip(p["start_indices"], p["limit_indices"], strides, strict=True))]


def _select(equation, which, *cases):
    which = which.reshape((*which.shape, *(1,) * (cases[0].ndim - which.ndim)))
    return (
        np.where(np.asarray(which, bool), cases[1], cases[0]) if len(cases) == 2 else np.choose(which, cases)
    )


def _window(x, starts, sizes) -> tuple[slice, ...]:
    """Return slices of the given `sizes` starting at `starts`, shifted into the array if necessary."""
    begin = [min(max(int(s), 0), n - size) for s, n, size in zip(starts, x.shape, sizes, strict=True)]
    return tuple(slice(s, s + size) for s, size in zip(begin, sizes, strict=True))


def _pad(equation, x, fill):
    out = np.full(equation.outvars[0].aval.shape, fill)
    places, kept = [], []
    for (low, _, interior), size, total in zip(
        equation.params["padding_config"], x.shape, out.shape, strict=True
    ):
        at = low + (interior + 1) * np.arange(size)
        kept.append((at >= 0) & (at < total))
        places.append(at[kept[-1]])
    out[np.ix_(*places)] = x[np.ix_(*(np.flatnonzero(k) for k in kept))]
    return out


def _svd(equation, A):
    good = np.all(np.isfinite(A), axis=(-2, -1), keepdims=True)
    found = np.linalg.svd(
        np.where(good, A, 0.0),
        full_matrices=equation.params["full_matrices"],
        compute_uv=equation.params["compute_uv"],
    )
    found = [found[1], found[0], found[2]] if equation.params["compute_uv"] else [found]
    return [np.where(good if x.ndim == A.ndim else good[..., 0], x, np.nan) for x in found]


def _qr(equation, A):
    if equation.params["pivoting"]:
        return None  # left to JAX
    return list(np.linalg.qr(A, "complete" if equation.params["full_matrices"] else "reduced"))


def _sort(equation, *arrays):
    keys, axis = arrays[: equation.params["num_keys"]], equation.params["dimension"]
    order = np.lexsort(keys[::-1], axis=axis)
    return [np.take_along_axis(x, order, axis) for x in arrays]


def _cholesky(equation, A):
    try:
        return np.linalg.cholesky(np.tril(A) + np.swapaxes(np.tril(A, -1), -1, -2))
    except np.linalg.LinAlgError:
        return np.full_like(A, np.nan) if A.ndim == 2 else np.stack([_cholesky(equation, a) for a in A])


def _triangular_solve(equation, A, b):
    p = equation.params
    if p["conjugate_a"]:
        return None  # left to JAX
    A = np.tril(A) if p["lower"] else np.triu(A)
    A = np.swapaxes(A, -1, -2) if p["transpose_a"] else A
    if p["unit_diagonal"]:
        A = np.where(np.eye(A.shape[-1], dtype=bool), np.ones((), A.dtype), A)
    singular = np.any(np.diagonal(A, axis1=-2, axis2=-1) == 0, axis=-1)[..., None, None]
    safe = np.where(singular, np.eye(A.shape[-1]), A)
    x = (
        np.linalg.solve(safe, b)
        if p["left_side"]
        else np.swapaxes(np.linalg.solve(np.swapaxes(safe, -1, -2), np.swapaxes(b, -1, -2)), -1, -2)
    )
    return np.where(singular, np.nan, x)


def _lu(equation, A):
    """Return the LU decomposition with partial pivoting, like LAPACK's getrf: factors, row exchanges and
    their permutation. Leading axes are batch axes.
    """
    *lanes, rows, columns = A.shape
    LU = np.array(A).reshape(-1, rows, columns)
    every, swaps = np.arange(len(LU)), np.zeros((len(LU), min(rows, columns)), np.int32)
    order = np.broadcast_to(np.arange(rows, dtype=np.int32), (len(LU), rows)).copy()
    for k in range(swaps.shape[1]):
        swaps[:, k] = best = k + np.argmax(np.abs(LU[:, k:, k]), axis=1)
        for x in (LU, order):
            x[every, k], x[every, best] = x[every, best].copy(), x[every, k].copy()
        pivot = LU[:, k, k, None]
        LU[:, k + 1 :, k] /= np.where(pivot == 0, 1, pivot)
        LU[:, k + 1 :, k + 1 :] -= LU[:, k + 1 :, k, None] * LU[:, k, None, k + 1 :]
    return [LU.reshape(A.shape), swaps.reshape(*lanes, -1), order.reshape(*lanes, rows)]


def _platform(equation):
    """Return the index of the implementation for CPUs, or for all platforms."""
    return np.asarray(
        next(i for i, names in enumerate(equation.params["platforms"]) if names is None or "cpu" in names),
        np.int32,
    )


def _iota(equation, *dynamic):
    shape, axis = equation.params["shape"], equation.params["dimension"]
    along = [-1 if i == axis else 1 for i in range(len(shape))]
    return np.broadcast_to(np.arange(shape[axis], dtype=equation.params["dtype"]).reshape(along), shape)


def _reduced(function: Callable, of_nothing=None) -> Callable:
    def reduced(equation, x):
        start = {} if of_nothing is None or x.dtype.kind != "f" else {"initial": of_nothing}
        return np.asarray(
            function(x, axis=tuple(equation.params["axes"]), **start), equation.outvars[0].aval.dtype
        )

    return reduced


def _in_order(x: np.ndarray) -> np.ndarray:
    """Return integers that are ordered like the floats: -NaN, -inf, ..., -0, 0, ..., inf, NaN."""
    if x.dtype.kind != "f":
        return x
    bits = x.view(f"i{x.itemsize}")
    return np.where(bits < 0, bits ^ np.iinfo(bits.dtype).max, bits)


def _reshaped(equation, x, *dynamic):
    return x.reshape(equation.outvars[0].aval.shape)


RULES: dict[str, Callable] = {
    **dict.fromkeys(("reshape", "squeeze", "expand_dims"), _reshaped),
    "dot_general": lambda e, a, b: _reshaped(e, np.matmul(*as_matrices(e, a, b))),
    "broadcast_in_dim": _broadcast_in_dim,
    "transpose": lambda e, x: np.transpose(x, e.params["permutation"]),
    "rev": lambda e, x: np.flip(x, e.params["dimensions"]),
    "concatenate": lambda e, *xs: np.concatenate(xs, axis=e.params["dimension"]),
    "stack": lambda e, *xs: np.stack(xs, axis=e.params["axis"]),
    "unstack": lambda e, x: list(np.moveaxis(x, e.params["axis"], 0)),
    "split": lambda e, x: np.split(x, np.cumsum(e.params["sizes"])[:-1], axis=e.params["axis"]),
    "slice": _slice,
    "round": _round,
    "select_n": _select,
    "integer_pow": lambda e, x: np.asarray(
        x ** e.params["y"] if e.params["y"] >= 0 else 1 / x ** -e.params["y"]
    ),
    "svd": _svd,
    "qr": _qr,
    "sort": _sort,
    "lu": _lu,
    "cholesky": _cholesky,
    "triangular_solve": _triangular_solve,
    "reduce_sum": _reduced(np.sum),
    "reduce_max": _reduced(np.max, -np.inf),
    "reduce_min": _reduced(np.min, np.inf),
    "reduce_prod": _reduced(np.prod),
    "reduce_and": _reduced(np.bitwise_and.reduce),
    "reduce_or": _reduced(np.bitwise_or.reduce),
    "optimization_barrier": lambda e, *xs: list(xs),
    "dynamic_slice": lambda e, x, *starts: x[_window(x, starts, e.params["slice_sizes"])],
    "iota": _iota,
    "pad": _pad,
    "gather": lambda e, x, indices: gathered(e.params, x, indices),
    "scatter": lambda e, *inputs: scattered(e.params, *inputs),
    **{
        f.__name__: lambda e, x, f=f: f(x, *e.params["axes"]).astype(e.params["index_dtype"])
        for f in (np.argmax, np.argmin)
    },
    "lt_to": lambda e, x, y: np.less(*map(_in_order, (x, y))),
    "platform_index": _platform,
}
