"""What is looked at of a scene at each probed state, by JAX: for scenes that have no scalar form (the others: `probed_on_graph`)."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, PyTree

from jourdain_jax.build.assembling import Assembled, assemble, without_rows
from jourdain_jax.build.domain import coordinate_bounds
from jourdain_jax.build.plausibility import PoseNumbers, pose_numbers
from jourdain_jax.build.trace import Entries, explicit_rates, potentials_of
from jourdain_jax.eager.eager import eval_numpy
from jourdain_jax.equations.kinematics import coordinate_rates, inertias, motion_at, pose_at, velocities
from jourdain_jax.equations.projection import closure_residual
from jourdain_jax.equations.rows import names_of_position_rows, position_residual, velocity_residual
from jourdain_jax.equations.virtual_power import mass_matrix_at
from jourdain_jax.scene.scene import Scene

TIMED = ("rows", "poses", "inertias", "coordinate rates", "loads", "potential")


class Probed(eqx.Module):
    """At one state, or with a leading axis at all; trees have arrays as leaves."""

    q: Float[Entries, "*states coordinates"]  # on the geometric rows
    position_error: Float[Entries, "*states"]  # of these rows, as the next two from `Assembled`
    error: Float[Entries, "*states"]  # of the coordinates
    outside: Float[Entries, "*states"]  # of the domain
    A: Float[Entries, "*states rows speeds"]
    A_other: Float[Entries, "*states rows speeds"]  # at other speeds
    A_beyond: Float[Entries, "*states rows speeds"]  # at the coordinates as they were before they were put on the geometric rows
    M: Float[Entries, "*states speeds speeds"]
    phi_at_rest: Float[Entries, "*states rows"]  # at u = 0
    motion_at_rest: PyTree  # velocities and coordinate rates at u = 0
    timed: dict[str, PyTree]  # rates in time by `TIMED`, while coordinates, speeds and inputs are held (for loads and potentials: the motion)
    inertia_rates: PyTree  # along the motion
    potential_rates: Float[Entries, "*states loads"]  # of each load's potential, along a generic change of the inputs
    row_rates_of_inputs: Float[Entries, "*states rows"]  # along the same change
    numbers: PoseNumbers
    unproved: frozenset[str] = eqx.field(static=True, default=frozenset())  # what may be other than zero where no probe lies


def generic_inputs(scene: Scene) -> np.ndarray:
    """Values of inputs at which no term passes for absent."""
    return np.linspace(0.5, 1.0, len(scene.inputs))


def probed(scene: Scene, t, q, u, u_other, generic, far: int = 0) -> Probed:
    """The scene at states (t, q, u), put on the geometric rows; and its rows at `u_other`. `generic`: which states are random ones.

    The last `far` states are meant to be far from the domain.
    """
    found = assembled_by_jax(scene, t, q, generic, far)
    return _probed(scene, t, found.q, np.asarray(q, found.q.dtype), u, u_other, found.position_error, found.error, found.outside)


def assembled_by_jax(scene: Scene, t, q, generic, far: int = 0) -> Assembled:
    """Coordinates on geometric rows and unit norms, inside the domain where that can be."""
    q = np.array(q, float)
    for first, _ in scene.coordinates.quaternions:
        length = np.linalg.norm(q[:, first : first + 4], axis=1, keepdims=True)
        q[:, first : first + 4] /= np.where(length == 0, 1.0, length)
    if not names_of_position_rows(scene):
        return without_rows(q)

    def look(some, which):  # always at all states: one traced program
        every = np.array(q)
        every[which] = some
        return tuple(np.asarray(x, float)[which] for x in _closures(scene, t, every))

    return assemble(look, q, *coordinate_bounds(scene), generic, far)


@eval_numpy
def _closures(scene: Scene, t, q):
    """Residuals of the geometric rows and unit norms, and their slopes."""

    def one(t, q):
        return closure_residual(scene, t, q), jax.jacfwd(lambda q: closure_residual(scene, t, q))(q)

    return jax.vmap(one)(t, q)


@eval_numpy
def _probed(scene: Scene, t, q, q_beyond, u, u_other, position_error, error, outside) -> Probed:
    def one(t, q, q_beyond, u, u_other, position_error, error, outside):
        inputs = jnp.asarray(generic_inputs(scene), q.dtype)
        A, A_other = (jax.jacfwd(lambda v: velocity_residual(scene, t, q, v, inputs))(v) for v in (u, u_other))
        A_beyond = jax.jacfwd(lambda v: velocity_residual(scene, t, q_beyond, v, inputs))(u)
        at_rest = jnp.zeros_like(u)
        qdot, motion = coordinate_rates(scene, t, q, u), motion_at(scene, t, q, u, inputs)

        def pieces(t):
            poses = [(body.position, body.orientation) for body in pose_at(scene, t, q).bodies.values()]
            rows = velocity_residual(scene, t, q, u, inputs), position_residual(scene, t, q)
            return {"rows": rows, "poses": poses, "inertias": inertias(scene, t, q), "coordinate rates": coordinate_rates(scene, t, q, u)}

        def rows(inputs):
            return velocity_residual(scene, t, q, u, inputs)

        def potentials(inputs):
            return potentials_of(scene, motion_at(scene, t, q, u, inputs))

        return Probed(
            q=q,
            position_error=position_error,
            error=error,
            outside=outside,
            A=A,
            A_other=A_other,
            A_beyond=A_beyond,
            M=mass_matrix_at(scene, t, q),
            phi_at_rest=velocity_residual(scene, t, q, at_rest, inputs),
            motion_at_rest=(velocities(scene, t, q, at_rest), coordinate_rates(scene, t, q, at_rest)),
            timed=jax.jvp(pieces, (t,), (jnp.ones_like(t),))[1] | explicit_rates(scene, motion),
            inertia_rates=jax.jvp(lambda t, q: inertias(scene, t, q), (t, q), (jnp.ones_like(t), qdot))[1],
            potential_rates=jax.jvp(potentials, (inputs,), (inputs**2,))[1],
            row_rates_of_inputs=jax.jvp(rows, (inputs,), (inputs**2,))[1],
            numbers=pose_numbers(scene, t, q),
        )

    return jax.vmap(one)(t, q, q_beyond, u, u_other, position_error, error, outside)
