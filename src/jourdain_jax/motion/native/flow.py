"""The states of a motion at times, as a function that JAX differentiates: the derivative of a motion is a motion, of states with their tangents.

In absolute time, with f the rates and Phi the flow of machine code over spans that are numbers, a state at a time t after a start at t_0 changes by

    dy = dPhi (dy_0 - f_0 dt_0) + f dt

The same holds of a state with tangents, and of its rates: so derivatives of the second order are those of the first one's machine code.
A time is the goal where that was reached, is found by the loop itself where a stop event ended the motion before, and lies at a number after the start
otherwise. Tolerances and the first step change nothing, and what samples say is a number at each time.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, Bool, Float

from jourdain_jax.calculus.guards import DifferentiationModeError
from jourdain_jax.motion.integrators.tableaus import Method
from jourdain_jax.motion.native.functions import Form
from jourdain_jax.motion.native.kernel import Found, Start, kernel, kernel_of_rates
from jourdain_jax.motion.native.pulled import check_derivatives
from jourdain_jax.motion.native.taylor import products
from jourdain_jax.motion.trajectories import results

OF_SAMPLES = 'machine code does not differentiate with respect to samples of an input; `jj.simulate(..., backend="xla")` does'


def flow(form: Form, method: Method, order: int | None) -> Callable[[Start], Found]:
    """The motion by a kernel; `order`: of Taylor series, in the place of the tableau."""
    # 36_000 of coefficients in a step by Taylor series of second derivatives; where there are more, steps are those of the tableau
    order = None if order is not None and len(form.moving) > 1 and products(form, order) > 36_000 else order
    own = jax.custom_jvp(kernel(form, method, order).motion)

    @partial(own.defjvp, symbolic_zeros=True)
    def rule(primals, tangents):
        (start,), (along,) = primals, tangents
        if not all(map(is_zero, along.of_samples[:1])):
            raise DifferentiationModeError(OF_SAMPLES)
        check_derivatives(replace(form, moving=(), time_moves=False), (len(form.moving) + 1).bit_length())
        raised, more = with_tangents(form, start, along)
        times = None if is_zero(along.goals) and is_zero(along.origin) else (filled(along.goals), filled(along.origin))
        if times is not None:
            before = rates(form)(start, (jnp.zeros(()),) * len(start.y))
            more = more._replace(y=(*start.y, *(dy - scaled(f, times[1]) for dy, f in zip(more.y[len(start.y) :], before, strict=True))))
        both = flow(replace(raised, time_moves=form.has_events and len(start.y) > 1), method, order)(more)
        found, d = (Found(*(part[half] for part in both[:3]), both.rest) for half in (slice(len(start.y)), slice(len(start.y), None)))
        if times is not None:
            d = _along_times(form, start, found, d, *times)
        return found, d._replace(rest=jnp.zeros_like(found.rest))

    return own


def _along_times(form: Form, start: Start, found: Found, d: Found, goals, origin) -> Found:
    """A tangent with what those of the goals and of the start's time add to it."""
    code, accepted, count = found.rest[1], found.rest[2], found.rest[-1]
    reached = (jnp.arange(len(start.goals)) < count) | (start.goals == found.t[0])
    at = on_times(start, Stopped(found.y, reached, found.t[0], (code == results.EVENT) & (accepted > 0)))
    absolute, slopes = at.absolute(goals, origin), slopes_of(form, start, found.y, at)
    states = tuple(dy + jax.vmap(scaled)(f, absolute) for dy, f in zip(d.y, slopes, strict=True))
    end = tuple(dy + scaled(f[-1], absolute[-1]) for dy, f in zip(d.end, slopes, strict=True))
    t = jnp.where(at.event, d.t[0] - origin, jnp.where(at.by_goal[-1], goals[-1], 0.0))
    return d._replace(y=states, end=end, t=(t, *d.t[1:]))


class Stopped(NamedTuple):
    """A motion as its derivatives with respect to times see it."""

    y: tuple[Float[Array, "times y"], ...]  # at the goals, the last of which is the end
    reached: Bool[Array, "times"]
    t: Float[Array, ""]  # of the end
    event: Bool[Array, ""]  # whether a stop event ended it on its way


class OnTimes(NamedTuple):
    """How the states at the goals, the last of which is the end, depend on times."""

    t: Float[Array, "times"]
    by_goal: Bool[Array, "times"]  # whether the time is the goal
    event: Bool[Array, ""]

    def absolute(self, goals, origin) -> Float[Array, "times"]:
        """Tangents of the times themselves, not since the start, from those of the goals and of the start's time; of an event, the loop has found them."""
        return jnp.where(self.by_goal, goals + origin, jnp.where(self.event, 0.0, origin))


def on_times(start: Start, found: Stopped) -> OnTimes:
    """How the states that were found depend on times."""
    by_goal = found.reached & ~(found.event & (start.goals == found.t))
    return OnTimes(jnp.where(by_goal, start.goals, found.t), by_goal, found.event)


def slopes_of(form: Form, start: Start, states: tuple, at: OnTimes) -> tuple[Float[Array, "times y"], ...]:
    """The rates of states, and of their tangents, at their times."""

    def slopes(y, t):
        return rates(form)(start._replace(y=y), (t, *[jnp.zeros(())] * (len(y) - 1)))

    return jax.vmap(slopes)(states, at.t)


def rates(form: Form) -> Callable[[Start, tuple], tuple]:
    """The rates of a state, and of its tangents, as a function of the state in the place of a start and of its time, which has tangents too."""
    n = form.layout.y
    run = kernel_of_rates(replace(form, time_moves=len(form.moving) > 0))

    @jax.custom_jvp
    def own(state: Start, t: tuple) -> tuple:
        found = run(*state.of_samples, state.rows(t[0], t[1:]), t[0][None])
        return tuple(found[k * n : (k + 1) * n] for k in range(len(t)))

    @partial(own.defjvp, symbolic_zeros=True)
    def rule(primals, tangents):
        (state, t), (along, dt) = primals, tangents
        raised, more = with_tangents(form, state, along)
        dt = [filled(x) for x in dt]
        dt[0] = dt[0] + filled(along.origin)
        found = rates(raised)(more, (*t, *dt))
        return found[: len(t)], found[len(t) :]

    return own


def with_tangents(form: Form, start: Start, along: Start) -> tuple[Form, Start]:
    """The form and the start that have these tangents too."""
    every = (tuple(range(len(start.known[0]))), *form.moving)
    moves = [[not is_zero(dx) for dx in part] for part in along.known]
    moving = tuple(tuple(i for i, does in zip(of, part, strict=True) if does) for of, part in zip(every, moves, strict=True))
    known = tuple(tuple(dx for dx in part if not is_zero(dx)) for part in along.known)
    more = start._replace(y=(*start.y, *map(filled, along.y)), known=(*start.known, *known))
    return replace(form, moving=(*form.moving, *moving)), more


def is_zero(tangent) -> bool:
    """Whether nothing changes."""
    return isinstance(tangent, SymbolicZero)


def filled(tangent):
    """The tangent as an array."""
    return jnp.zeros(tangent.shape, tangent.dtype) if is_zero(tangent) else tangent


@jax.custom_jvp
def scaled(slope: Float[Array, "y"], by: Float[Array, "..."]) -> Float[Array, "y"]:
    """Their product; zero, whatever the slope, where it is multiplied by zero."""
    return jnp.where(by == 0.0, 0.0, slope * by)


@scaled.defjvp
def _scaled_jvp(primals: Sequence, tangents: Sequence):
    return scaled(*primals), scaled(tangents[0], primals[1]) + scaled(primals[0], tangents[1])
