"""NaN in place of numbers, also of their derivatives.

`jnp.where(failed, nan, x)` has derivatives of zero where it is NaN, which pass for those of a minimum. Those here are NaN, except where the number depends on
nothing, or nothing on it: there they stay zero.
"""

import jax
import jax.numpy as jnp
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir
from jaxtyping import Array, Bool, Float

from jourdain_jax.calculus.lanes_first import with_lanes_first


@jax.custom_jvp
def nan_where(failed: Bool[Array, "..."], x: Float[Array, "..."]) -> Float[Array, "..."]:
    """`x`, with NaN where `failed` (of the same shape) holds."""
    return jnp.where(failed, jnp.nan, x)


@nan_where.defjvp
def _rule(primals, tangents):
    return nan_where(*primals), _rates_p.bind(primals[0], tangents[1])


def _rates(failed, rates):
    return jnp.where(failed & (rates != 0), jnp.nan, rates)


# of tangents and cotangents, of which it counts as a linear function
_rates_p = Primitive("jourdain_nan_where_rates")
_rates_p.def_impl(_rates)
_rates_p.def_abstract_eval(lambda failed, rates: rates)
mlir.register_lowering(_rates_p, mlir.lower_fun(_rates, multiple_results=False))
batching.primitive_batchers[_rates_p] = lambda values, axes: (_rates_p.bind(*with_lanes_first(values, axes)), 0)
ad.primitive_jvps[_rates_p] = lambda primals, tangents: (_rates_p.bind(*primals), _of(primals[0], tangents[1]))
ad.primitive_transposes[_rates_p] = lambda cotangent, failed, rates: [None, _of(failed, cotangent)]


def _of(failed, rates):
    return rates if type(rates) is ad.Zero else _rates_p.bind(failed, rates)
