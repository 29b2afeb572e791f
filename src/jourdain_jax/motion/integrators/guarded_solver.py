"""A diffrax solver whose every step ends on the constraints, and is checked between its ends too.

The projection changes the end of the step, so the slope that first-same-as-last methods (Tsit5, Dopri) carry over is out of date: the
next step is told that there was a jump, and recomputes it. What the projection removes is an error that the embedded estimate does not see: the
larger of both counts. A step in which a pivot changes its sign, at its middle or its end, has an infinite error. Constant steps cannot be tried again:
what was seen in them is kept for the result code.
"""

from collections.abc import Callable

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from jourdain_jax.motion.integrators.erk_step import removed
from jourdain_jax.motion.integrators.wrapping_solver import WrappingSolver

_REST = 1e-6  # of the size of the state: a step that changes less counts as one that changes so much


class Seen(eqx.Module):
    """What the accepted steps showed."""

    lowest: Float[Array, "pivots"]
    highest: Float[Array, "pivots"]
    projected: Float[Array, ""]  # the largest projection in any step, relative to the change by that step

    @property
    def pivot(self) -> Float[Array, ""]:
        """The smallest magnitude of a pivot, negative where one changed its sign; infinite where there are none."""
        smallest = jnp.minimum(jnp.abs(self.lowest), jnp.abs(self.highest))
        return jnp.min(jnp.where(self.lowest * self.highest < 0, -smallest, smallest), initial=jnp.inf)


class GuardedSolver(WrappingSolver):
    """`solver`, followed by `project(t, y, args)` after every step, while `pivots(t, y, args)` must keep their signs; None: there is no such function.

    `within(t, args)`: the `args` for the stages of a step with the middle t, where they are not the same in all steps; then no slope is carried over, either.
    """

    solver: diffrax.AbstractSolver
    project: Callable | None
    pivots: Callable | None
    within: Callable | None

    def init(self, terms, t0, t1, y0, args):
        """The state of the wrapped solver, and what is seen at the start."""
        pivots = self._pivots_at(_time(terms, t0, t1, t0), y0, args)
        return self.solver.init(terms, t0, t1, y0, args), Seen(pivots, pivots, jnp.zeros_like(jax.lax.stop_gradient(t0)))

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        """One step of the wrapped solver, then the projection."""
        inner, seen = solver_state
        made_jump = made_jump if self.project is None and self.within is None else True
        in_step = args if self.within is None else self.within(_time(terms, t0, t1, 0.5 * (t0 + t1)), args)
        y1, error, dense, inner, result = self.solver.step(terms, t0, t1, y0, in_step, inner, made_jump)
        if self.project is not None:
            free, y1 = y1, self.project(_time(terms, t0, t1, t1), y1, args)
            moved = jax.tree.map(lambda a, b: jax.lax.stop_gradient(jnp.abs(a - b)), y1, free)
            seen = eqx.tree_at(lambda s: s.projected, seen, jnp.maximum(seen.projected, _relative(moved, y0, y1)))
            error = None if error is None else jax.tree.map(lambda e, m: jnp.maximum(jnp.abs(e), m), error, removed(y1, free, 0))
        if self.pivots is not None:
            middle = self.interpolation_cls(t0=t0, t1=t1, **dense).evaluate(t0 + 0.5 * (t1 - t0))
            inside = jnp.stack([self._pivots_at(_time(terms, t0, t1, t), y, args) for t, y in ((t0 + 0.5 * (t1 - t0), middle), (t1, y1))])
            changed = jnp.any(inside * jnp.where(seen.lowest < 0, seen.highest, seen.lowest) < 0)
            # what is not a number is a failure of its own, and hides nothing that was seen before
            lowest, highest = jnp.fmin(seen.lowest, jnp.fmin(*inside)), jnp.fmax(seen.highest, jnp.fmax(*inside))
            seen = Seen(lowest, highest, seen.projected)
            error = None if error is None else jax.tree.map(lambda e: jnp.where(changed, jnp.inf, e), error)
        return y1, error, dense, (inner, seen), result

    def _pivots_at(self, t, y, args) -> Float[Array, "pivots"]:
        return jnp.zeros(0) if self.pivots is None else jax.lax.stop_gradient(self.pivots(t, y, args))


def _time(terms, t0, t1, t) -> Float[Array, ""]:
    """A time of a step from t0 to t1; diffrax counts time along the direction of the motion."""
    return t * jnp.sign(terms.contr(t0, t1))


def _relative(moved: PyTree, y0: PyTree, y1: PyTree) -> Float[Array, ""]:
    """How large a projection is, relative to the change from y0 to y1: the largest ratio of any part of the state."""
    ratios = []
    for part, before, after in zip(*map(jax.tree.leaves, (moved, y0, y1)), strict=True):
        change = jnp.max(jnp.abs(after - before), initial=0.0) + _REST * (1 + jnp.max(jnp.abs(after), initial=0.0))
        ratios.append(jnp.max(part, initial=0.0) / change)
    return jax.lax.stop_gradient(jnp.max(jnp.stack(ratios)))
