"""Drift of energy and constraints along a motion. It sets result codes, also inside `jit` and for each sample
of a batch.

*Energy.* If all work comes from a potential, T + V is constant. Step-size control leaves an error of about
`atol + rtol |y|` per step in each number y of the state. If errors of this size in all numbers change the
energy by dE, N steps change it by about N dE, and round-off by about N eps of it. Over all models, at
tolerances from 1e-4 to 1e-11, no drift exceeded half of N dE. A drift of ten times N dE and at least 1 % of
the varying energy therefore means an error, such as an unnoticed singular position.

*Constraints.* Redundant constraints that the start satisfies may contradict each other later, unless
phi_0 = 0:

    A u + phi_0 = 0,   rank A < number of rows

An omitted constraint then holds only if phi_0 is in the range of A.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jourdain_jax.calculus.reals import Flag, Scalar, eps_of
from jourdain_jax.equations.projection import linearised_rows
from jourdain_jax.integrate.explicit_steps import off
from jourdain_jax.integrate.implicit_steps import FixedStepMethod
from jourdain_jax.integrate.setup import Setup
from jourdain_jax.integrate.vector_fields.field import ByProgram, Instant, Integrated
from jourdain_jax.motion.trajectories import diagnostics


def step_errors(setup: Setup, free: Integrated, y: Integrated) -> Scalar:
    """Return the distance by which a projection moved a state from `free` to `y`, in tolerances of a step."""
    rtol, atol = setup.tolerances
    parts = jax.lax.stop_gradient(((free.q, y.q), (free.v, y.v)))
    return jnp.max(
        jnp.stack([jnp.max(jnp.abs(a - b) / (atol + rtol * jnp.abs(b)), initial=0.0) for a, b in parts])
    )


MOST_STEP_ERRORS = 10  # times the change from N steps at their tolerance


def conserves(setup: Setup) -> bool:
    """Return whether T + V is constant along a motion with step-size control.

    False if work is integrated: it may be a small difference of large powers, so step-size control does not
    bound its error.
    """
    return (
        setup.field.conserves
        and all(setup.field.stops)
        and not isinstance(setup.integrator.solver, FixedStepMethod)
    )


def energies_near(setup: Setup, args, t: Float[Array, "times"], y: Integrated) -> Float[Array, "2 times 2"]:
    """Return T and V (J) at states, and again with each coordinate and speed increased by
    the possible error of a step.
    """
    field, (*_, inputs, fixed, _) = setup.field, args

    def at(state):
        t, y = state
        here = Instant(setup.scene, fixed, t, y, inputs(t))
        if isinstance(field, ByProgram) and field.native:
            return field.native.energies(*here.of_program, *setup.tolerances).reshape(2, 2)
        both = jax.tree.map(lambda x: jnp.stack([x, off(jnp.where, jnp.abs, x, *setup.tolerances)]), y)
        return jax.lax.map(lambda y: field.energies(here._replace(y=y)), both)

    # loads of dense matrices may be callbacks without batching
    states = jax.lax.stop_gradient((t, y))
    found = jax.lax.map(at, states) if field.lowered is None else jax.vmap(at)(states)
    return jnp.moveaxis(found, 1, 0)


def energy_lost(energies: Float[Array, "2 times 2"], steps) -> Flag:
    """Return whether T + V changed by more than the errors of N `steps` explain."""
    at, off = energies
    T, V = at.T
    E, error = T + V, jnp.sum(jnp.abs(off - at) + eps_of(at) * jnp.abs(at), axis=1)
    most = jax.lax.reduce(jnp.stack([T, V, -V, error, E, -E]), -jnp.inf, jnp.fmax, (1,))  # ignores NaN
    return most[4] + most[5] > jnp.fmax(
        diagnostics.DRIFTED * jnp.sum(most[:3]), MOST_STEP_ERRORS * steps * most[3]
    )


def rows_violated(
    setup: Setup,
    t: Float[Array, "times"],
    q: Float[Array, "times coordinates"],
    u: Float[Array, "times speeds"],
) -> Flag:
    """Return whether some constraint is violated at some of these states, ignoring unreached ones (NaN).

    |phi| > 1 % of max over time of (|phi - A u| + |A| |u|)
    """
    scene, inputs, states = jax.lax.stop_gradient((setup.scene, setup.inputs, (t, q, u)))

    def left_and_size(state):
        phi, A = linearised_rows(scene, *state, inputs(state[0]))
        return jnp.abs(phi), jnp.abs(phi - A @ state[2]) + jnp.abs(A) @ jnp.abs(state[2])

    left, size = jax.lax.map(left_and_size, states)  # constraints may be callbacks without batching
    # 1 % is far more than steps at loose tolerances leave
    return jnp.any(left > 1e-2 * jnp.nanmax(size, axis=0))
