"""Input and output of a loop over steps, in machine code and in JAX."""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jourdain_jax.calculus.reals import PerLane
from jourdain_jax.integrate.event_search import RUNNING
from jourdain_jax.integrate.loop.form import PROGRESS, Form

Numbers = tuple[PerLane, ...]  # one number per row


def constant_rows(form: Form) -> dict[int, tuple[float, ...]]:
    """Return the rows that are equal at the start of every motion: index of the first -> values."""
    rows, begun = form.rows, [0.0] * form.returned
    for name, x in (("code", float(RUNNING)), ("event", -1.0), ("pivot", math.inf)):
        begun[rows[name].start] = x
    h = rows["h"].start
    return {form.integrated: tuple(begun[form.integrated : h]), h + 1: tuple(begun[h + 1 :])}


class Start(NamedTuple):
    """Input of a loop: one motion. Tangents follow the state and the known numbers (`Form`)."""

    of_samples: tuple[Array, ...]  # tables and knots (`samples.py`); for a loop in JAX, only the knots
    control: Numbers  # rtol, atol, shortest, longest and first step, most steps
    goals: Float[Array, "times *lanes"]  # since the start
    origin: PerLane  # the time of the start
    y: tuple[Float[Array, "y *lanes"], ...]
    # numbers; for a loop in JAX, the stored arguments of rates, batch axis first
    known: tuple[tuple[Array, ...], ...]
    modes: Numbers = ()
    plain: tuple[Array, ...] = ()  # `known` without batch axis where shared

    def numbers(self) -> Numbers:
        """Return the rows at the start after the state, except `constant_rows`. Rows shared by
        all lanes have no batch axis.
        """
        rtol, atol, shortest, longest, first, most = self.control
        limits = jnp.sign(self.goals[-1]), self.goals[-1], rtol, atol, shortest, longest, most, self.origin
        return (
            jnp.minimum(jnp.abs(first), longest),
            *limits,
            *self.modes,
            *(x for part in (self.plain or self.known[0], *self.known[1:]) for x in part),
        )


class Found(NamedTuple):
    """Output of a loop: a motion. Tangents follow each part."""

    y: tuple[Float[Array, "times y *lanes"], ...]  # at the goals
    end: tuple[Float[Array, "y *lanes"], ...]
    t: Numbers  # of the end, since the start
    log: tuple[Float[Array, "transitions *lanes"], ...]  # times of transitions
    # rows of the progress after its time, the number of goals reached in order, then the number,
    # events, energy losses and modes of transitions
    rest: Float[Array, "rest *lanes"]

    @staticmethod
    def of(
        form: Form,
        states: Float[Array, "times y *lanes"],
        end: Float[Array, "returned *lanes"],
        count: Float[Array, "one *lanes"],
    ) -> "Found":
        """Build a motion from its states, its rows at the end, and the number of goals reached."""
        rows, parts = form.rows, range(1 + len(form.moving))
        every = [slice(k * form.y, (k + 1) * form.y) for k in parts]

        def named(name: str) -> Array:
            return end[rows[name].start : rows[name].stop]

        log: list[Array] = [jnp.zeros((0, *end.shape[1:]), end.dtype) for _ in parts]
        more = []
        if form.transitions:
            log = jnp.split(named("log_t"), len(parts))
            more = [named(name) for name in ("passed", "log_event", "log_lost", "log_mode") if rows[name]]
        progress = end[rows[PROGRESS[1]].start : rows[PROGRESS[-1]].stop]
        return Found(
            tuple(states[:, part] for part in every),
            tuple(end[part] for part in every),
            tuple(end[row] for row in (rows["t"].start, *rows["dt"])),
            tuple(log),
            jnp.concatenate([progress, count, *more]),
        )

    def shared(self, given: Start) -> tuple["Found", "Found"]:
        """Remove the batch axis from results of `vmap` that do not need it. Also return a flag for each part:
        whether it keeps the axis. `given`: the same flags of the start's parts.

        A tangent has a batch axis if anything on which it depends has one. All directions
        share the values of one motion.
        """
        parts = range(len(self.y))
        base = any(jax.tree.leaves(given._replace(y=(), known=())))
        own = [any(jax.tree.leaves((given.y[k], given.known[k]))) for k in parts]
        of_parts = tuple(
            base or any(own[other] for other in range(k + 1) if other & k == other) for k in parts
        )
        lanes = Found(of_parts, of_parts, of_parts, of_parts, of_parts[0])
        return jax.tree.map(lambda x, has_lanes: x if has_lanes else x[0], self, lanes), lanes
