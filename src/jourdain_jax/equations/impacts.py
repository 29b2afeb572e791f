"""Impacts: speeds, modes and directions of slip after a contact closes.

    u+ = u- + M^-1 A' P,   w_n+ = -e w_n-,   |P_t| <= mu P_n, and w_t+ = 0 or P_t against w_t+

P are the impulses, e the restitution. Contacts that close at one instant strike together, and closed contacts
take part with restitution 0 (`coulomb` in `contact_laws.py`). For a single contact that strikes, `impulse`
may integrate over the normal impulse instead. Source: J. J. Moreau, in: Nonsmooth Mechanics and Applications
(1988).
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jourdain_jax.calculus.reals import Flag
from jourdain_jax.equations.contact_laws import (
    LEAST_SLIP,
    ROUND_OFF,
    SLOW,
    Law,
    Modes,
    coulomb,
    holds,
    impulse,
    moves,
    responses,
    unit,
)
from jourdain_jax.equations.contact_state import At, switched
from jourdain_jax.scene.contact.friction_contacts import (
    CREEPS,
    FLAT,
    FLIES,
    GAINS_ENERGY,
    PAINLEVE,
    ROLLS,
    SLIPS,
    UNDECIDED,
)

LEAST_REBOUND = 1e-6  # m/s: below this speed of rebound a contact closes


class Changes(NamedTuple):
    """Transitions of each contact at an instant."""

    strikes: Bool[Array, "contacts"]
    stops: Bool[Array, "contacts"]  # stops slipping
    begins: Bool[Array, "contacts"]  # starts to slip


class Struck(NamedTuple):
    """Impulses at all contacts, their modes during the impact, and whether the result is valid."""

    P: Float[Array, "contacts 3"]
    modes: Modes
    has_law: Flag
    is_decided: Flag


def _struck(at: At, touches: Bool[Array, "contacts"], strikes: Bool[Array, "contacts"], i: int) -> Struck:
    """Return the impulses of an impact: by `impulse` at contact i, or by Moreau's law at all contacts at
    once.
    """
    e_n = jnp.where(strikes & (-at.restitution * at.w[:, 0] > LEAST_REBOUND), at.restitution, 0.0)
    no, w = jnp.zeros_like(touches), at.found.rows.w
    target, mu = -e_n * at.w[:, 0], at.friction
    law = Law(at.found.G, w, target, mu, mu, touches, no, no, at.modes.direction)
    found = coulomb(law)
    if at.impacts[i] == "moreau":
        return Struck(found.P, found.modes, jnp.all(found.holds), jnp.asarray(True))
    alone = at.alone(i, w, found.modes)
    own = impulse(at.impacts[i], alone.G, alone.b, e_n[i], at.friction[i])
    modes = found.modes._replace(rolls=found.modes.rolls.at[i].set(jnp.where(own.slips, 0.0, 1.0)))
    P = alone.every(i, own.P)
    others = holds(law, P, modes).at[i].set(True)
    by_itself = strikes[i] & ~jnp.any(strikes.at[i].set(False))
    return Struck(P, modes, own.exists, by_itself & jnp.all(others) & jnp.all(jnp.isfinite(P)))


class After:
    """Speeds, modes and directions of slip after an event of contact i.

    If contacts strike, impulses of impact act; otherwise, where a slip ends, impulses remove the remaining
    slip. Then Coulomb's law for accelerations decides which contacts without slip open, stick or begin to
    slip. If it has no solution, or an impact would gain energy, the mode of contact i becomes a negative
    number that tells the reason.
    """

    def __init__(self, at: At, i: int, changes: Changes):
        self.at, self.i, (strikes, stops, begins) = at, i, changes
        scene, motion, rows = at.scene, at.motion, at.found.rows
        struck = _struck(at, (at.number != FLIES) | strikes, strikes, i)
        hits, goes_on = jnp.any(strikes), jnp.any(begins)
        held = at.modes._replace(rolls=jnp.where(stops, 1.0, at.modes.rolls))
        stopping = responses(at.found.G, rows.w[:, None], held, at.friction)[:, 0]
        P = jnp.where(goes_on, 0.0, jnp.where(hits, struck.P.ravel(), stopping))
        rolls = jnp.where(hits, struck.modes.rolls, held.rolls)
        w = (rows.w + at.found.G @ P).reshape(-1, 3)
        gained = 0.5 * P @ (rows.w + w.ravel())
        self.u = motion.u.array + jnp.where(jnp.isfinite(gained), at.found.impulses @ P, 0.0)

        closed = at.number != FLIES
        touches = jnp.where(goes_on, closed, (closed | strikes) & (w[:, 0] < LEAST_REBOUND))
        slides = touches & jnp.where(goes_on, at.number >= SLIPS, moves(w, LEAST_SLIP) & (rolls == 0))
        e = jnp.where((slides & ~goes_on)[:, None], unit(w[:, 1:]), at.modes.direction)
        slipping = jnp.where(moves(w, SLOW), float(SLIPS), float(CREEPS))
        numbers = jnp.where(touches, jnp.where(slides, slipping, float(ROLLS)), float(FLIES))
        q = jnp.append(motion.q.array[: -e.size], e)
        then = At(scene, switched(scene, motion, numbers, q, self.u), None, at.responses)
        zero = jnp.zeros_like(at.friction)
        response = then.found.G, then.found.b, zero, then.friction, then.static
        rest = coulomb(Law(*response, touches, slides, begins, e))
        numbers = jnp.where(slides, numbers, jnp.where(rest.modes.rolls > 0, float(ROLLS), float(CREEPS)))
        numbers = jnp.where(rest.modes.closed > 0, numbers, float(FLIES))
        self.e, self.direction = rest.modes.direction, rest.modes.direction[i]

        has_law = jnp.all(rest.holds) & (~hits | struck.has_law)
        faults = (
            (~has_law, PAINLEVE if len(numbers) == 1 else UNDECIDED),
            (gained > ROUND_OFF * jnp.abs(P @ rows.w), GAINS_ENERGY),
            ((hits & ~struck.is_decided) | ~jnp.isfinite(gained), UNDECIDED),
        )
        if (above := at.above_flat[i]) is not None:
            faults = (*faults, ((touches | strikes)[i] & (above < 0), FLAT))
        for fault, why in faults:
            numbers = numbers.at[i].set(jnp.where(fault, float(why), numbers[i]))
        self.numbers = numbers
