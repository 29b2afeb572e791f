"""Whether the energy of a motion changed by more than errors of its steps explain: a result code, inside `jit` and in every lane.

Where nothing does work that no potential accounts for, T + V is constant for a right motion. Step-size control leaves in each number y of the state an
error of about `atol + rtol |y|` per step. With dE the change of the energy by errors of that size in all numbers together, N steps change the energy by some
N dE, and round-off by some N eps of it. Over all models, at tolerances from 1e-4 to 1e-11, no drift is larger than half of N dE (`bench/energy_drift.py`);
ten times as much, and at least 1 % of the energy that moves, means that the motion is not that of the scene: it went through a singular position, or over
a feature, without notice.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jourdain_jax.motion.integrators.implicit_steps import FixedStepMethod
from jourdain_jax.motion.setup import Setup
from jourdain_jax.motion.vector_fields.field import Integrated

MOST_STEP_ERRORS = 10  # times what N steps at their tolerance change
DRIFTED = 1e-2  # of the energy that moves


def conserves(setup: Setup) -> bool:
    """Whether T + V is constant along a motion whose steps are taken by tolerances.

    Integrated work is no part of the check: it may be the small rest of large powers, whose errors nothing at the ends of steps bounds.
    """
    return setup.field.conserves and not isinstance(setup.integrator.solver, FixedStepMethod)


def energies_near(setup: Setup, args, t: Float[Array, "times"], y: Integrated) -> Float[Array, "2 times 2"]:
    """T and V (J) at states, and both where each number is larger by the error that a step may leave in it."""
    field, scene, inputs, fixed, _ = args
    rtol, atol = setup.tolerances
    off = jax.tree.map(lambda x: x + jnp.where(x < 0, -1.0, 1.0) * (atol + rtol * jnp.abs(x)), y)
    every = jax.tree.map(lambda a, b: jnp.concatenate([a, b]), *jax.lax.stop_gradient(((t, y), (t, off))))
    at = lambda state: field.energies(scene, fixed, state[0], state[1], inputs(state[0]))  # noqa: E731
    # loads by matrices may be callbacks, which need not know batches
    found = jax.lax.map(at, every) if field.lowered is None else jax.vmap(at)(every)
    return found.reshape(2, -1, 2)


def energy_lost(energies: Float[Array, "2 times 2"], steps) -> Bool[Array, ""]:
    """Whether T + V changed by more than N `steps` explain."""
    (T, V), off = energies[0].T, energies[1].T
    error = jnp.abs(off[0] - T) + jnp.abs(off[1] - V) + jnp.finfo(T.dtype).eps * (T + jnp.abs(V))
    moved = jnp.nanmax(T) + jnp.nanmax(V) - jnp.nanmin(V)
    allowed = jnp.fmax(DRIFTED * moved, MOST_STEP_ERRORS * steps * jnp.nanmax(error))
    return jnp.nanmax(T + V) - jnp.nanmin(T + V) > allowed
