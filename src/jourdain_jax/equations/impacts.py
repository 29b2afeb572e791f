"""Impacts: speeds, modes and directions of slip after a contact closes.

    u+ = u- + M^-1 A' P,   w_n+ = -e w_n-,   |P_t| <= mu P_n, and w_t+ = 0 or P_t against w_t+

One contact strikes (`impulse` in `contact_laws.py`); closed contacts take part in modes that satisfy their
laws, with restitution 0. Source: J. J. Moreau, in: Nonsmooth Mechanics and Applications (1988).
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jourdain_jax.calculus.reals import Flag, Scalar
from jourdain_jax.equations.contact_laws import (
    LEAST_SLIP,
    ROUND_OFF,
    SLOW,
    Impulse,
    Modes,
    coulomb,
    impulse,
    moves,
    solved,
    unit,
)
from jourdain_jax.equations.contact_rows import switching_contacts
from jourdain_jax.equations.contact_state import At, switched
from jourdain_jax.scene.switching import CREEPS, FLIES, GAINS_ENERGY, PAINLEVE, ROLLS, SLIPS, UNDECIDED

LEAST_REBOUND = 1e-6  # m/s: a contact that would rebound with less is closed
ROUNDS = 4  # in which the modes of several contacts in an impact are looked for


class Struck(NamedTuple):
    """Impulses at all contacts as one closes, and the modes of the others while they act."""

    P: Float[Array, "contacts 3"]
    modes: Modes
    own: Impulse  # of the contact that closes
    lawful: Flag  # whether the impulses satisfy the laws of the others


def _struck(at: At, i: int, strikes: Flag, restitution: Scalar) -> Struck:
    """Return the impulses as contact i closes: impulses that stop its slip, or of an impact if it `strikes`.
    """
    impact = list(switching_contacts(at.scene, at.motion.pose()).values())[i].impact

    def tried(modes: Modes, lawful: Flag | None = None) -> Struck:
        alone = at.alone(i, at.found.rows.w, modes)
        own = impulse(impact, alone.G, alone.b, restitution, at.friction[i], alone.sizes)
        sticking = jnp.concatenate(solved(list(alone.G), list(-alone.b[:, None]), list(alone.sizes)))
        P = alone.every(i, jnp.where(strikes, own.P, sticking)).reshape(-1, 3)
        return Struck(P, modes, own, _is_lawful(at, i, modes, P) if lawful is None else lawful)

    if len(at.number) == 1:
        return tried(at.modes, jnp.asarray(True))
    struck = tried(at.modes)
    for turn in range(ROUNDS):
        struck = tried(_yielding(at, i, struck.modes, struck.P, turn % 2 == 1))
    return struck


class Settled(NamedTuple):
    """Modes and directions of slip of all contacts, and whether the law at rest has a solution."""

    numbers: Float[Array, "contacts"]
    e: Float[Array, "contacts 2"]
    exists: Flag


def _settled(then: At, first: int, e: Float[Array, "contacts 2"], waits: Bool[Array, "contacts"]) -> Settled:
    """Decide by the law at rest whether contacts that do not slip, `waits`, open, stick or begin to slip.

    `first`: the contact that is decided first, while the others are in the modes of `then`.
    """
    numbers, modes, exists = then.number, then.modes, jnp.asarray(True)
    for j in sorted(range(len(numbers)), key=lambda j: j != first):
        own = then.alone(j, then.found.b, modes)
        rest = coulomb(own.G, own.b, jnp.zeros_like(own.b[0]), then.friction[j], then.static[j], own.sizes)
        settled = jnp.where(rest.opens, float(FLIES), jnp.where(rest.sticks, float(ROLLS), float(CREEPS)))
        numbers = numbers.at[j].set(jnp.where(waits[j], settled, numbers[j]))
        e = e.at[j].set(jnp.where(waits[j], rest.direction, e[j]))
        exists &= ~waits[j] | rest.exists
        modes = Modes(
            jnp.where(numbers == FLIES, 0.0, 1.0),
            jnp.where(numbers == ROLLS, 1.0, 0.0),
            jnp.where((numbers >= SLIPS)[:, None], e, 0.0),
        )
    return Settled(numbers, e, exists)


class After:
    """Speeds, modes and directions of slip where contact i closes.

    That is after an impact if it `strikes`, otherwise as its slip stops or is about to begin. Other closed
    contacts take part. Where no solution is found, or an impact would gain energy, the mode is a negative
    number that says why.
    """

    def __init__(self, at: At, i: int, strikes: Flag):
        self.at, self.i = at, i
        scene, motion, rows = at.scene, at.motion, at.found.rows
        e_n = jnp.asarray(list(switching_contacts(scene, motion.pose()).values())[i].restitution)
        rebounds = strikes & (-e_n * at.w[i, 0] > LEAST_REBOUND)
        struck = _struck(at, i, strikes, jnp.where(rebounds, e_n, 0.0))
        P, modes = struck.P.ravel(), struck.modes
        jumps = at.number[i] != ROLLS  # otherwise nothing strikes or stops
        w = (rows.w + at.found.G @ P).reshape(-1, 3)
        gained = 0.5 * P @ (rows.w + w.ravel())
        self.u = motion.u.array + jnp.where(jumps & jnp.isfinite(gained), at.found.impulses @ P, 0.0)

        slides, slipping = moves(w, LEAST_SLIP), jnp.where(moves(w, SLOW), float(SLIPS), float(CREEPS))
        closed = jnp.where(slides & (modes.rolls == 0), slipping, float(ROLLS))
        others = jnp.where(jumps, jnp.where(modes.closed == 0, float(FLIES), closed), at.number)
        slips = jnp.where(strikes & struck.own.slips, slipping[i], float(ROLLS))
        numbers = others.at[i].set(jnp.where(rebounds, float(FLIES), slips))
        e = jnp.where(slides[:, None], unit(w[:, 1:]), modes.direction)
        q = jnp.append(motion.q.array[: -e.size], e)
        then = At(scene, switched(scene, motion, numbers, q, self.u), None, at.responses)
        found = _settled(then, i, e, (numbers == ROLLS) & (jumps | (jnp.arange(len(numbers)) == i)))
        numbers, self.e, self.direction = found.numbers, found.e, found.e[i]

        has_law = found.exists & jnp.where(strikes, struck.own.exists, True)
        gains = jumps & (gained > ROUND_OFF * jnp.abs(P @ rows.w))
        undecided = jumps & ~(struck.lawful & jnp.isfinite(gained))
        for fault, why in ((~has_law, PAINLEVE), (gains, GAINS_ENERGY), (undecided, UNDECIDED)):
            numbers = numbers.at[i].set(jnp.where(fault, float(why), numbers[i]))
        self.numbers = numbers


def _excess(
    at: At, P: Float[Array, "contacts 3"]
) -> tuple[Float[Array, "contacts"], Float[Array, "contacts"]]:
    """Return by how much (m/s) each contact pulls, and exceeds its friction, under these impulses."""
    response = jnp.diagonal(at.found.G)[::3]
    tangential = jnp.sum(P[:, 1:] ** 2, axis=1)
    held = jnp.where(tangential > 0, jnp.sqrt(jnp.where(tangential > 0, tangential, 1.0)), 0.0)
    return -response * P[:, 0], response * (held - at.friction * P[:, 0])


def _yielding(at: At, i: int, modes: Modes, P: Float[Array, "contacts 3"], sticking: bool) -> Modes:
    """Return better modes of the others in an impact of contact i.

    closed and pulls               opens
    sticks, exceeds its friction   slips
    slips                          slips along the slip afterwards; if `sticking`, sticks where it is reversed
    open, moves into the ground    slips along the slip afterwards
    """
    pulled, exceeded = _excess(at, P)
    w = (at.found.rows.w + at.found.G @ P.ravel()).reshape(-1, 3)
    closed, sticks = modes.closed > 0, modes.rolls > 0
    pulls, enters = closed & (pulled > LEAST_SLIP), ~closed & (at.number != FLIES) & (w[:, 0] < -LEAST_SLIP)
    gives = sticks & (exceeded > LEAST_SLIP)
    stops = closed & ~sticks & (jnp.sum(w[:, 1:] * modes.direction, axis=1) < -LEAST_SLIP)
    fast = moves(w, LEAST_SLIP)
    along = jnp.where(fast[:, None], unit(w[:, 1:]), modes.direction)
    e = jnp.where(sticks[:, None], -unit(P[:, 1:]), along)
    now = jnp.where(pulls, 0.0, jnp.where(enters, 1.0, modes.closed))
    rolls = jnp.where(pulls | gives, 0.0, jnp.where((stops & sticking) | (enters & ~fast), 1.0, modes.rolls))
    return Modes(now.at[i].set(1.0), rolls, e)


def _is_lawful(at: At, i: int, modes: Modes, P: Float[Array, "contacts 3"]) -> Flag:
    """Return whether no other contact pulls, exceeds friction, slips off its direction or enters the ground."""
    w, (pulled, exceeded) = (at.found.rows.w + at.found.G @ P.ravel()).reshape(-1, 3), _excess(at, P)
    e, closed = modes.direction, modes.closed > 0
    along, aside = jnp.sum(w[:, 1:] * e, axis=1), w[:, 1] * e[:, 1] - w[:, 2] * e[:, 0]
    slips = closed & (modes.rolls == 0) & (pulled < -LEAST_SLIP)
    against = slips & ((along < -LEAST_SLIP) | (jnp.abs(aside) > LEAST_SLIP + 1e-6 * jnp.abs(along)))
    wrong = closed & ((pulled > LEAST_SLIP) | ((modes.rolls > 0) & (exceeded > LEAST_SLIP)) | against)
    into = (at.number != FLIES) & (w[:, 0] < -LEAST_SLIP)
    return ~jnp.any((wrong | into).at[i].set(False))
