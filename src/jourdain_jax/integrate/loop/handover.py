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
    """Return the rows that are equal at the start of every motion: values by the index of the first row."""
    rows, begun = form.rows, [0.0] * form.returned
    for name, x in (("code", float(RUNNING)), ("event", -1.0), ("pivot", math.inf)):
        begun[rows[name].start] = x
    h = rows["h"].start
    return {form.integrated: tuple(begun[form.integrated : h]), h + 1: tuple(begun[h + 1 :])}


class Start(NamedTuple):
    """Input of the loop for one motion. The state and the known numbers are followed by their tangents
    (`Form`).
    """

    of_samples: tuple[Array, ...]  # tables and knots (`samples.py`); for a loop in JAX, only the knots
    control: Numbers  # rtol, atol, shortest, longest and first step, maximum number of steps
    goals: Float[Array, "times *lanes"]  # measured from the start
    origin: PerLane  # the time of the start
    y: tuple[Float[Array, "y *lanes"], ...]
    # known numbers; for a loop in JAX, the arrays among the arguments of the rates, with the batch axis first
    known: tuple[tuple[Array, ...], ...]
    modes: Numbers = ()
    plain: tuple[Array, ...] = ()  # `known`; arrays that all samples share have no batch axis

    def numbers(self) -> Numbers:
        """Return the rows after the state at the start, except `constant_rows`. Rows that all lanes share
        have no batch axis.
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
    """Output of the loop: a motion. Each part is followed by its tangents."""

    y: tuple[Float[Array, "times y *lanes"], ...]  # at the goals
    end: tuple[Float[Array, "y *lanes"], ...]
    t: Numbers  # time of the end, measured from the start
    log: tuple[Float[Array, "transitions *lanes"], ...]  # times of transitions
    # rows of the progress except its time; the number of goals reached; then the number, the events, the
    # energy losses and the modes of transitions
    rest: Float[Array, "rest *lanes"]

    @staticmethod
    def of(
        form: Form,
        states: Float[Array, "times y *lanes"],
        end: Float[Array, "returned *lanes"],
        count: Float[Array, "one *lanes"],
    ) -> "Found":
        """Return a motion from its states at the goals, its final rows, and the number of goals reached."""
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
        """Remove the batch axis from those results of `vmap` that do not need it. Also return for each part
        whether it keeps the axis. `given`: for each part of the start, whether it has the axis.

        A tangent has a batch axis if any quantity on which it depends has one. If only directions are
        batched, they share the values of one motion.
        """
        parts = range(len(self.y))
        base = any(jax.tree.leaves(given._replace(y=(), known=())))
        own = [any(jax.tree.leaves((given.y[k], given.known[k]))) for k in parts]
        of_parts = tuple(
            base or any(own[other] for other in range(k + 1) if other & k == other) for k in parts
        )
        lanes = Found(of_parts, of_parts, of_parts, of_parts, of_parts[0])
        return jax.tree.map(lambda x, has_lanes: x if has_lanes else x[0], self, lanes), lanes
