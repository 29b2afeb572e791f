"""Shift a state along its rates by a time, to give it derivatives with respect to times.

Machine code integrates between constant times. The start is shifted along its rates from the differentiable
time t_0 to a constant time, t_0 - d, and the results are shifted back to differentiable times. Let z be the
state and all arguments of its rates, and G the rate of z. A shift of z by a time d, whose value is zero, has
the derivative

    dz_1 = (1 + G' d)(dz + G dd),   G' = dG/dz,   to second order
"""

from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jourdain_jax.calculus.derivatives import Rules, filled, is_zero, with_rules
from jourdain_jax.calculus.reals import Scalar
from jourdain_jax.integrate.loop.form import Form
from jourdain_jax.integrate.loop.value_kernels import values_of_nodes
from jourdain_jax.program.derivative import on_its_own

Unknowns = Float[Array, "z"]


def moved(rates: Callable[[Unknowns], Unknowns]) -> Callable[[Unknowns, Scalar], Unknowns]:
    """Return a function of z and a time d that shifts z along its `rates` by d. The value of d is zero: it
    only carries derivatives.
    """

    def moving_with_time(slope: Callable) -> Callable:
        @jax.custom_jvp
        def same(z, d, v):
            return v

        @partial(same.defjvp, symbolic_zeros=True)
        def rule(at, tangents):
            (z, _, v), (_, dd, dv) = at, tangents
            return same(*at), filled(dv) if is_zero(dd) else filled(dv) + scaled(slope(z, v), dd)

        return same

    along = moving_with_time(lambda z, v: jax.jvp(rates, (z,), (v,))[1])
    back = moving_with_time(lambda z, g: jax.vjp(rates, z)[1](g)[0])

    def push(arguments, tangents):
        (z, d), (dz, dd) = arguments, tangents
        dz = jnp.zeros_like(z) if dz is None else dz
        return z, along(z, d, dz if dd is None else dz + scaled(rates(z), dd))

    def pull(perturbed, arguments, found, g):
        (z, d), (_, varies) = arguments, perturbed
        g = back(z, d, g)
        return g, jnp.sum(scaled(rates(z), g)) if varies else None

    return with_rules(lambda z, d: z, Rules(push, pull))


def rates_of_all(form: Form) -> Callable[[Unknowns], Unknowns]:
    """Return the rates of z, which consists of the state, time, the known numbers, and the slopes of sampled
    inputs. The rates of known numbers are zero.
    """
    graph, rates, variables = on_its_own(form.program.graph, form.rates, form.program.variables)
    fixed, t, y, inputs = form.split(variables)
    work = [graph.input("work", True)] if form.with_work else []
    slopes = [graph.input(f"slope of input {i}", True) for i in form.sampled]
    z = [*y, *work, t, *fixed, *inputs, *slopes]
    of_inputs = dict(zip(form.sampled, slopes, strict=True))
    known = [graph.zero] * len(fixed) + [of_inputs.get(i, graph.zero) for i in range(len(inputs))]
    return values_of_nodes(graph, [*rates, graph.one, *known, *[graph.zero] * len(slopes)], z)


@jax.custom_jvp
def scaled(slope: Float[Array, "y"], by: Float[Array, "..."]) -> Float[Array, "y"]:
    """Return the product `slope * by`; zero if `by` is zero, even if the slope is not finite."""
    return jnp.where(by == 0.0, 0.0, slope * by)


@scaled.defjvp
def _scaled_jvp(primals, tangents):
    return scaled(*primals), scaled(tangents[0], primals[1]) + scaled(primals[0], tangents[1])
