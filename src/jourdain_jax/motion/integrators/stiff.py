"""Stiff motions: how fast what decays decays, against the steps that an explicit solver takes.

An explicit method of a step h follows a mode exp(-r t) only while h r stays below a small number (about 3 for Tsit5, 6 for Dopri8), however
little of the mode is left. A motion that ran out of steps with h r near that number ran out of them for stability: `h r >= 1` is called stiff here.
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from jourdain_jax.calculus.reals import is_traced
from jourdain_jax.motion.trajectories import results
from jourdain_jax.motion.trajectories.trajectory import Trajectory
from jourdain_jax.motion.vector_fields.field import VectorField

OUT_OF_STEPS = (results.MAX_STEPS, results.SHRANK)
_SHARE = 10  # a step of the implicit solver costs tens of explicit ones: it gets a tenth of the number


def is_stiff(field: VectorField, motion: Trajectory, t0) -> bool:
    """Whether stability kept the steps of a `motion` from `t0` short that ran out of them; False where its numbers are not known."""
    if int(motion.result) not in OUT_OF_STEPS or int(motion.accepted) == 0:
        return False
    field, motion, t0 = (jax.tree.map(lambda x: jax.lax.stop_gradient(x) if eqx.is_array(x) else x, x) for x in (field, motion, t0))
    if is_traced((field, motion, t0)):
        return False
    step = float(motion.last_step)
    step = abs(float(motion.t_end) - float(t0)) / int(motion.accepted) if np.isnan(step) else step
    J = np.asarray(_jacobian(field, motion)) * np.sign(float(motion.t_end) - float(t0))
    return bool(np.all(np.isfinite(J)) and step * np.max(-np.linalg.eigvals(J).real, initial=0.0) >= 1)


def implicit_steps(max_steps: int) -> int:
    """How many steps the implicit solver may take where an explicit one was given `max_steps`."""
    return max(1, max_steps // _SHARE)


@eqx.filter_jit
def _jacobian(field: VectorField, motion: Trajectory) -> Float[Array, "state state"]:
    """Derivative of the rates at the end state, with respect to the state without the work."""
    scene, t, inputs = motion.scene, motion.t_end, motion.inputs
    y = field.pack(motion.q_end, motion.u_end)
    x, unravel = ravel_pytree((y.q, y.v))
    fixed = field.fixed(scene)

    def rates(x):
        q, v = unravel(x)
        found = field.rates(scene, fixed, t, dataclasses.replace(y, q=q, v=v), field.now(inputs, t))
        return jnp.concatenate([found.q, found.v])

    return jax.jacfwd(rates)(x)
