"""Ignorable coordinates, found by probes, and the reduced Appell equations (42) without them (S9).

A coordinate is *cyclic* if its rate is not an independent speed and these quantities do not depend on it: B
and b of `qdot = B y + b`, the partial velocities beta and gamma, the inertias R I R' of the bodies, impressed
forces and torques, forces on speeds, and the potential's gradient. All are taken in the inertial frame and in
the independent speeds y. The spin of an axisymmetric wheel is an example. A coordinate is *ignorable* if
the independent accelerations do not depend on it, which is a weaker condition.

Coordinates of both kinds are dropped: they are fixed at the reference, and only the other coordinates k,
which are *kept*, are integrated:

    dk/dt = B_k(t, k) y + b_k(t, k),     dy/dt = yddot(t, k, y)

The dropped coordinates d follow by quadrature along the known motion, `d(t) = d_0 + int B_d y + b_d dt`.
They are recovered in groups, since the rates of some depend on others: the disc's x and y need its yaw.
`simulate` integrates all coordinates instead. A coordinate is kept if its own rate or a kept rate depends
on it (quaternions, the sleigh's heading), because quadrature cannot recover it. Source: Wang and Pao
(2003), eq. (42).
"""

from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jourdain_jax.calculus.reals import PerCoordinate
from jourdain_jax.dynamics.reactions import potential_resultants
from jourdain_jax.equations.gibbs_appell import MinimalKinematics, accelerations_of, minimal_kinematics
from jourdain_jax.equations.kinematics import coordinate_rates, of_bodies
from jourdain_jax.equations.virtual_power import resultants
from jourdain_jax.program.eager import eval_numpy
from jourdain_jax.scene.coordinates import Labels
from jourdain_jax.scene.identity import once_per_values
from jourdain_jax.scene.scene import Scene
from jourdain_jax.structure.sampling import sample_states
from jourdain_jax.structure.structure import structure_of

DEPENDS = 1e-9  # numerics: relative change of a quantity above which it depends on the coordinate


class AdmissibleRates(eqx.Module):
    """Speeds `u = C y + c` and coordinate rates `qdot = B y + b` in the independent speeds y."""

    C: Float[Array, "speeds freedoms"]
    c: Float[Array, "speeds"]
    B: Float[Array, "coordinates freedoms"]
    b: PerCoordinate


class Dependence(eqx.Module):
    """Which quantities depend on which coordinates (columns), at any of the probed states."""

    cyclic_quantities: Bool[
        np.ndarray, "coordinates"
    ]  # any quantity that a cyclic coordinate must not affect
    rates: Bool[np.ndarray, "coordinates coordinates"]  # B y + b, by entry
    accelerations: Bool[np.ndarray, "coordinates"]  # the independent accelerations
    privileged: Bool[np.ndarray, "coordinates"]  # whether the coordinate's own rate is an independent speed


def cyclic_coordinates(scene: Scene) -> Labels:
    """Return the cyclic coordinates: their rates are not independent speeds, and B, b, beta, gamma, R I R'
    and the impressed forces do not depend on them.

    There are none for constraints nonlinear in the speeds. A quaternion is never cyclic: its own rate
    depends on it.
    """
    if not structure_of(scene).affine:
        return ()
    found = dependence(scene)
    return _named(scene, ~found.cyclic_quantities & ~found.privileged)


def ignorable_coordinates(scene: Scene) -> Labels:
    """Return coordinates on which the independent accelerations do not depend; a quaternion
    counts as a whole.

    There are none for constraints nonlinear in the speeds.
    """
    if not structure_of(scene).affine:
        return ()
    return _named(scene, ~dependence(scene).accelerations)


def _named(scene: Scene, chosen) -> Labels:
    """Return names of the chosen coordinates. A quaternion is named if all four entries are chosen."""
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
    """Return the dependence of quantities on coordinates, found by displacing each coordinate alone at random
    states. Constraints must be affine in the speeds.

    The states are off the geometric constraints: otherwise a coordinate that is constant on them would seem
    to have no influence.
    """
    generator = np.random.default_rng(0)
    t, q, u = sample_states(scene, 8)
    q = q + generator.uniform(-0.1, 0.1, q.shape)
    shifts = generator.uniform(0.05, 0.1, q.shape)
    values, one_speed = _probe(scene, t, q, u, shifts)
    changed = {name: _changed(value) for name, value in values.items()}
    appears = [changed[name].any(axis=0) for name in values if name not in ("rates", "accelerations")]
    accelerations = changed["accelerations"].any(axis=0)
    return Dependence(np.any(appears, axis=0), changed["rates"], accelerations, one_speed.all(axis=0))


def _changed(values: np.ndarray) -> Bool[np.ndarray, "entries coordinates"]:
    """Return, for each entry and coordinate, whether the entry changes with it at any state. Values have
    shape (states, 1 + coordinates, entries); index 0 of the second axis is the undisplaced state.
    """
    size = np.max(np.abs(values), initial=np.finfo(values.dtype).tiny)
    limit = DEPENDS if values.dtype == np.float64 else 1e-4
    return ~np.all(np.abs(values[:, 1:] - values[:, :1]) <= limit * size, axis=0).T  # NaN counts as a change


@eval_numpy
def _probe(scene: Scene, t, q, u, shifts):
    """Return quantities by name at every state, first without displacement and then with each coordinate
    displaced alone. Also return which coordinates have one of the speeds as their rate.
    """

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
    """Return the rates `B y + b`, the independent accelerations, and the terms that a cyclic coordinate must
    not affect (inertial frame).
    """
    structure = structure_of(scene)
    chosen = np.array(structure.independent, int)
    y = u[chosen]
    known = minimal_kinematics(scene, structure.independent, structure.kept_rows, t, q, y)
    motion, found = accelerations_of(scene, known, t, q)
    rates = _rates_of(scene, t, q, known)
    C = rates.C
    bodies = motion.bodies.values()
    velocities = jnp.concatenate([jnp.concatenate([body.velocity, body.angular_velocity]) for body in bodies])
    turned = of_bodies(motion, "orientation")
    inertia = jnp.einsum("bij,bjk,blk->bil", turned, known.weights.inertia, turned)
    beta = known.partial.bodies.linear @ C
    gamma = jnp.einsum("bij,bjk->bik", turned, known.partial.bodies.angular @ C)
    both = resultants(scene, motion), potential_resultants(scene, motion)
    forces = [part for of in both for part in (of.force, of.torque, of.direct @ C)]
    return {
        "rates": motion.qdot.array,
        # y does not depend on the coordinates; it sets the size to compare with where accelerations are zero
        "accelerations": jnp.concatenate([found.udot[chosen], y]),
        "B and b": jnp.concatenate([rates.B.ravel(), rates.b, C.ravel(), rates.c]),
        "beta and gamma": jnp.concatenate([velocities, beta.ravel(), gamma.ravel()]),
        "inertia": inertia.ravel(),
        "forces": jnp.concatenate([part.ravel() for part in forces]),
    }


def admissible_rates(scene: Scene, t, q, u) -> AdmissibleRates:
    """Return C, c, B and b at one state of a scene whose constraints are affine in the speeds."""
    structure = structure_of(scene)
    y = u[jnp.array(structure.independent, jnp.int32)]
    known = minimal_kinematics(scene, structure.independent, structure.kept_rows, t, q, y)
    return _rates_of(scene, t, q, known)


def _rates_of(scene: Scene, t, q, known: MinimalKinematics) -> AdmissibleRates:
    chosen = np.array(known.split.independent, int)
    C = known.c[:, None] * known.split.C / known.c[chosen]
    N = jax.jacfwd(lambda u: coordinate_rates(scene, t, q, u))(known.u)
    B, y = N @ C, known.u[chosen]
    # speeds and rates at y = 0
    return AdmissibleRates(C, known.u - C @ y, B, coordinate_rates(scene, t, q, known.u) - B @ y)


@dataclass(frozen=True)
class ReducedCoordinates:
    """The coordinates kept by the reduced equations, and the groups in which the others are recovered."""

    kept: Labels
    dropped: tuple[Labels, ...]  # groups, in the order of their recovery
    privileged: Labels  # the speeds y

    @property
    def recovered(self) -> Labels:
        """Return all dropped coordinates in the order of their recovery."""
        return tuple(name for group in self.dropped for name in group)


def reduced_coordinates(scene: Scene) -> ReducedCoordinates:
    """Return the kept and the dropped coordinates. Raises ValueError for constraints nonlinear in the speeds,
    which have no linear B and b.
    """
    structure = structure_of(scene)
    if not structure.affine:
        raise ValueError(
            f"`{type(scene).__name__}` has constraints nonlinear in the speeds, and therefore no reduced "
            "equations; integrate all coordinates and speeds"
        )
    found, names = dependence(scene), scene.coordinate_names.entries
    cyclic_or_ignorable = (~found.cyclic_quantities & ~found.privileged) | ~found.accelerations
    groups = _groups(set(np.flatnonzero(cyclic_or_ignorable).tolist()), found.rates)
    dropped = {i for group in groups for i in group}
    return ReducedCoordinates(
        tuple(name for i, name in enumerate(names) if i not in dropped),
        tuple(tuple(names[i] for i in group) for group in groups),
        tuple(scene.speed_names.entries[i] for i in structure.independent),
    )


def _groups(droppable: set[int], needs) -> list[list[int]]:
    """Return groups of coordinates in the order in which quadrature recovers them. `needs[i, j]`: whether the
    rate of i depends on j.
    """
    while True:
        groups, known = [], set(range(len(needs))) - droppable
        needed_by_kept = {j for j in droppable if any(needs[i, j] for i in known)}
        is_ready = lambda i, known=known: set(np.flatnonzero(needs[i]).tolist()) <= known
        while ready := list(filter(is_ready, sorted(droppable - known))):
            groups.append(ready)
            known |= set(ready)
        in_circles = droppable - known  # rates that depend on themselves or on each other
        if not needed_by_kept | in_circles:
            return groups
        droppable = droppable - needed_by_kept - in_circles


def reduced_accelerations(scene: Scene, t, kept: Float[Array, "kept"], y) -> Float[Array, "freedoms"]:
    """Return independent accelerations of the reduced equations (42), a function only of time, kept
    coordinates and independent speeds.
    """
    structure = structure_of(scene)
    places = [scene.coordinate_names.index(name, "coordinate") for name in reduced_coordinates(scene).kept]
    # dropped coordinates stay at the reference
    q = jnp.asarray(scene.coordinates.reference()).at[jnp.array(places, jnp.int32)].set(kept)
    known = minimal_kinematics(scene, structure.independent, structure.kept_rows, t, q, y)
    return accelerations_of(scene, known, t, q)[1].udot[jnp.array(structure.independent, jnp.int32)]
