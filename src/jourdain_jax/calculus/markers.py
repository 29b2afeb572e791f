"""Markers: JAX primitives that return their operands unchanged and act when batched or differentiated.

`lanes_first` moves the batch axis of `vmap` to the front, `entries_of` to the end. `tap_tangents` and
`tap_cotangents` pass derivatives to a Python function; they act only outside `jit`, so no compiled program
calls Python.

For a computation y(x) between `entered` and `left`, with some samples that failed,

    forward     dy = NaN where y failed and any dx is not zero
    reverse     dx = 0 where every dy is zero, NaN where the dy of a failed y is not      (dx, dy: cotangents)

`jnp.where(failed, nan, x)` alone gives wrong derivatives: zero where the value is NaN, as if it were a
minimum, and NaN from failed values that are not used (0 times NaN).

An extra number, which is zero, goes from `entered` to `left`; its derivative counts the nonzero derivatives.
The rules are linear maps, and so are their derivatives. In reverse mode of such a derivative, cotangents
reach x through the point at which the first derivative was taken, without passing `left`. That point
therefore includes the count of the first derivative.
"""

from collections.abc import Callable, Sequence
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir
from jaxtyping import Array, Bool, Float, Shaped

from jourdain_jax.calculus.reals import Flag, Scalar


def identity(name: str) -> Primitive:
    """Return a primitive called `name` that returns its operands unchanged, even when batched. The primitive
    has no derivative.
    """
    primitive = Primitive(name)
    primitive.multiple_results = True
    primitive.def_impl(lambda *values, **_: list(values))
    primitive.def_abstract_eval(lambda *avals, **_: list(avals))
    mlir.register_lowering(primitive, lambda ctx, *values, **_: list(values))
    batching.primitive_batchers[primitive] = lambda values, axes, **params: (
        primitive.bind(*values, **params),
        axes,
    )
    return primitive


def lanes_first(tree):
    """Return the tree unchanged, but let `vmap` move the batch axis of every array to the front. Arrays
    without a tangent space (float0) keep their axes.
    """
    leaves, treedef = jax.tree.flatten(tree)
    moved = [i for i, x in enumerate(leaves) if x.dtype != jax.dtypes.float0]
    for i, x in zip(moved, lanes_first_p.bind(*(leaves[i] for i in moved)) if moved else (), strict=True):
        leaves[i] = x
    return jax.tree.unflatten(treedef, leaves)


def stopped(tree):
    """Return the tree without derivatives, as `jax.lax.stop_gradient` does, but by one operation."""
    leaves, treedef = jax.tree.flatten(tree)
    real = [i for i, x in enumerate(leaves) if eqx.is_inexact_array(x)]
    for i, x in zip(real, _stopped_p.bind(*(leaves[i] for i in real)), strict=True):
        leaves[i] = x
    return jax.tree.unflatten(treedef, leaves)


def lanes_of(values, axes) -> int:
    """Return the batch size from the axes that JAX passes to a batching rule (None for an array without a
    batch axis).
    """
    return next(x.shape[axis] for x, axis in zip(values, axes, strict=True) if axis is not None)


def with_lanes_first(values, axes, count: int | None = None) -> list:
    """Return the arrays with the batch axis first; an array without one is repeated."""
    count = lanes_of(values, axes) if count is None else count
    return [
        jnp.broadcast_to(x, (count, *x.shape)) if axis is None else jnp.moveaxis(x, axis, 0)
        for x, axis in zip(values, axes, strict=True)
    ]


def _with_lanes_first(values, axes):
    return lanes_first_p.bind(*with_lanes_first(values, axes)), [0] * len(values)


_stopped_p = identity("jourdain_stopped")
ad.primitive_jvps[_stopped_p] = lambda primals, tangents: (
    _stopped_p.bind(*primals),
    [ad.Zero(jax.typeof(x).to_tangent_aval()) for x in primals],
)
lanes_first_p = identity("jourdain_lanes_first")
ad.primitive_jvps[lanes_first_p] = lambda primals, tangents: (lanes_first_p.bind(*primals), list(tangents))
ad.primitive_transposes[lanes_first_p] = lambda cotangents, *values: list(cotangents)
batching.primitive_batchers[lanes_first_p] = _with_lanes_first


def entries_of(v: Shaped[Array, "entries *rest"]) -> tuple[Shaped[Array, "*rest"], ...]:
    """Split a vector into scalars, with the batch axis last. With the batch axis first, XLA would compile one
    slice per entry.

    Measured for 111 entries of a batch of 26: 1.3 to 1.8 s of compilation with the batch axis first, 0.05 s
    with it last.
    """
    return tuple(_entries_p.bind(v))


def _each(v) -> list[Array]:
    return [jax.lax.index_in_dim(v, i, keepdims=False) for i in range(v.shape[0])]


def _with_lanes_last(values, axes):
    v = jnp.moveaxis(values[0], axes[0], -1)
    return _entries_p.bind(v), [v.ndim - 2] * v.shape[0]


_entries_p = Primitive("jourdain_entries")
_entries_p.multiple_results = True
_entries_p.def_impl(_each)
_entries_p.def_abstract_eval(lambda v: [v.update(shape=v.shape[1:])] * v.shape[0])
mlir.register_lowering(_entries_p, mlir.lower_fun(_each, multiple_results=True))
batching.primitive_batchers[_entries_p] = _with_lanes_last
ad.deflinear2(_entries_p, lambda cotangents, v: [jnp.stack([ad.instantiate_zeros(x) for x in cotangents])])


_shown_p, _forwards_p, _tangents_p = (
    identity(f"jourdain_shown_{name}") for name in ("backwards", "forwards", "tangents")
)


def _look(look: Callable, values, dims) -> None:
    """Pass known values to `look` as arrays, with their batch axis, of index `dim` or None, first."""
    if not any(isinstance(x, jax.core.Tracer) for x in values):
        arrays = zip(map(np.asarray, values), dims, strict=True)
        look([x[None] if dim is None else np.moveaxis(x, dim, 0) for x, dim in arrays])


def _transposed(cotangents, *values, look: Callable):
    cotangents = [ad.instantiate_zeros(ct) for ct in cotangents]
    _look(lambda arrays: look([x[0] for x in arrays]), cotangents, [None] * len(cotangents))
    return cotangents


ad.deflinear2(_shown_p, _transposed)


def _pushed(primals, tangents, *, look: Callable):
    tangents = [ad.instantiate_zeros(tangent) for tangent in tangents]
    return _forwards_p.bind(*primals, look=look), _tangents_p.bind(*tangents, look=look)


def _seen(*tangents, look: Callable):
    _look(look, tangents, [None] * len(tangents))
    return list(tangents)


def _seen_in_batch(tangents, dims, *, look: Callable):
    """Pass all directions of a `jacfwd` to `look` at once."""
    _look(look, tangents, dims)
    return list(tangents), dims


_tangents_p.def_impl(_seen)
batching.primitive_batchers[_tangents_p] = _seen_in_batch
ad.primitive_jvps[_forwards_p] = _pushed
ad.deflinear2(_tangents_p, lambda cotangents, *values, look: [ad.instantiate_zeros(ct) for ct in cotangents])
ad.primitive_jvps[_tangents_p] = lambda primals, tangents, *, look: (
    _tangents_p.bind(*primals, look=look),
    list(tangents),
)


def tap_tangents(values: tuple, look: Callable) -> tuple:
    """Return `values`, a tuple of arrays. Forward-mode differentiation with concrete numbers calls `look`
    with their tangents, which have a leading axis of directions.
    """
    return tuple(_forwards_p.bind(*values, look=look))


def tap_cotangents(values: tuple, look: Callable) -> tuple:
    """Return `values`, a tuple of arrays. Reverse-mode differentiation with concrete numbers calls `look`
    with their cotangents.
    """
    return tuple(_shown_p.bind(*values, look=look))


@jax.custom_jvp
def entered(*each: Float[Array, "..."]) -> tuple[list[Array], Scalar]:
    """Mark the arrays at the start of a computation. Return them, and for `left` a zero whose derivative
    counts nonzero derivatives.
    """
    *each, asked = lanes_first((*each, jnp.zeros((), each[0].dtype)))
    return each, asked


@jax.custom_jvp
def left(
    asked: Scalar, failed: Sequence[Bool[Array, "..."]], each: Sequence[Float[Array, "..."]]
) -> list[Array]:
    """Mark and return the arrays `each` at the end of a computation. `failed`: which samples failed, along
    the first axes; `asked`: the zero from `entered`.
    """
    return lanes_first([*each, *failed, asked])[: len(each)]


@jnp.vectorize
def nan_where(failed: Flag, x: Scalar) -> Scalar:
    """Return `x` with NaN in values and derivatives where `failed` is true; zero derivatives stay zero."""
    (x,), asked = entered(x)
    return left(asked, [failed], [x + jnp.where(failed, jnp.nan, 0.0)])[0]


@partial(entered.defjvp, symbolic_zeros=True)
def _entering(primals, tangents):
    each, asked = entered(*primals)
    moved = {
        k: _counted_p.bind(jnp.asarray(x), lanes=0)
        for k, x in enumerate(tangents)
        if not isinstance(x, SymbolicZero)
    }
    count = sum((count.astype(asked.dtype) for _, count in moved.values()), jnp.zeros((), asked.dtype))
    return (each, asked), ([moved[k][0] if k in moved else x for k, x in enumerate(tangents)], count)


@left.defjvp
def _leaving(primals, tangents):
    (asked, failed, each), (count, _, rates) = primals, tangents
    none, count = jnp.zeros_like(asked), count.astype(asked.dtype)

    def lost(failed, x, rate):
        failed = jnp.broadcast_to(
            jnp.reshape(failed, (*failed.shape, *[1] * (x.ndim - failed.ndim))), x.shape
        )
        return _lost_p.bind(failed, none, asked, count, jnp.asarray(rate), lanes=0)[0]

    return left(*primals), list(map(lost, failed, each, rates))


# The maps, with NumPy or jax.numpy as `m`. `lanes`: number of leading batch axes; `before`: count of the
# first derivative, in a derivative of it.


def _any(m, x, lanes):
    """Return 1 where any number is not zero, NaN where any is NaN, otherwise 0."""
    return m.max(m.abs(m.sign(x)), axis=tuple(range(lanes, x.ndim)), initial=0.0).astype(x.dtype)


def _over(counts, x):
    """Return the sum of the magnitudes of `counts`, shaped to broadcast over x."""
    count = sum(map(abs, counts))
    return count.reshape((*count.shape, *[1] * (x.ndim - count.ndim)))


def _counted(m, x, *, lanes):
    return x, _any(m, x, lanes)


def _masked(m, before, count, x, *, lanes):
    count = _over((before, count), x)
    return (m.where(count == 0, 0.0, m.where(m.isnan(count), m.nan, x)).astype(x.dtype),)


def _lost(m, failed, before, asked, count, x, *, lanes):
    return (m.where(failed & (_over((before, count), x) != 0), m.nan, x).astype(x.dtype),)


def _lost_and_counted(m, failed, asked, x, *, lanes):
    x = m.where(failed & (x != 0), m.nan, x).astype(x.dtype)
    return _any(m, x, lanes), x


def _counted_back(cotangents, x, *, lanes):
    g, count = cotangents
    return _masked_p.bind(jnp.zeros_like(count), count, g, lanes=lanes)


def _masked_back(cotangents, before, count, x, *, lanes):
    g, count = _counted_p.bind(*cotangents, lanes=lanes)
    count = jnp.where(before == 0, 0.0, jnp.where(jnp.isnan(before), jnp.nan, count)).astype(count.dtype)
    return [None, count, g]


def _lost_back(cotangents, failed, before, asked, count, x, *, lanes):
    asked = jnp.zeros_like(before) if ad.is_undefined_primal(asked) else asked
    count, g = _lost_and_counted_p.bind(failed, asked, *cotangents, lanes=lanes)
    return [None, None, count, count, g]


def _lost_and_counted_back(cotangents, failed, asked, x, *, lanes):
    count, g = cotangents
    none = jnp.zeros_like(count)
    return [None, count, *_lost_p.bind(failed, none, none, count, g, lanes=lanes)]


def _map(function: Callable, back: Callable, at: int) -> Primitive:
    """Return a map as a JAX primitive, linear in all arrays except the first `at`. `back`: its transpose."""
    p = Primitive(f"jourdain_nan{function.__name__}")

    def shapes(*avals, lanes):
        found = jax.eval_shape(partial(function, jnp, lanes=lanes), *avals)
        return [avals[-1].update(shape=x.shape, weak_type=False) for x in found]

    p.multiple_results = True
    p.def_impl(
        jax.jit(lambda *values, lanes: list(function(jnp, *values, lanes=lanes)), static_argnames="lanes")
    )
    p.def_abstract_eval(shapes)
    mlir.register_lowering(p, mlir.lower_fun(partial(function, jnp), multiple_results=True))

    def pushed(primals, tangents, *, lanes):
        taken_at = list(primals[:at])
        if function in (_masked, _lost):  # the last of these is the count of the first derivative
            taken_at[-1] = jnp.abs(taken_at[-1]) + jnp.abs(primals[-2])
        along = map(ad.instantiate_zeros, tangents[at:])
        return p.bind(*primals, lanes=lanes), p.bind(*taken_at, *along, lanes=lanes)

    def batched(values, axes, *, lanes):
        found = p.bind(*with_lanes_first(values, axes), lanes=lanes + 1)
        return found, [0] * len(found)

    ad.primitive_jvps[p] = pushed

    def transposed(cotangents, *values, lanes):
        return back([ad.instantiate_zeros(g) for g in cotangents], *values, lanes=lanes)

    ad.primitive_transposes[p] = transposed
    batching.primitive_batchers[p] = batched
    return p


_counted_p, _masked_p = _map(_counted, _counted_back, 0), _map(_masked, _masked_back, 1)
_lost_p, _lost_and_counted_p = _map(_lost, _lost_back, 2), _map(_lost_and_counted, _lost_and_counted_back, 1)
MAPS = (
    (_counted_p, _counted),
    (_masked_p, _masked),
    (_lost_p, _lost),
    (_lost_and_counted_p, _lost_and_counted),
)
