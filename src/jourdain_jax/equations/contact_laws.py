"""Coulomb's law at one contact, the forces of all, and impulses, by small systems that unroll to scalars.

Accelerations of the gap and of slip are `G L + b` with the forces L, and so are changes of speeds with
impulses: one law serves both.

    closed:   (G L + b)_n = target             open:   L = 0
    sticks:   (G L + b)_t = 0, |L_t| <= mu L_n
    slips:    L_t = -mu L_n e,  (G L + b)_t along e

Rows of a contact: normal, then the two tangents of the ground. The direction e of slip that begins is the
root of `e x (G L + b)_t = 0`, found by a fixed number of Newton's steps, so that its derivatives of any order
are right.
Source of the limit directions: M. Antali and G. Stepan, Nonlinear Dynamics 97 (2019) 1799.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jourdain_jax.calculus.reals import Flag, Scalar

NEWTON_STEPS = 6
SLOW = 5e-6  # m/s: below, the direction of slip turns as it does at this speed
ROUND_OFF = 1e-9  # of responses
LEAST_SLIP = 1e-8  # m/s: round-off, of speeds that impulses change
LEAST_PIVOT = 1e-12  # beside the entry that it is what is left of


class Law(NamedTuple):
    """What Coulomb's law makes of one contact."""

    sticking: Float[Array, "3"]  # forces with which it sticks
    slipping: Float[Array, "3"]  # forces with which it slips, or begins to; no numbers where it cannot
    sticks: Flag
    opens: Flag  # whether it would have to pull
    direction: Float[Array, "2"]  # of slip
    exists: Flag  # whether it has an answer


def solved(
    K: Sequence[Float[Array, "n"]],
    right: Sequence[Float[Array, "columns"]],
    sizes: Sequence[Scalar] | None = None,
) -> list[Float[Array, "columns"]]:
    """Return `K^-1 right`, by elimination in the order of the rows.

    An unknown whose pivot vanishes is zero, as the force across a plane in which all bodies move.

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


def responses(
    G: Float[Array, "rows rows"],
    b: Float[Array, "rows columns"],
    modes: Modes,
    friction: Float[Array, "contacts"],
) -> Float[Array, "rows columns"]:
    """Return the forces at all contacts in their modes for each of several b.

    s_n (G L + b)_n + (1 - s_n) L_n = 0,   s_t (G L + b)_t + (1 - s_t) (L_t + mu L_n e) = 0

    Tangents come first: then every pivot is positive, unless a slipping contact has no solution (Painleve).
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


def coulomb(
    G: Float[Array, "3 3"],
    b: Float[Array, "3"],
    target: Scalar,
    friction: Scalar,
    static: Scalar,
    sizes: Float[Array, "3"],
) -> Law:
    """Return the law's solution for a closed contact; `target`: the normal part of its response `G L + b`.

    With g = G_tn, H = G_tt and c = target - b_n the direction of slip is a root of

        F(e) = (G_nn - mu g.e) (e x b_t) + c (e x g) - c mu (e x H e),      F' along n = J e

    `friction`, `static`: the coefficients mu of slip and of sticking. `sizes`: entries of the diagonal of G,
    beside which a pivot vanishes.
    """
    c, free = target - b[0], b[1:]
    sticking = jnp.concatenate(solved(list(G), [c[None], -b[1:2], -b[2:3]], list(sizes)))
    bound, across = static * sticking[0], sticking[1:] @ sticking[1:]
    loaded = across > 0
    against = jnp.where(loaded, -sticking[1:], jnp.array([1.0, 0.0])) / jnp.sqrt(
        jnp.where(loaded, across, 1.0)
    )
    g, H = G[0, 1:], G[1:, 1:]

    def slipping(e: Float[Array, "2"]) -> tuple[Float[Array, "3"], Float[Array, "2"], Flag]:
        """Forces, direction, and whether it is one of slip, for the root near e."""
        for _ in range(NEWTON_STEPS):
            n = jnp.stack([-e[1], e[0]])
            D, He, Hn = G[0, 0] - friction * (g @ e), H @ e, H @ n
            value = D * (n @ free) + c * (n @ g - friction * (n @ He))  # e x v = n.v
            slope = (
                -friction * (g @ n) * (n @ free) - D * (e @ free) - c * (e @ g + friction * (n @ Hn - e @ He))
            )
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
    forces, e = (
        jnp.where(lawful, forces, jnp.where(instead, other, jnp.nan)),
        jnp.where(lawful | ~instead, e, turned),
    )
    sticks = (bound >= 0) & (across <= bound * bound)
    return Law(sticking, forces, sticks, c < 0, e, sticks | lawful | instead)


def unit(x: Float[Array, "*contacts 2"]) -> Float[Array, "*contacts 2"]:
    """Return unit vectors, and zero for zero."""
    square = jnp.sum(x * x, axis=-1, keepdims=True)
    return x / jnp.sqrt(jnp.where(square > 0, square, 1.0))


def moves(w: Float[Array, "*contacts 3"], least: float) -> Bool[Array, "*contacts"]:
    """Return whether slip is faster than `least`, m/s."""
    return jnp.sum(w[..., 1:] ** 2, axis=-1) > least**2


class Impulse(NamedTuple):
    """The impulse at a contact that strikes."""

    P: Float[Array, "3"]  # N s
    slips: Flag  # afterwards
    exists: Flag  # whether the law has an answer


def impulse(
    kind: str,
    G: Float[Array, "3 3"],
    w: Float[Array, "3"],
    restitution: Scalar,
    friction: Scalar,
    sizes: Float[Array, "3"],
) -> Impulse:
    """Return the impulse at a contact that strikes with the speeds w; `restitution`: e.

    moreau:  w_n+ = -e w_n, Coulomb's law on the slip afterwards
    others:  dw/ds = G (1, -mu e_t) along the normal impulse s, e_t along w_t; once slip has stopped, the
             contact sticks, or slips along the limit direction

    newton:     until w_n+ = -e w_n
    poisson:    until s = (1 + e) s_c              c: the compression, which ends at w_n = 0
    energetic:  until W_r = -e^2 W_c               W: work of the normal impulse, in both parts

    The speeds w change linearly along each of two pieces. P is NaN where slip would turn during the first.
    Source: W. J. Stronge, Impact Mechanics (2000).
    """
    if kind == "moreau":
        law = coulomb(G, w, -restitution * w[0], friction, friction, sizes)
        slips = ~law.sticks & moves(w + G @ law.slipping, LEAST_SLIP)
        return Impulse(jnp.where(slips, law.slipping, law.sticking), slips, law.exists)
    at_rest = coulomb(
        G, jnp.array([-1.0, 0.0, 0.0]), jnp.zeros_like(friction), friction, friction, sizes
    )  # for w_n to rise by one
    by_stop = jnp.where(at_rest.sticks, at_rest.sticking, at_rest.slipping)
    then = 1 / by_stop[0]  # slope of w_n once slip has stopped
    moving = moves(w, LEAST_SLIP)
    e = jnp.where(moving, unit(w[1:]), 0.0)
    slides = jnp.append(jnp.ones_like(friction), -friction * e)
    rates = G @ slides
    first, slowing = rates[0], -(e @ rates[1:])
    stops = jnp.where(
        moving, jnp.where(slowing > 0, e @ w[1:] / jnp.where(slowing > 0, slowing, 1.0), jnp.inf), 0.0
    )
    stop_w = w[0] + first * jnp.where(jnp.isfinite(stops), stops, 0.0)  # w_n as slip stops

    def reached(goal: Scalar) -> Scalar:
        """The normal impulse at which w_n reaches a value."""
        early = moving & (first > 0) & ((goal <= stop_w) | ~jnp.isfinite(stops))
        return jnp.where(
            early,
            (goal - w[0]) / jnp.where(first > 0, first, 1.0),
            jnp.where(early, 0.0, stops) + (goal - stop_w) / then,
        )

    compressed = reached(jnp.zeros_like(w[0]))
    within = compressed < stops  # compression ends while it slips
    rise = jnp.where(within, first, 1.0)
    if kind == "newton":
        total = reached(-restitution * w[0])
    elif kind == "poisson":
        total = (1 + restitution) * compressed
    else:
        work = jnp.where(
            within,
            w[0] ** 2 / (2 * rise),
            -(w[0] + stop_w) * jnp.where(within, 0.0, stops) / 2 + stop_w**2 / (2 * then),
        )
        one = restitution * jnp.sqrt(2 * jnp.where(within, rise, then) * work)  # were it one piece
        rest = restitution**2 * work - stop_w**2 / (2 * rise)
        two = within & jnp.isfinite(stops) & (rest > 0)
        total = reached(jnp.where(two, jnp.sqrt(jnp.where(two, stop_w**2 + 2 * then * rest, 1.0)), one))
    sliding = jnp.minimum(total, stops)
    goes_on = total > stops
    P = sliding * slides + jnp.where(goes_on, (total - sliding) * then * by_stop, 0.0)
    turned = jnp.where(moving, jnp.abs(e[0] * rates[2] - e[1] * rates[1]) * sliding, 0.0)
    slips = (~goes_on | ~at_rest.sticks) & moves(w + G @ P, LEAST_SLIP)
    return Impulse(jnp.where(turned < LEAST_SLIP, P, jnp.nan), slips, at_rest.exists | ~goes_on)
