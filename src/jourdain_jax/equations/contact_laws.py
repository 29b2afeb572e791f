"""Coulomb's law at one contact, and the forces of all: small systems, solved by elimination that unrolls to scalars.

Accelerations of the gap and of slip are `G L + b` with the forces L, and so are changes of speeds with impulses: one law serves both.

    closed:   (G L + b)_n = target             open:   L = 0
    sticks:   (G L + b)_t = 0, |L_t| <= mu L_n
    slips:    L_t = -mu L_n e,  (G L + b)_t along e

Rows of a contact: normal, then the two tangents of the ground. The direction e of slip that begins is the root of `e x (G L + b)_t = 0`, found by a fixed
number of Newton's steps, so that derivatives of any order are those of the root.
Source of the limit directions: M. Antali and G. Stepan, Nonlinear Dynamics 97 (2019) 1799.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from jourdain_jax.calculus.reals import Flag, Scalar

NEWTON_STEPS = 6
SLOW = 5e-6  # m/s: below, the direction of slip turns as it does at this speed
ROUND_OFF = 1e-9  # of responses
LEAST_PIVOT = 1e-12  # beside the entry that it is what is left of


class Law(NamedTuple):
    """What Coulomb's law makes of one contact."""

    sticking: Float[Array, "3"]  # forces with which it sticks
    slipping: Float[Array, "3"]  # forces with which it slips, or begins to; no numbers where it cannot
    sticks: Flag
    opens: Flag  # whether it would have to pull
    direction: Float[Array, "2"]  # of slip

    @property
    def forces(self) -> Float[Array, "3"]:
        """The forces that the law chooses."""
        return jnp.where(self.sticks, self.sticking, self.slipping)


def solved(K: Sequence[Float[Array, "n"]], right: Sequence[Float[Array, "columns"]], sizes: Sequence[Scalar] | None = None) -> list[Float[Array, "columns"]]:
    """`K^-1 right`, by elimination in the order of the rows; an unknown whose pivot vanishes is zero, as the force across a plane in which all bodies move.

    `sizes`: beside which it vanishes; default: the entries of the diagonal.
    """
    count, inverses = len(K), []
    rows = [jnp.concatenate([a, b]) for a, b in zip(K, right, strict=True)]
    for p in range(count):
        pivot = rows[p][p]
        there = jnp.abs(pivot) > LEAST_PIVOT * jnp.abs(K[p][p] if sizes is None else sizes[p])
        inverses.append(jnp.where(there, 1 / jnp.where(there, pivot, 1.0), 0.0))
        for r in range(p + 1, count):
            rows[r] = rows[r] - (rows[r][p] * inverses[p]) * rows[p]
    x: list = [None] * count
    for p in reversed(range(count)):
        rest = rows[p][count:]
        for j in range(p + 1, count):
            rest = rest - rows[p][j] * x[j]
        x[p] = rest * inverses[p]
    return x


class Modes(NamedTuple):
    """The modes of all contacts as numbers 0 or 1, and the directions of those that slip."""

    closed: Float[Array, "contacts"]
    rolls: Float[Array, "contacts"]
    direction: Float[Array, "contacts 2"]


def responses(G: Float[Array, "rows rows"], b: Float[Array, "rows columns"], modes: Modes, friction: Float[Array, "contacts"]) -> Float[Array, "rows columns"]:
    """Return the forces at all contacts in their modes for each of several b.

    s_n (G L + b)_n + (1 - s_n) L_n = 0,   s_t (G L + b)_t + (1 - s_t) (L_t + mu L_n e) = 0

    Tangents come first: then every pivot is positive, but where a slipping contact has no solution (Painleve).
    """
    count = len(friction)
    order = [3 * i + k for i in range(count) for k in (1, 2)] + [3 * i for i in range(count)]
    unit = jnp.eye(len(G), dtype=G.dtype)
    K, right = [], []
    for row in order:
        i, k = divmod(row, 3)
        s = modes.rolls[i] if k else modes.closed[i]
        other = unit[row] + friction[i] * modes.direction[i, k - 1] * unit[3 * i] if k else unit[row]
        K.append((s * G[row] + (1 - s) * other)[jnp.array(order)])
        right.append(-s * b[row])
    found = dict(zip(order, solved(K, right), strict=True))
    return jnp.stack([found[row] for row in range(len(G))])


def coulomb(G: Float[Array, "3 3"], b: Float[Array, "3"], target: Scalar, friction: Scalar, static: Scalar, sizes: Float[Array, "3"]) -> Law:
    """Return what the law makes of one closed contact with the response `G L + b`, whose normal part is to be `target`.

    With g = G_tn, H = G_tt and c = target - b_n the direction of slip is a root of

        F(e) = (G_nn - mu g.e) (e x b_t) + c (e x g) - c mu (e x H e),      F' along n = J e, the rotation of e

    `friction`, `static`: the coefficients mu of slip and of sticking; `sizes`: of the diagonal of G, beside which an entry of it vanishes.
    """
    c, free = target - b[0], b[1:]
    sticking = jnp.concatenate(solved(list(G), [c[None], -b[1:2], -b[2:3]], list(sizes)))
    bound, across = static * sticking[0], sticking[1:] @ sticking[1:]
    loaded = across > 0
    against = jnp.where(loaded, -sticking[1:], jnp.array([1.0, 0.0])) / jnp.sqrt(jnp.where(loaded, across, 1.0))
    g, H = G[0, 1:], G[1:, 1:]

    def slipping(e: Float[Array, "2"]) -> tuple[Float[Array, "3"], Float[Array, "2"], Flag]:
        """Forces, direction, and whether it is one of slip, for the root near e."""
        for _ in range(NEWTON_STEPS):
            n = jnp.stack([-e[1], e[0]])
            D, He, Hn = G[0, 0] - friction * (g @ e), H @ e, H @ n
            value = D * (n @ free) + c * (n @ g - friction * (n @ He))  # e x v = n.v
            slope = -friction * (g @ n) * (n @ free) - D * (e @ free) - c * (e @ g + friction * (n @ Hn - e @ He))
            e = e - jnp.where(slope == 0, 0.0, value / jnp.where(slope == 0, 1.0, slope)) * n
            e = e / jnp.sqrt(e @ e)
        D = G[0, 0] - friction * (g @ e)
        normal = c / D
        forces = jnp.concatenate([normal[None], -friction * normal * e])
        response = free + G[1:] @ forces
        most = ROUND_OFF * (jnp.sum(jnp.abs(free)) + jnp.sum(sizes[1:]) * jnp.sum(jnp.abs(forces)))
        aside = e[0] * response[1] - e[1] * response[0]
        return forces, e, (D > 0) & (e @ response > -most) & (jnp.abs(aside) < most)

    (forces, e, lawful), (other, turned, instead) = slipping(against), slipping(-against)
    forces, e = jnp.where(lawful, forces, jnp.where(instead, other, jnp.nan)), jnp.where(lawful | ~instead, e, turned)
    return Law(sticking, forces, (bound >= 0) & (across <= bound * bound), c < 0, e)
