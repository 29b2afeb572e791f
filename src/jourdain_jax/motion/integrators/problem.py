"""What the loop over steps integrates and how well: rates, projection, events, tolerances, times at which steps must end."""

from collections.abc import Callable
from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PyTree

MEMORY = 2**32  # bytes, where no model states others


class Problem(eqx.Module):
    """What is integrated and how well."""

    rates: Callable  # (t, y, args) -> dy/dt
    args: PyTree
    project: Callable | None  # (t, y, args) -> y
    events: Callable | None  # (t, y, args) -> values, (events, *lanes)
    norm: Callable  # of a state, one number per lane
    rtol: Float[Array, "*lanes"]
    atol: Float[Array, "*lanes"]
    shortest: Float[Array, "*lanes"]
    longest: Float[Array, "*lanes"]
    max_steps: int = eqx.field(static=True)
    knots: Float[Array, "knots *lanes"] | None = None  # times at which a step must end, in the order of the motion; the last are infinite, with its sign
    # as `rates`; pivots (pivots, *lanes) that must keep their signs, directions (rows, speeds, *lanes) that must not turn round, a sine; None: there are none
    rates_and_pivots: Callable | None = None
    relations: Callable | None = None  # (args, t, y) -> numbers whose signs are watched, (numbers, *lanes): first so many relations, then stop events
    relation_count: int = eqx.field(static=True, default=0)
    span: Float[Array, "*lanes"] | None = None  # of the motion, s
    near_rank_loss: bool = eqx.field(static=True, default=False)  # `rates_and_pivots` has a sine: of rows that may lose rank
    within: Callable | None = None  # (t, args) -> args for the stages of a step with the middle t; None: the same in all steps
    memory: int = eqx.field(static=True, default=MEMORY)  # bytes that the record of reverse mode may take

    def in_step(self, t, h) -> "Problem":
        """The problem for the stages of a step."""
        return self if self.within is None else replace(self, args=self.within(t + 0.5 * h, self.args))

    def knot_ahead(self, t: Float[Array, "*lanes"], knot: Int[Array, "*lanes"], direction) -> Float[Array, "*lanes"]:
        """The time of the `knot` ahead of t, infinity with the sign of the motion where there is none."""
        if self.knots is None:
            return direction * jnp.full_like(t, jnp.inf)
        return in_lanes(self.knots, knot)

    def knots_passed(self, t: Float[Array, "*lanes"], direction) -> Int[Array, "*lanes"]:
        """How many knots lie at `t` or before it."""
        return jnp.zeros(jnp.shape(t), jnp.int32) if self.knots is None else passed(self.knots, t, direction)


def passed(times: Float[Array, "times *lanes"], t: Float[Array, "*lanes"], direction) -> Int[Array, "*lanes"]:
    """Return how many of these times lie at `t` or before it."""
    return jnp.sum((times - t) * direction <= 0, axis=0, dtype=jnp.int32)


def in_lanes(x: Float[Array, "rows *shape"], k: Int[Array, "*lanes"]) -> Float[Array, "*shape"]:
    """Return row k of x, a row for each lane; the last one where there are not so many."""
    return jnp.take_along_axis(x, k[(None,) * (x.ndim - k.ndim)], 0, mode="clip")[0]


def as_in(x, like) -> Array:
    """A number in the precision of the state: time keeps its own."""
    return jnp.asarray(x, like.dtype)
