"""Derivatives that are NaN where a computation failed, and zero where nobody asks for what it found.

`jnp.where(failed, nan, x)` has derivatives of zero where it is NaN, which pass for those of a minimum; and
what was computed from numbers that are lost has derivatives such as 0 NaN, also where it is left out.
Between `entered` and `left`, a computation y(x) has, with a zero that counts the derivatives that enter,

    forward     dy = NaN where y failed and any dx is not zero
    reverse     dx = 0 where no dy is asked for, NaN where one that failed is

Both count as linear maps, whose own derivatives are such maps. In reverse mode of these, cotangents come to x
past `left`, by what the first derivative was taken at: therefore that zero counts as such, too.
"""

from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir
from jaxtyping import Array, Bool, Float

from jourdain_jax.calculus.lanes_first import lanes_first, with_lanes_first


@jax.custom_jvp
def entered(x: Float[Array, "..."]) -> tuple[Float[Array, "..."], Float[Array, ""]]:
    """`x`, and the zero to be handed to `left`: where several arrays enter, their sum."""
    return lanes_first((x, jnp.zeros((), x.dtype)))


@jax.custom_jvp
def left(failed: Bool[Array, "..."], asked: Float[Array, ""], x: Float[Array, "..."]) -> Float[Array, "..."]:
    """`x`, which `failed` or did not, number by number; `asked`: the zero of what entered."""
    return lanes_first((x, failed, asked))[0]


@jnp.vectorize
def nan_where(failed: Bool[Array, ""], x: Float[Array, ""]) -> Float[Array, ""]:
    """`x`, with NaN where `failed` holds, and so are its derivatives; those of what depends on nothing, or on
    which nothing depends, stay zero.
    """
    x, asked = entered(x)
    return left(failed, asked, x + jnp.where(failed, jnp.nan, 0.0))


@entered.defjvp
def _entering(primals, tangents):
    return entered(*primals), tuple(_counted_p.bind(jnp.asarray(tangents[0]), lanes=0))


@left.defjvp
def _leaving(primals, tangents):
    failed, asked, x = primals
    none, count = jnp.zeros_like(asked), tangents[1].astype(asked.dtype)
    failed, rates = jnp.broadcast_to(failed, x.shape), jnp.asarray(tangents[2])
    rates = _lost_p.bind(failed, none, asked, count, rates, lanes=0)
    return left(*primals), rates[0]


# The maps. Numbers of a lane are those after the leading axes of lanes; `before`: what was counted where this
# is the derivative of a derivative.


def _any(x, lanes):
    return jnp.any(x.astype(bool), axis=tuple(range(lanes, jnp.ndim(x)))).astype(x.dtype)


def _over(counts, x):
    """The counts of lanes beside the numbers of those."""
    count = sum(map(jnp.abs, counts))
    return jnp.reshape(count, (*count.shape, *[1] * (x.ndim - count.ndim)))


def _counted(x, *, lanes):
    return x, _any(x, lanes)


def _masked(before, count, x, *, lanes):
    count = _over((before, count), x)
    return (jnp.where(count == 0, 0.0, jnp.where(jnp.isnan(count), jnp.nan, x)).astype(x.dtype),)


def _lost(failed, before, asked, count, x, *, lanes):
    return (jnp.where(failed & (_over((before, count), x) != 0), jnp.nan, x).astype(x.dtype),)


def _lost_and_counted(failed, asked, x, *, lanes):
    x = jnp.where(failed & (x != 0), jnp.nan, x).astype(x.dtype)
    return jnp.where(_any(jnp.isnan(x), lanes), jnp.nan, _any(x, lanes)).astype(x.dtype), x


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
    """A map as a primitive, linear in all but the first `at` of its arrays; `back`: its transpose."""
    p = Primitive(f"jourdain_nan{function.__name__}")

    def shapes(*avals, lanes):
        found = jax.eval_shape(partial(function, lanes=lanes), *avals)
        return [avals[-1].update(shape=x.shape, weak_type=False) for x in found]

    p.multiple_results = True
    p.def_impl(lambda *values, lanes: list(function(*values, lanes=lanes)))
    p.def_abstract_eval(shapes)
    mlir.register_lowering(p, mlir.lower_fun(function, multiple_results=True))

    def pushed(primals, tangents, *, lanes):
        taken_at = list(primals[:at])
        if function in (_masked, _lost):  # the last is what was counted before
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
