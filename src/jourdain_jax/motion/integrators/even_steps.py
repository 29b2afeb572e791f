"""Steps of one length: between two saved times, the fewest equal ones no longer than `dt0`.

What structure-preserving methods keep, they keep for steps that do not change. Where saved times are evenly spaced all steps of a motion are
equal, whether or not `dt0` divides the spacing.
"""

import diffrax
import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jourdain_jax.motion.integrators.step_to_times import time_ahead

_WHOLE = 1e-9  # a ratio this little above a whole number counts as that number


class _Steps(eqx.Module):
    index: Int[Array, ""]  # of the saved time ahead
    left: Int[Array, ""]  # steps to it, with the one under way
    longest: Float[Array, ""]


class EvenSteps(diffrax.AbstractStepSizeController):
    """Equal steps between the times `ts` (monotonic, in the direction of the motion), and after the last of them steps of `dt0`."""

    ts: Float[Array, "times"]

    def wrap(self, direction):
        """Times count along the `direction` of the motion from here on."""
        return EvenSteps(self.ts * direction)

    def init(self, terms, t0, t1, y0, dt0, args, func, error_order):
        """The first step; arguments as in diffrax."""
        index = jnp.sum(self.ts <= t0).astype(jnp.int32)
        longest = jnp.asarray(dt0, self.ts.dtype)
        steps = _Steps(index, self._count(index, t0, longest), longest)
        return self._end(steps, t0), steps

    def adapt_step_size(self, t0, t1, y0, y1_candidate, args, y_error, error_order, controller_state):
        """Every step is kept; the next one. Arguments as in diffrax."""
        state = controller_state
        arrived = state.left <= 1
        index = state.index + arrived.astype(jnp.int32)
        left = jnp.where(arrived, self._count(index, t1, state.longest), state.left - 1)
        steps = _Steps(index, left, state.longest)
        return jnp.array(True), t1, self._end(steps, t1), jnp.array(False), steps, diffrax.RESULTS.successful

    def _count(self, index, t, longest) -> Int[Array, ""]:
        rest = time_ahead(self.ts, index) - t
        rest = jnp.where(jnp.isfinite(rest), rest, longest)
        return jnp.maximum(jnp.ceil(rest / longest - _WHOLE), 1).astype(jnp.int32)

    def _end(self, steps: _Steps, t):
        goal = time_ahead(self.ts, steps.index)
        rest = jnp.where(jnp.isfinite(goal), goal - t, steps.longest)
        return jnp.where(steps.left <= 1, jnp.where(jnp.isfinite(goal), goal, t + rest), t + rest / steps.left)
