"""Coordinates recovered by quadrature, outside of what decides the step size: `simulate(..., recover="quadrature")`.

    r_1 = r_0 + h sum b_i f(t + c_i h, y_i, k_i, r_i)      by the same stages: of the order of the method, and nothing is evaluated twice

The step-size control sees only what the recoverable coordinates r do not enter: speeds and the other coordinates k. Where these hardly change, steps may
become too long for r (the track of a disc on a circle), so the largest error of r in one step is recorded, relative to what the control would let pass.
"""

from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jourdain_jax.motion.state_form import Integrated, StateForm
from jourdain_jax.scene.names import nearest

WAYS = ("quadrature",)
TOO_LONG = 10.0  # times what the control lets pass: then a motion warns


def recovering(form: StateForm, recover: str | None, options) -> StateForm:
    """The form with the coordinates that are recovered; ValueError where the way asked for is unknown or does not apply.

    `recover`: as in `simulate`; `options`: those of the integration.
    """
    if recover is None:
        return form
    if recover not in WAYS:
        raise ValueError(f"`recover` is {recover!r}, expected None or 'quadrature'; {nearest(str(recover), WAYS)}")
    program = form.lowered
    if program is None:
        raise ValueError(
            "recover='quadrature' needs the scalar program of the scene, which says what depends on which coordinate, and this motion is integrated by "
            "dense matrices; leave `lowering`, `reduction` and `stabilisation` at their defaults, or `recover` (`jj.report` says why a scene has none)"
        )
    if not options.lean:
        raise ValueError(
            "recover='quadrature' belongs to the step-size control of the default solvers; leave `solver`, `stepsize_controller`, `saveat` and `land_on_ts` "
            "at their defaults (an `adjoint` may be RecursiveCheckpointAdjoint or ForwardMode), or leave `recover`"
        )
    if options.event_names and not program.events:
        raise ValueError("the stop events of this scene have no scalar form and may depend on any coordinate; pass events=False, or leave `recover`")
    found = program.recoverable(bool(options.event_names), form.projects_positions or form.projects_speeds)
    something_left = len(found) < len(program.qdot) or program.ydot
    return replace(form, recovered=found if something_left else ())


class LargestError(eqx.Module):
    """The largest error of the chosen coordinates, per lane; infinite where it is not a number."""

    chosen: tuple[int, ...] = eqx.field(static=True)

    def __call__(self, error: Integrated) -> Float[Array, "*lanes"]:
        size = jnp.where(is_among(self.chosen, error.q), jnp.abs(error.q), 0.0)
        return jnp.max(jnp.where(jnp.isnan(size), jnp.inf, size), axis=0)


def is_among(chosen: tuple[int, ...], q: Float[Array, "coordinates *lanes"]) -> Bool[np.ndarray, "coordinates *ones"]:
    """Which coordinates are among the chosen ones, to be broadcast against `q`."""
    return np.isin(np.arange(q.shape[0]), chosen).reshape(-1, *(1,) * (q.ndim - 1))
