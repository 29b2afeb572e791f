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

from jourdain_jax.equations.kinematics import coordinate_rates, inertias, motion_at
from jourdain_jax.equations.probing import on_numbers, probed_once
from jourdain_jax.equations.reductions import Partition, Privileged, reduce
from jourdain_jax.equations.rows import velocity_residual
from jourdain_jax.equations.sampling import sample_states
from jourdain_jax.equations.scaling import row_scale
from jourdain_jax.equations.structure import structure_of, usual_rows
from jourdain_jax.equations.virtual_power import equations_and_rows, potential_resultants, resultants
from jourdain_jax.scene.scene import Scene

PROBES = 8
DISPLACEMENT = 0.1
DEPENDS = 1e-9  # change relative to the size of the quantity; larger means that the quantity depends on the coordinate


class AdmissibleRates(eqx.Module):
    """Speeds `u = C y + c` and coordinate rates `qdot = B y + b` in the privileged velocities y."""

    C: Float[Array, "speeds freedoms"]
    c: Float[Array, "speeds"]
    B: Float[Array, "coordinates freedoms"]
    b: Float[Array, "coordinates"]


class Dependence(eqx.Module):
    """What depends on which coordinate (columns), anywhere among the probed states."""

    cyclic_quantities: Bool[np.ndarray, "coordinates"]  # anything of what a cyclic coordinate must not appear in
    rates: Bool[np.ndarray, "coordinates coordinates"]  # B y + b, row by row
    accelerations: Bool[np.ndarray, "coordinates"]  # the privileged accelerations
    privileged: Bool[np.ndarray, "coordinates"]  # whether the coordinate's own rate is a privileged velocity


def admissible_rates(scene: Scene, t, q, u) -> AdmissibleRates:
    """C, c, B and b at one state; u matters for rows nonlinear in the speeds only, which are linearised there."""
    A = jax.jacfwd(lambda u: velocity_residual(scene, t, q, u))(u)
    scale = row_scale(A)
    split = Partition(scale[:, None] * A, structure_of(scene).independent)
    C, c = split.C, split.particular(scale * (A @ u - velocity_residual(scene, t, q, u)))
    nu = coordinate_rates(scene, t, q, jnp.zeros_like(u))
    N = jax.jacfwd(lambda u: coordinate_rates(scene, t, q, u))(u)
    return AdmissibleRates(C, c, N @ C, N @ c + nu)


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


@probed_once
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


@on_numbers
def _probe(scene: Scene, t, q, u, shifts):
    """Quantities by name at every state, undisplaced and with one coordinate after another displaced; whose rate is one speed."""

    def one(t, q, u, shifts):
        displaced = q + jnp.concatenate([jnp.zeros((1, q.shape[0])), jnp.diag(shifts)])
        rates = admissible_rates(scene, t, q, u)
        one_speed = (jnp.max(rates.B, axis=1, initial=0.0) == 1) & (jnp.sum(jnp.abs(rates.B), axis=1) == 1) & (rates.b == 0)
        return jax.vmap(lambda q: _quantities(scene, t, q, u))(displaced), one_speed

    return jax.vmap(one)(t, q, u, shifts)


def _quantities(scene: Scene, t, q, u) -> dict[str, Float[Array, "entries"]]:
    """The rates `B y + b`, the privileged accelerations, and what a cyclic coordinate must not appear in (inertial frame)."""
    independent = structure_of(scene).independent
    chosen = jnp.array(independent, jnp.int32)
    y, rates = u[chosen], admissible_rates(scene, t, q, u)
    u = rates.C @ y + rates.c

    def space_velocities(u):
        bodies = motion_at(scene, t, q, u).bodies.values()
        return jnp.concatenate([jnp.concatenate([body.velocity, body.angular_velocity]) for body in bodies])

    motion = motion_at(scene, t, q, u)
    turned = jnp.stack([body.orientation for body in motion.bodies.values()])
    inertia = jnp.einsum("bij,bjk,blk->bil", turned, inertias(scene, t, q).inertia, turned)
    loads, potential = resultants(scene, motion), potential_resultants(scene, motion)
    forces = [loads.force, loads.torque, loads.direct @ rates.C, potential.force, potential.torque, potential.direct @ rates.C]
    equations, rows = equations_and_rows(scene, t, q, u)
    udot = reduce(Privileged(independent), equations, rows.judged_by(usual_rows(scene))).udot
    return {
        "rates": rates.B @ y + rates.b,
        "accelerations": jnp.concatenate([udot[chosen], y]),  # y, which depends on nothing, gives free motion a size
        "B and b": jnp.concatenate([rates.B.ravel(), rates.b, rates.C.ravel(), rates.c]),
        "beta and gamma": jnp.concatenate([space_velocities(u), (jax.jacfwd(space_velocities)(u) @ rates.C).ravel()]),
        "inertia": inertia.ravel(),
        "forces": jnp.concatenate([part.ravel() for part in forces]),
    }
