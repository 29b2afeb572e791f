"""Coordinates that may be dropped: cyclic ones (in the paper's sense) and ignorable ones, found by probing.

A dependent coordinate (its rate is no privileged velocity) is *cyclic* when nothing of the following depends on it, all of it
in the inertial frame and in the privileged velocities y: B and b of `qdot = B y + b`, the partial velocities beta and partial
angular velocities gamma, the inertias R I R' of the bodies, the impressed forces and torques, those on speeds, the potential's
gradient. (What no beta depends on, no betadot depends on either.) In these axes the spin of an axisymmetric wheel is cyclic.

A coordinate is *ignorable* when the privileged accelerations do not depend on it: a symmetry, and a weaker statement.
Source: Wang and Pao (2003), eq. (42), for cyclic coordinates.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jourdain_jax.build.reference_parameters import once_per_values
from jourdain_jax.build.sampling import sample_states
from jourdain_jax.build.structure import structure_of
from jourdain_jax.dynamics.newton_euler import potential_resultants
from jourdain_jax.eager.eager import eval_numpy
from jourdain_jax.equations.kinematics import coordinate_rates
from jourdain_jax.equations.minimal import accelerations_of, minimal_kinematics
from jourdain_jax.equations.virtual_power import resultants
from jourdain_jax.scene.scene import Scene

PROBES = 8
DISPLACEMENT = 0.1
DEPENDS = 1e-9  # change relative to the size of the quantity; larger means that the quantity depends on the coordinate


class Dependence(eqx.Module):
    """What depends on which coordinate (columns), anywhere among the probed states."""

    cyclic_quantities: Bool[np.ndarray, "coordinates"]  # anything of what a cyclic coordinate must not appear in
    rates: Bool[np.ndarray, "coordinates coordinates"]  # B y + b, row by row
    accelerations: Bool[np.ndarray, "coordinates"]  # the privileged accelerations
    privileged: Bool[np.ndarray, "coordinates"]  # whether the coordinate's own rate is a privileged velocity


def cyclic_coordinates(scene: Scene) -> tuple[str, ...]:
    """Dependent coordinates that appear neither in B, b, beta, gamma, R I R' nor in the impressed forces.

    None where rows are nonlinear in the speeds. A quaternion is never cyclic: its own rate depends on it.
    """
    if not structure_of(scene).affine:
        return ()
    found = dependence(scene)
    return _named(scene, ~found.cyclic_quantities & ~found.privileged)


def ignorable_coordinates(scene: Scene) -> tuple[str, ...]:
    """Coordinates that the privileged accelerations do not depend on; a quaternion is named whole.

    None where rows are nonlinear in the speeds.
    """
    if not structure_of(scene).affine:
        return ()
    return _named(scene, ~dependence(scene).accelerations)


def _named(scene: Scene, chosen) -> tuple[str, ...]:
    """Names of the chosen coordinates; of a quaternion its own name where all four are chosen, none otherwise."""
    names: list[str] = []
    groups = {first: group for group, first, _ in scene.coordinate_names.groups}
    skipped: set[int] = set()
    for i, name in enumerate(scene.coordinate_names.entries):
        if i in groups:
            skipped |= set(range(i, i + 4))
            names += [groups[i]] if chosen[i : i + 4].all() else []
        elif i not in skipped and chosen[i]:
            names.append(name)
    return tuple(names)


@once_per_values
def dependence(scene: Scene) -> Dependence:
    """What depends on which coordinate: what changes when that coordinate alone is displaced, at random states.

    The states lie off the geometric rows, so that a coordinate is not found absent only because its value is held. Rows must be
    affine in the speeds.
    """
    generator = np.random.default_rng(0)
    t, q, u = sample_states(scene, PROBES)
    q = q + DISPLACEMENT * generator.uniform(-1, 1, q.shape)
    shifts = DISPLACEMENT * generator.uniform(0.5, 1, q.shape)
    values, one_speed = _probe(scene, t, q, u, shifts)
    changed = {name: _changed(value) for name, value in values.items()}
    appears = [changed[name].any(axis=0) for name in values if name not in ("rates", "accelerations")]
    return Dependence(np.any(appears, axis=0), changed["rates"], changed["accelerations"].any(axis=0), one_speed.all(axis=0))


def _changed(values: np.ndarray) -> Bool[np.ndarray, "entries coordinates"]:
    """Which entries change with which coordinate at any state; values (states, 1 + coordinates, entries), undisplaced ones first."""
    size = np.max(np.abs(values), initial=np.finfo(values.dtype).tiny)
    limit = DEPENDS if values.dtype == np.float64 else 1e-4
    return ~np.all(np.abs(values[:, 1:] - values[:, :1]) <= limit * size, axis=0).T  # NaN counts as a change


@eval_numpy
def _probe(scene: Scene, t, q, u, shifts):
    """Quantities by name at every state, undisplaced and with one coordinate after another displaced; whose rate is one speed."""

    def one(t, q, u, shifts):
        displaced = q + jnp.concatenate([jnp.zeros((1, q.shape[0])), jnp.diag(shifts)])
        values = jax.vmap(lambda q: _quantities(scene, t, q, u))(displaced)
        B = values["B and b"][0, : q.shape[0] * len(independent)].reshape(q.shape[0], -1)
        b = values["B and b"][0, B.size : B.size + q.shape[0]]
        one_speed = (jnp.max(B, axis=1, initial=0.0) == 1) & (jnp.sum(jnp.abs(B), axis=1) == 1) & (b == 0)
        return values, one_speed

    independent = structure_of(scene).independent
    return jax.vmap(one)(t, q, u, shifts)


def _quantities(scene: Scene, t, q, u) -> dict[str, Float[Array, "entries"]]:
    """The rates `B y + b`, the privileged accelerations, and what a cyclic coordinate must not appear in (inertial frame)."""
    chosen = np.array(structure_of(scene).independent, int)
    y = u[chosen]
    known = minimal_kinematics(scene, tuple(chosen.tolist()), t, q, y)
    motion, found = accelerations_of(scene, known, t, q)
    C = known.c[:, None] * known.split.C / known.c[chosen]
    N = jax.jacfwd(lambda u: coordinate_rates(scene, t, q, u))(u)
    B = N @ C
    # what is left of speeds and rates at y = 0
    c, b = known.u - C @ y, motion.qdot.array - B @ y
    bodies = motion.bodies.values()
    velocities = jnp.concatenate([jnp.concatenate([body.velocity, body.angular_velocity]) for body in bodies])
    turned = jnp.stack([body.orientation for body in bodies])
    inertia = jnp.einsum("bij,bjk,blk->bil", turned, known.weights.inertia, turned)
    beta, gamma = known.partial.bodies.linear @ C, jnp.einsum("bij,bjk->bik", turned, known.partial.bodies.angular @ C)
    loads, potential = resultants(scene, motion), potential_resultants(scene, motion)
    forces = [loads.force, loads.torque, loads.direct @ C, potential.force, potential.torque, potential.direct @ C]
    return {
        "rates": motion.qdot.array,
        "accelerations": jnp.concatenate([found.udot[chosen], y]),  # y, which depends on nothing, gives free motion a size
        "B and b": jnp.concatenate([B.ravel(), b, C.ravel(), c]),
        "beta and gamma": jnp.concatenate([velocities, beta.ravel(), gamma.ravel()]),
        "inertia": inertia.ravel(),
        "forces": jnp.concatenate([part.ravel() for part in forces]),
    }
