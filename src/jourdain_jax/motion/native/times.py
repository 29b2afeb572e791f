"""Times that vary: machine code goes from one number to others, and states are moved to the times that these stand for, along their own rates.

z: all that the rates of a state are given, beside that state; G: how fast each of these numbers changes. Where z is moved by a time d that is zero,

    dz_1 = (1 + G' d)(dz + G dd),   G' = dG/dz,   to the second order

A start is moved by less than its time, t_0 = number - d, what is found by more.
"""

from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jourdain_jax.calculus.derivatives import Rules, filled, is_zero, with_rules
from jourdain_jax.motion.native.functions import Form
from jourdain_jax.motion.native.values_of_nodes import values_of_nodes
from jourdain_jax.program.derivative import on_its_own


def moved(form: Form) -> Callable[[Float[Array, "z"], Float[Array, ""]], Float[Array, "z"]]:
    """Return z itself as a function of z and of the time by which it is moved, which is zero.

    z: the state, time, the numbers known, and how fast those of them change that samples give.
    """
    rates = _rates(form)

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


def _rates(form: Form) -> Callable[[Float[Array, "z"]], Float[Array, "z"]]:
    """G(z), which is zero but for the state, time and what samples give."""
    program, layout = form.program, form.layout
    graph, rates, variables = on_its_own(program.graph, form.rates, program.variables)
    first, count = len(program.fixed), layout.coordinates + layout.speeds
    work = [graph.input("work", True)] if layout.with_work else []
    slopes = [graph.input(f"slope of input {i}", True) for i in form.sampled]
    z = [*variables[first + 1 : first + 1 + count], *work, variables[first], *variables[:first], *variables[first + 1 + count :], *slopes]
    of_inputs = dict(zip(form.sampled, slopes, strict=True))
    known = [graph.zero] * first + [of_inputs.get(i, graph.zero) for i in range(len(program.inputs))]
    return values_of_nodes(graph, [*rates, graph.one, *known, *[graph.zero] * len(slopes)], z)


@jax.custom_jvp
def scaled(slope: Float[Array, "y"], by: Float[Array, "..."]) -> Float[Array, "y"]:
    """Their product; zero, whatever the slope, where it is multiplied by zero."""
    return jnp.where(by == 0.0, 0.0, slope * by)


@scaled.defjvp
def _scaled_jvp(primals, tangents):
    return scaled(*primals), scaled(tangents[0], primals[1]) + scaled(primals[0], tangents[1])
