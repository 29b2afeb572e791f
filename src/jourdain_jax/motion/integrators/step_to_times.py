"""Step-size control that ends a step at every given time.

Where less than two steps are left to the next time, the step covers half of the rest, so that no tiny step remains, which would be taken for a step size
that shrank to nothing. A step that would cover nearly all of the rest is stretched to cover it.
"""

import diffrax
import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PyTree

from jourdain_jax.motion.integrators.wrapping_solver import of_wrapped

NEARLY = 0.999  # of the way: such a step is stretched to the end


def step_to_times(ts: Float[Array, "times"], controller: diffrax.AbstractStepSizeController) -> diffrax.AbstractStepSizeController:
    """`controller`, made to end a step at each of the times `ts` (monotonic, in the direction of the motion)."""
    kind = _LandOnAdaptive if isinstance(controller, diffrax.AbstractAdaptiveStepSizeController) else _LandOn
    return kind(controller, ts)


def merged(ts: Float[Array, "times"], more: Float[Array, "more"], direction) -> Float[Array, "all"]:
    """Both, in the order of the motion."""
    return jnp.sort(jnp.concatenate([ts, more]) * direction) * direction


def time_ahead(ts: Float[Array, "times"], index: Int[Array, ""]) -> Float[Array, ""]:
    """The time with this `index` among `ts`; infinity beyond the last."""
    count = ts.shape[0]
    return jnp.where(index < count, ts[jnp.minimum(index, count - 1)], jnp.inf)


class _State(eqx.Module):
    index: Int[Array, ""]  # of the next time
    inner: PyTree


class _Landing(eqx.Module):
    """What both kinds share."""

    controller: eqx.AbstractVar[diffrax.AbstractStepSizeController]
    ts: eqx.AbstractVar[Float[Array, "times"]]

    def wrap(self, direction):
        """Times count along the direction of the motion from here on."""
        return type(self)(self.controller.wrap(direction), self.ts * direction)

    def init(self, terms, t0, t1, y0, dt0, args, func, error_order):
        """The first step of the controller, or to the first time."""
        t1, inner = self.controller.init(terms, t0, t1, y0, dt0, args, func, error_order)
        index = jnp.sum(self.ts <= t0)
        return self._aimed(index, t0, t1), _State(index, inner)

    def adapt_step_size(self, t0, t1, y0, y1_candidate, args, y_error, error_order, controller_state):
        """The next step of the controller, or to the next time."""
        keep, next_t0, next_t1, jumped, inner, result = self.controller.adapt_step_size(
            t0, t1, y0, y1_candidate, args, y_error, error_order, controller_state.inner
        )
        index = controller_state.index
        arrived = keep & (t1 >= time_ahead(self.ts, index))
        index = index + arrived.astype(index.dtype)
        return keep, next_t0, self._aimed(index, next_t0, next_t1), jumped, _State(index, inner), result

    def _aimed(self, index, t0, t1):
        goal = time_ahead(self.ts, index)
        rest, step = goal - t0, t1 - t0
        short = jnp.where(2 * step > rest, t0 + 0.5 * jnp.where(jnp.isfinite(rest), rest, 0.0), t1)
        return jnp.where(step >= NEARLY * rest, goal, short)


class _LandOn(_Landing, diffrax.AbstractStepSizeController):
    controller: diffrax.AbstractStepSizeController
    ts: Float[Array, "times"]


class _LandOnAdaptive(_Landing, diffrax.AbstractAdaptiveStepSizeController):
    controller: diffrax.AbstractAdaptiveStepSizeController
    ts: Float[Array, "times"]

    rtol, atol, norm = (of_wrapped("controller", name) for name in ("rtol", "atol", "norm"))
