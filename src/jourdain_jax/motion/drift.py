"""Detect drift of energy and constraints along a motion. Drift sets a result code, even inside `jit` and for
each sample of a batch.

*Energy.* If all work comes from a potential, T + V is constant. Step-size control leaves an error of about
`atol + rtol |y|` per step in each entry y of the state. If errors of this size in all entries change the
energy by dE, then N steps change it by about N dE, and round-off changes it by about N eps of its value. Over
all models, at tolerances from 1e-4 to 1e-11, no drift exceeded half of N dE. A drift of more than ten times
N dE and more than 1 % of the varying energy therefore indicates an error, such as an undetected singular
position.

*Constraints.* Redundant constraints that the start satisfies may contradict each other later, unless
phi_0 = 0:

    A u + phi_0 = 0,   rank A < number of rows

An omitted constraint then holds only if phi_0 is in the range of A.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jourdain_jax.calculus.markers import stopped
from jourdain_jax.calculus.reals import Flag, PerTime, Scalar, eps_of
from jourdain_jax.equations.projection import linearised_rows
from jourdain_jax.integrate.explicit_steps import off
from jourdain_jax.integrate.implicit_steps import FixedStepMethod
from jourdain_jax.integrate.setup import Setup
from jourdain_jax.integrate.vector_fields.field import ByProgram, Instant, Integrated
from jourdain_jax.motion.trajectories import diagnostics


def step_errors(setup: Setup, free: Integrated, y: Integrated) -> Scalar:
    """Return how far a projection moved a state from `free` to `y`, in units of the step tolerance."""
    rtol, atol = setup.tolerances
    parts = jax.lax.stop_gradient(((free.q, y.q), (free.v, y.v)))
    return jnp.max(
        jnp.stack([jnp.max(jnp.abs(a - b) / (atol + rtol * jnp.abs(b)), initial=0.0) for a, b in parts])
    )


MOST_STEP_ERRORS = 10  # numerics: largest drift, as a multiple of the errors of N steps at the tolerance


def conserves(setup: Setup) -> bool:
    """Return whether T + V is constant along a motion with step-size control.

    False if work is integrated: work may be a small difference of large powers, so that step-size control
    does not bound its error.
    """
    return (
        setup.field.conserves
        and all(setup.field.stops)
        and not isinstance(setup.integrator.solver, FixedStepMethod)
    )


def energies_near(
    setup: Setup,
    args,
    states: tuple[PerTime, Float[Array, "times rows"], Float[Array, "times inputs"]],
    of_rows: Callable[[Array], Integrated],
) -> tuple[Float[Array, "times 2"], Float[Array, "times 2"]]:
    """Return T and V (J) at the states, and again with each coordinate and speed increased by its tolerance.

    `states`: times, state vectors, inputs; `of_rows` unpacks a state vector.
    """
    field, fixed = setup.field, args[3]

    def at(state):
        t, rows, inputs = state
        here = Instant(setup.scene, fixed, t, of_rows(rows), inputs)
        if isinstance(field, ByProgram) and field.native:
            return field.native.energies(*here.of_program, *setup.tolerances).reshape(2, 2)
        both = jnp.stack([rows, off(jnp.where, jnp.abs, rows, *setup.tolerances)])
        return jax.lax.map(lambda rows: field.energies(here._replace(y=of_rows(rows))), both)

    # loads in dense matrices may be callbacks that cannot be batched
    states = stopped(states)
    found = jax.lax.map(at, states) if field.lowered is None else jax.vmap(at)(states)
    return found[:, 0], found[:, 1]


def energy_lost(at: Float[Array, "times 2"], near: Float[Array, "times 2"], steps) -> Flag:
    """Return whether T + V changed by more than the errors of `steps` steps can explain. `at`, `near`: the
    two results of `energies_near`.
    """
    errors = jnp.abs(near - at) + eps_of(at) * jnp.abs(at)
    energy, error = at[:, :1] + at[:, 1:], errors[:, :1] + errors[:, 1:]
    every = jnp.concatenate([at, -at, energy, -energy, error], axis=1)
    most = jnp.max(jnp.where(jnp.isnan(every), -jnp.inf, every), axis=0)
    of_potential, of_energy = most[1] + most[3], most[4] + most[5]  # ranges
    allowed = diagnostics.DRIFTED * (most[0] + of_potential), MOST_STEP_ERRORS * steps * most[6]
    return of_energy > jnp.maximum(*allowed)


def rows_violated(
    setup: Setup, t: PerTime, q: Float[Array, "times coordinates"], u: Float[Array, "times speeds"]
) -> Flag:
    """Return whether any constraint is violated at any of these states. Unreached states (NaN) are ignored.

    violated: |phi| > 1 % of the maximum over time of (|phi - A u| + |A| |u|)
    """
    scene, inputs, states = jax.lax.stop_gradient((setup.scene, setup.inputs, (t, q, u)))

    def left_and_size(state):
        phi, A = linearised_rows(scene, *state, inputs(state[0]))
        return jnp.abs(phi), jnp.abs(phi - A @ state[2]) + jnp.abs(A) @ jnp.abs(state[2])

    left, size = jax.lax.map(left_and_size, states)  # constraints may be callbacks that cannot be batched
    # 1 % is far above the residual that steps at loose tolerances leave
    return jnp.any(left > 1e-2 * jnp.nanmax(size, axis=0))
