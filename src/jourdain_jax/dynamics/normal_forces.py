"""Normal forces of contacts built into the coordinates, from Newton's equations of the supported bodies.

    sum_i N_i n_i              = sum_j f_j                            f_j = m_j a_j - F_j - R_j
    sum_i N_i (p_i - o) x n_i  = sum_j (r_j - o) x f_j + T_j

j: the carried bodies, i: the contacts that touch them, o: any point. F_j: impressed forces, R_j: constraint
forces, T_j: moments of inertia, loads and constraints.

Coordinates may impose motions that contacts alone cannot enforce, like a guide that keeps a disc upright.
Therefore the N_i satisfy first the balance of forces, by least squares, then, with the remaining freedom, the
balance of moments. If the N_i are still not unique, they have minimum norm. On a plane the normal forces thus
always sum to the total load of the bodies.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jourdain_jax.calculus.matrices import pseudo_inverse
from jourdain_jax.calculus.reals import Indices, eps_of, largest, rank_cutoff, tiny_of
from jourdain_jax.scene.contact.contacts import Contact
from jourdain_jax.scene.coordinates import Labels, check_names


class Wrenches(eqx.Module):
    """A force on every body and a torque about its mass centre, inertial frame."""

    force: Float[Array, "*rows bodies 3"]  # N
    torque: Float[Array, "*rows bodies 3"]  # N m


def normal_forces(
    contacts: dict[str, Contact],
    bodies: Labels,
    positions: Float[Array, "bodies 3"],
    hidden: Wrenches,
    spare: Wrenches,
    size,
):
    """Return the normal force (N) of every contact with `height="coordinates"`, by name, and whether it
    is determined.

    - `bodies`, `positions`: names and mass centres (m) of all bodies.
    - `hidden`: forces on the bodies that are neither loads nor constraint forces.
    - `spare`: forces of multipliers that do not affect the motion, with a leading axis of multipliers; zero
      for independent constraints.
    - `size`: the magnitude of the forces, N.
    """
    carried = {
        name: _carried(contact, name, bodies)
        for name, contact in contacts.items()
        if contact.height == "coordinates"
    }
    found: dict[str, tuple] = {}
    for names in _supports(carried):
        found |= _of_support(names, contacts, carried, bodies, positions, hidden, spare, size)
    return found


def _supports(carried: dict[str, Indices]) -> list[list[str]]:
    """Return groups of contacts that share carried bodies, directly or through other contacts."""
    groups: list[list[str]] = []
    for name, own in carried.items():
        together = [group for group in groups if any(set(own) & set(carried[other]) for other in group)]
        groups = [group for group in groups if group not in together]
        groups.append([*(other for group in together for other in group), name])
    return groups


def _of_support(
    names: list[str], contacts, carried, bodies, positions, hidden: Wrenches, spare: Wrenches, size
) -> dict[str, tuple]:
    # sets of bodies whose equations these contacts share
    sets = tuple(dict.fromkeys(carried[name] for name in names))
    points = jnp.stack([contacts[name].point for name in names])
    normals = jnp.stack([contacts[name].plane.normal for name in names])
    here = jnp.mean(points, axis=0)
    wrenches = [_resultant(wrench, positions, sets, here) for wrench in (hidden, spare)]
    forces, moments = wrenches[0]
    tolerance = jnp.sqrt(eps_of(forces))
    if len(names) == 1:
        normal = normals[0] @ forces
        return {names[0]: (normal, _unmoved(wrenches[1][0] @ normals.T, spare, tolerance)[0])}

    touches = [
        [bodies.index(contacts[name].body) in own or carried[name] == own for name in names] for own in sets
    ]
    by_set = jnp.asarray(touches, normals.dtype)[:, None, :]
    levers = points - here
    length = jnp.maximum(jnp.sqrt(jnp.max(jnp.sum(levers * levers, axis=1))), tiny_of(levers))
    by_force = (by_set * normals.T).reshape(-1, len(points))  # f = by_force N
    by_moment = by_set * jnp.cross(levers, normals).T
    by_moment = by_moment.reshape(-1, len(points)) / length  # moment/length = by_moment N

    first = pseudo_inverse(by_force)
    left = jnp.eye(len(points)) - first @ by_force  # freedom left by the forces
    turning = by_moment @ left
    turning = jnp.where(largest(turning) > rank_cutoff(turning.dtype), turning, 0.0)
    second = pseudo_inverse(turning)
    open_still = left - second @ turning

    def solved(f, m):
        N = first @ f
        return N + second @ (m / length - by_moment @ N)

    N = solved(forces, moments)
    missed = largest(by_force @ N - forces), largest(by_moment @ N - moments / length)
    size_of_moments = size + largest(hidden.torque) / length
    met = (missed[0] <= tolerance * size) & (missed[1] <= tolerance * size_of_moments)
    by_forces_alone = jnp.abs(jnp.diagonal(left)) <= tolerance
    by_both = jnp.abs(jnp.diagonal(open_still)) <= tolerance
    unmoved = _unmoved(jax.vmap(solved)(*wrenches[1]), spare, tolerance)
    determined = jax.lax.stop_gradient((by_forces_alone | (by_both & met)) & unmoved)
    return {name: (N[i], determined[i]) for i, name in enumerate(names)}


def _resultant(wrench: Wrenches, positions, sets: tuple[Indices, ...], here):
    """Return force and moment about a point `here` for each set of bodies."""
    moment = wrench.torque + jnp.cross(positions - here, wrench.force)
    summed = [
        [jnp.sum(part[..., jnp.array(own), :], axis=-2) for own in sets] for part in (wrench.force, moment)
    ]
    return tuple(jnp.concatenate(parts, axis=-1) for parts in summed)


def _unmoved(changes: Float[Array, "rows contacts"], spare: Wrenches, tolerance) -> Bool[Array, "contacts"]:
    """Return which normal forces are independent of multipliers that the motion does not determine."""
    size = jnp.maximum(largest(spare.force), largest(spare.torque))
    return largest(changes, 0) <= tolerance * size


def _carried(contact: Contact, name: str, bodies: Labels) -> Indices:
    """Return indices of the bodies that a contact supports."""
    check_names(contact.carried or (), bodies, f"contact `{name}` carries unknown body `{{}}`")
    if contact.carried is None:
        return tuple(range(len(bodies)))
    return tuple(sorted({bodies.index(body) for body in contact.carried}))
