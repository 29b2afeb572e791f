"""Coulomb's law at all contacts: their forces and impulses, from small systems of equations that are
unrolled to scalars.

Accelerations of the gap and of slip are `G L + b` with the forces L. Changes of speeds depend on impulses in
the same way, so one law serves both.

    closed:   (G L + b)_n = target             open:   L = 0
    sticks:   (G L + b)_t = 0, |L_t| <= mu L_n
    slips:    L_t = -mu L_n e,  (G L + b)_t along e

Each contact has three rows: the normal n, then the two tangents t of the ground. e: direction of slip. Source
of the limit directions: M. Antali and G. Stepan, Nonlinear Dynamics 97 (2019) 1799.
"""

from collections.abc import Sequence
from functools import partial
from itertools import product
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jourdain_jax.calculus.reals import ContactFlags, ContactVectors, Flag, PerContact, PerRow, Scalar

# SWEEPS: Gauss-Seidel sweeps per contact; STEPS: Newton steps for one contact, one more for each
# further contact
SWEEPS, STEPS = 4, 5  # numerics
SLOW = 1e-5  # numerics, m/s: least speed s of `slip_turns`; a motion does not start with slower slip
ROUND_OFF = 1e-9  # numerics: relative, of responses
LEAST_SLIP = 1e-8  # numerics, m/s: round-off of speeds that impulses change
DIFFERS = 1e-6  # numerics: relative difference of responses from which on two solutions differ
LEAST_PIVOT = 1e-12  # numerics: relative to the diagonal entry before elimination


def solved(
    K: Sequence[Float[Array, "n"]], right: Sequence[Float[Array, "columns"]], vanishes: bool = True
) -> list[Float[Array, "columns"]]:
    """Return `K^-1 right`, by elimination in the order of the rows.

    `vanishes`: whether a pivot may vanish. The unknown of a vanishing pivot is set to zero, such as the force
    across a plane in which all bodies move.
    """
    count, inverses = len(K), []
    rows = [jnp.concatenate([a, b]) for a, b in zip(K, right, strict=True)]
    for p in range(count):
        pivot = rows[p][p]
        if vanishes:
            there = jnp.abs(pivot) > LEAST_PIVOT * jnp.abs(K[p][p])
            inverses.append(jnp.where(there, 1 / jnp.where(there, pivot, 1.0), 0.0))
        else:
            inverses.append(1 / pivot)
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
    """The modes of all contacts, as numbers 0 or 1, and directions of slip."""

    closed: PerContact
    rolls: PerContact
    direction: Float[Array, "contacts 2"]


def system(
    G: Float[Array, "rows rows"], modes: Modes, friction: PerContact
) -> tuple[Float[Array, "rows rows"], PerRow]:
    """Return K and s of `K L = -s b`, the laws of all contacts in their modes:

        s_n (G L + b)_n + (1 - s_n) L_n = 0,   s_t (G L + b)_t + (1 - s_t) (L_t + mu L_n e) = 0

    s_n is 1 for closed contacts, s_t for rolling contacts; otherwise both are 0.
    """
    s = jnp.stack([modes.closed, modes.rolls, modes.rolls], axis=1).ravel()
    along = friction[:, None] * modes.direction
    blocks = [jnp.eye(3, dtype=G.dtype).at[1:, 0].set(own) for own in along]
    return s[:, None] * G + (1 - s)[:, None] * jax.scipy.linalg.block_diag(*blocks), s


def forces(K: Float[Array, "rows rows"], right: Float[Array, "rows columns"]) -> Float[Array, "rows columns"]:
    """Return `K^-1 right` for the matrix K of `system`.

    The tangential unknowns are eliminated first. Every pivot is then positive, unless a slipping contact has
    no solution (Painleve's paradox).
    """
    count = len(K) // 3
    order = [3 * i + k for i in range(count) for k in (1, 2)] + [3 * i for i in range(count)]
    rows = [K[row][jnp.array(order)] for row in order]
    found = dict(zip(order, solved(rows, [right[row] for row in order]), strict=True))
    return jnp.stack([found[row] for row in range(len(K))])


@jax.jit  # traced once
def responses(
    G: Float[Array, "rows rows"], b: Float[Array, "rows columns"], modes: Modes, friction: PerContact
) -> Float[Array, "rows columns"]:
    """Return the forces at all contacts in their modes, one column for each column of b, from the equations
    of `system`.
    """
    K, s = system(G, modes, friction)
    return forces(K, -s[:, None] * b)


class Law(NamedTuple):
    """The contacts of one Coulomb problem; `G P + b` are their speeds or accelerations."""

    G: Float[Array, "rows rows"]
    b: PerRow
    target: PerContact  # least normal response
    friction: PerContact  # mu of slip
    static: PerContact  # mu of sticking
    touches: ContactFlags  # whether there may be a force
    slides: ContactFlags  # slips in the direction e, whatever the response
    begins: ContactFlags  # is closed and starts to slip in an unknown direction
    e: Float[Array, "contacts 2"]


class Solution(NamedTuple):
    """Forces and modes of all contacts, and whether they satisfy the law, by contact."""

    P: ContactVectors
    modes: Modes
    holds: ContactFlags
    several: Flag  # whether forces in other modes satisfy the law, too, with another response


@jax.jit
def coulomb(law: Law) -> Solution:
    """Return forces P that satisfy Coulomb's law at all contacts simultaneously, with `w = G P + b`.

        w_n >= target and P_n >= 0, one of them with equality;
        w_t = 0 and |P_t| <= mu_s P_n, or P_t = -mu P_n e with e = w_t/|w_t|

    Projected Gauss-Seidel sweeps come first. Then Newton's method solves the equations of the modes
    for forces and directions, which also give the derivatives. Before each step it chooses the modes
    by the signs of

        N = P_n - (w_n - target)/G_nn,   |T| - mu_s N with T = P_t - w_t/tr G_tt

    If contacts are redundant, the sweeps decide how they share the load. Source: P. Alart and A. Curnier,
    Comput. Methods Appl. Mech. Eng. 92 (1991) 353.
    """
    count = len(law.target)
    P = jnp.zeros((count, 3), law.b.dtype)
    for turn in range(count * count * SWEEPS):
        P = _swept(law, P, turn % count)
    modes = _modes(law, P)
    for _ in range(STEPS + count - 1):
        P, e = _improved(law, P, modes)
        found, modes = modes._replace(direction=e), _modes(law, P)
    return _in_other_modes(law, Solution(P, found, holds(law, P, found), jnp.asarray(False)))


def _in_other_modes(law: Law, found: Solution) -> Solution:
    """Return the solution after a trial of all combinations of open and closed contacts. If `found` violates
    the law, a combination that satisfies it is returned instead; if both satisfy it, there are several
    solutions.
    """
    (closed, rolls, e), several = found.modes, found.several
    if_closed = jnp.where(law.slides, 0.0, jnp.where(closed > 0, rolls, 1.0))
    wanted = law.b - jnp.zeros_like(found.P).at[:, 0].set(law.target).ravel()
    for tried in product((0.0, 1.0), repeat=len(closed)):
        now = jnp.where(law.touches, jnp.array(tried), 0.0)
        modes = Modes(now, now * if_closed, e)
        P = responses(law.G, wanted[:, None], modes, law.friction).reshape(-1, 3)
        other, right = Solution(P, modes, holds(law, P, modes), several), jnp.all(found.holds)
        off = jnp.sum(jnp.abs(law.G @ (P - found.P).ravel())) > DIFFERS * jnp.sum(jnp.abs(law.b))
        fits = jnp.all(other.holds)
        several |= right & fits & off
        found = jax.tree.map(partial(jnp.where, fits & ~right), other, found)
    return found._replace(several=several)


@partial(jax.jit, static_argnums=2)
def _swept(law: Law, P: ContactVectors, j: int) -> ContactVectors:
    """Return the forces after one Gauss-Seidel step at contact j: its force by the law, for the given
    other forces.
    """
    normal, tangential = _scales(law.G)
    w = law.G[3 * j : 3 * j + 3] @ P.ravel() + law.b[3 * j : 3 * j + 3]
    N = jnp.where(law.touches[j], jnp.maximum(P[j, 0] - (w[0] - law.target[j]) * normal[j], 0.0), 0.0)
    T = P[j, 1:] - (w[1:] + law.G[3 * j + 1 : 3 * j + 3, 3 * j] * (N - P[j, 0])) * tangential[j]
    bound, square = law.static[j] * N, T @ T
    over = square > bound * bound
    T = jnp.where(over, bound / jnp.sqrt(jnp.where(over, square, 1.0)), 1.0) * T
    return P.at[j].set(jnp.append(N, jnp.where(law.slides[j], -law.friction[j] * N * law.e[j], T)))


def _scales(G: Float[Array, "rows rows"]) -> tuple[PerContact, PerContact]:
    """Return 1/G_nn and 1/tr G_tt of each contact; 0 where the denominator is 0."""
    sizes = jnp.diagonal(G).reshape(-1, 3)
    sizes = jnp.stack([sizes[:, 0], sizes[:, 1] + sizes[:, 2]])
    return tuple(jnp.where(sizes > 0, 1 / jnp.where(sizes > 0, sizes, 1.0), 0.0))


def _modes(law: Law, P: ContactVectors) -> Modes:
    """Return the modes of all contacts under the forces `P`."""
    normal, tangential = _scales(law.G)
    w = (law.G @ P.ravel() + law.b).reshape(-1, 3)
    N, T = P[:, 0] - (w[:, 0] - law.target) * normal, P[:, 1:] - w[:, 1:] * tangential[:, None]
    closed = law.touches & ((N > 0) | law.begins)
    sticks = closed & ~(law.slides | law.begins) & (jnp.sum(T * T, axis=1) <= (law.static * N) ** 2)
    e = jnp.where(law.slides[:, None], law.e, -unit(T))
    return Modes(jnp.where(closed, 1.0, 0.0), jnp.where(sticks, 1.0, 0.0), e)


@jax.jit
def _improved(law: Law, P: ContactVectors, modes: Modes) -> tuple[ContactVectors, Float[Array, "contacts 2"]]:
    """Return forces and directions of slip after one step of Newton's method.

    The unknowns are the forces P and the angles of those directions e that are unknown. The equation of an
    angle is `n.w_t = 0`, where n is e rotated by a right angle.
    """
    (K, s), e = system(law.G, modes, law.friction), modes.direction
    n = jnp.stack([-e[:, 1], e[:, 0]], axis=1)
    free = (modes.closed > 0) & (modes.rolls == 0) & ~law.slides
    wanted = law.b - jnp.zeros_like(P).at[:, 0].set(law.target).ravel()
    turning = jnp.where(free, -law.friction * P[:, 0], 0.0)[:, None] * n
    columns = jax.scipy.linalg.block_diag(*jnp.pad(turning, ((0, 0), (1, 0)))[:, :, None])
    change = forces(K, jnp.concatenate([-(K @ P.ravel() + s * wanted)[:, None], columns], axis=1))
    first, by_turn = P.ravel() + change[:, 0], change[:, 1:]
    w = (law.G @ first + law.b).reshape(-1, 3)[:, 1:]
    aside = jnp.einsum("jk,jkc->jc", n, (law.G @ by_turn).reshape(len(P), 3, -1)[:, 1:])
    along, across = jnp.sum(e * w, axis=1), jnp.sum(n * w, axis=1)
    slopes = jnp.where(free[:, None], aside - jnp.diag(along), jnp.eye(len(P)))
    angles = jnp.concatenate(solved(list(slopes), list(jnp.where(free, -across, 0.0)[:, None])))
    return (first + by_turn @ angles).reshape(-1, 3), unit(e + angles[:, None] * n)


def holds(law: Law, P: ContactVectors, modes: Modes) -> ContactFlags:
    """Return for each contact whether the forces `P` satisfy the law in its mode, up to round-off."""
    normal, tangential = _scales(law.G)
    w, e = (law.G @ P.ravel() + law.b).reshape(-1, 3), modes.direction
    least = ROUND_OFF * jnp.sum(jnp.abs(law.b))
    excess, slip, N = w[:, 0] - law.target, w[:, 1:], P[:, 0]
    square = jnp.sum(P[:, 1:] ** 2, axis=1)
    held = square <= (law.static * N) ** 2 * (1 + ROUND_OFF) + (least * tangential) ** 2
    aside = jnp.abs(e[:, 0] * slip[:, 1] - e[:, 1] * slip[:, 0])
    slips = law.slides | ((jnp.sum(e * slip, axis=1) >= -least) & (aside <= least))
    sticks = held & (jnp.sum(slip * slip, axis=1) <= least**2)
    bears = (-least * normal <= N) & (jnp.abs(excess) <= least)
    closed = bears & jnp.where(modes.rolls > 0, sticks, slips)
    return ~law.touches | jnp.where(modes.closed > 0, closed, excess >= -least)


def unit(x: Float[Array, "*contacts 2"]) -> Float[Array, "*contacts 2"]:
    """Return vectors divided by their lengths; a zero vector stays zero."""
    square = jnp.sum(x * x, axis=-1, keepdims=True)
    return x / jnp.sqrt(jnp.where(square > 0, square, 1.0))


def moves(w: Float[Array, "*contacts 3"], least: float) -> Bool[Array, "*contacts"]:
    """Return whether the slip is faster than `least`, m/s."""
    return jnp.sum(w[..., 1:] ** 2, axis=-1) > least**2


class Impulse(NamedTuple):
    """The impulse at a contact that strikes."""

    P: Float[Array, "3"]  # N s
    slips: Flag  # after the impact
    exists: Flag  # whether the law has a solution


@partial(jax.jit, static_argnums=0)
def impulse(
    kind: str, G: Float[Array, "3 3"], w: Float[Array, "3"], restitution: Scalar, friction: Scalar
) -> Impulse:
    """Return the impulse P at a contact that strikes with the speeds w, by the law `kind`; `restitution`: e.

        dw/ds = G (1, -mu e_t)      s: normal impulse,  e_t: direction of slip, along w_t
        newton       until w_n+ = -e w_n
        poisson      until s = (1 + e) s_c             s_c: s at the end of compression, w_n = 0
        energetic    until W_r = -e^2 W_c              W_c, W_r: work of s in compression and restitution

    When slip stops, the contact sticks from then on, or slips along the limit direction. The speeds are
    linear in s before and after that instant. P is NaN if the direction of slip would change before it.
    Source: W. J. Stronge, Impact Mechanics (2000).
    """
    at_rest = coulomb(_one(G, friction))  # for a unit rise of w_n
    by_stop, sticks = at_rest.P[0], at_rest.modes.rolls[0] > 0
    then = 1 / by_stop[0]  # slope of w_n once slip has stopped
    moving = moves(w, LEAST_SLIP)
    e = jnp.where(moving, unit(w[1:]), 0.0)
    slides = jnp.append(jnp.ones_like(friction), -friction * e)
    rates = G @ slides
    first, slowing = rates[0], -(e @ rates[1:])
    at_stop = jnp.where(slowing > 0, e @ w[1:] / jnp.where(slowing > 0, slowing, 1.0), jnp.inf)
    stops = jnp.where(moving, at_stop, 0.0)  # normal impulse when slip stops
    stop_w = w[0] + first * jnp.where(jnp.isfinite(stops), stops, 0.0)  # w_n when slip stops

    def reached(goal: Scalar) -> Scalar:
        """Return the normal impulse at which w_n reaches the value `goal`."""
        early = moving & (first > 0) & ((goal <= stop_w) | ~jnp.isfinite(stops))
        return jnp.where(
            early,
            (goal - w[0]) / jnp.where(first > 0, first, 1.0),
            jnp.where(early, 0.0, stops) + (goal - stop_w) / then,
        )

    compressed = reached(jnp.zeros_like(w[0]))
    within = compressed < stops  # compression ends during slip
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
        # w_n+ by the law if slip stops during compression or not at all; otherwise restitution has two pieces
        one = restitution * jnp.sqrt(2 * jnp.where(within, rise, then) * work)
        rest = restitution**2 * work - stop_w**2 / (2 * rise)
        two = within & jnp.isfinite(stops) & (rest > 0)
        total = reached(jnp.where(two, jnp.sqrt(jnp.where(two, stop_w**2 + 2 * then * rest, 1.0)), one))
    sliding = jnp.minimum(total, stops)
    goes_on = total > stops
    P = sliding * slides + jnp.where(goes_on, (total - sliding) * then * by_stop, 0.0)
    turned = jnp.where(moving, jnp.abs(e[0] * rates[2] - e[1] * rates[1]) * sliding, 0.0)
    slips = (~goes_on | ~sticks) & moves(w + G @ P, LEAST_SLIP)
    return Impulse(jnp.where(turned < LEAST_SLIP, P, jnp.nan), slips, at_rest.holds[0] | ~goes_on)


def _one(G: Float[Array, "3 3"], friction: Scalar) -> Law:
    """Return the law of one contact at rest whose normal speed must rise by one."""
    b, one, no = jnp.zeros(3, G.dtype).at[0].set(-1.0), jnp.ones(1, G.dtype), jnp.zeros(1, bool)
    return Law(G, b, 0 * one, friction * one, friction * one, ~no, no, no, jnp.zeros((1, 2), G.dtype))
