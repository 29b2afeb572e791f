"""Contacts that fly, roll, slip and strike: the end of each phase, and the next one.

    M du/dt = h + A' L       L: forces,  w = dg/dt and slip,  n, t: normal and tangential parts

    flies       L = 0
    rolls       dw/dt = 0
    slips       dw_n/dt = 0,  L_t = -mu L_n e,  e along w_t

    event       normal          tangent                      law
    flies       gap
    rolls       L_n             (mu_s L_n)^2 - |L_t|^2
    slips       L_n             e.w_t                        G_nn - mu G_nt.e (Painleve's paradox at 0)

A phase ends when one of the values in its line falls through zero; the head of the column names the event.
The event `law` ends the motion, also of a disc or wheel that falls flat. If forces jump beyond their bounds,
as at the edge of a kerb, `after` chooses all modes.

The direction of slip e is part of the state (`slip_turns`), so errors of w_t across e do not change it.

When a contact closes, the impact changes speeds, modes and directions of slip:

    u+ = u- + M^-1 A' P,   w_n+ = -e w_n-,   |P_t| <= mu P_n, and w_t+ = 0 or P_t against w_t+

P are the impulses, e the restitution. Contacts that close at one instant strike together, and closed contacts
take part with restitution 0 (`coulomb` in `contact_laws.py`). For a single contact that strikes, `impulse`
may integrate over the normal impulse instead. Source: J. J. Moreau, in: Nonsmooth Mechanics and Applications
(1988).

Bounces whose speeds shrink by the ratio r end after the time 2 w/(a (1 - r)): w speed of rebound, a downward
acceleration. If a single flight of that duration ends at most `SETTLES` below the ground, it replaces them,
and the contact then closes with restitution 0. During this flight, the two slots of the slip direction hold
the time at which it ends, and 1; during earlier flights, the speed w of the last rebound, and 0. If the body
strikes with another speed, because another contact struck in between, the series is not steady, and its
bounces go on until one is lower than `LOWEST`.

`At` holds the switching contacts at one state: their modes and their response to forces.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jourdain_jax.calculus.reals import ContactFlags, PerContact, PerCoordinate, PerRow, Scalar, Speeds
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
    solved,
    unit,
)
from jourdain_jax.equations.kinematics import motion_at
from jourdain_jax.equations.rows import coefficients, gaps_of, switching_rows
from jourdain_jax.equations.virtual_power import (
    ContactResponse,
    contact_modes,
    contact_response,
    numbers_and_slots,
    switching_forces,
)
from jourdain_jax.scene.modes import (
    AMBIGUOUS,
    FLAT,
    FLIES,
    GAINS_ENERGY,
    PAINLEVE,
    ROLLS,
    SLIPS,
    UNDECIDED,
    Event,
)
from jourdain_jax.scene.motion_state import Motion
from jourdain_jax.scene.scene import Scene

FLAT_BELOW = 1e-8  # physics: squared sine of the lean below which a disc counts as flat


class At:
    """The switching contacts at the state of a motion, and their response to forces.

    `found`: the response, if already known. `responses`: all responses computed so far, with their
    coordinates, speeds and inputs.
    """

    def __init__(
        self,
        scene: Scene,
        motion: Motion,
        found: ContactResponse | None = None,
        responses: list | None = None,
    ):
        self.scene, self.motion, self.responses = scene, motion, [] if responses is None else responses
        self.found = contact_response(scene, motion) if found is None else found
        if found is None:
            self.responses.append((motion.q.array, motion.u.array, motion.inputs.array, self.found))
        self.rows = tuple(switching_rows(scene, motion).values())
        self.friction, self.static = coefficients(scene, motion)
        leans = [row.lean() for row in self.rows]
        self.above_flat = [None if x is None else x - FLAT_BELOW for x in leans]
        self.modes: Modes = contact_modes(scene, motion)
        self.w = self.found.rows.w.reshape(-1, 3)
        self.number, self.slots = numbers_and_slots(scene, motion)
        self.settles = (self.number == FLIES) & (self.slots[:, 1] == 1)

    def then(
        self,
        numbers: PerContact,
        slots: Float[Array, "contacts 2"],
        q: PerCoordinate,
        u: Speeds,
        found: ContactResponse | None = None,
    ) -> "At":
        """Return the contacts in the modes `numbers` with these `slots`, at other coordinates and speeds."""
        motion = self.motion
        inputs = jnp.append(motion.inputs.array[: -len(numbers)], numbers)
        motion = motion_at(self.scene, motion.t, with_slots(q, slots), u, inputs)
        return At(self.scene, motion, found, self.responses)

    def alone(self, i: int, b: PerRow, modes: Modes) -> tuple[Array, Array]:
        """Return the response of contact i while the others stay in their `modes`: three columns per unit
        force of this contact, and one without it. The first array has its rows, the second one the forces of
        all contacts.
        """
        mine = slice(3 * i, 3 * i + 3)
        others = modes._replace(closed=modes.closed.at[i].set(0.0), rolls=modes.rolls.at[i].set(0.0))
        right = jnp.concatenate([self.found.G[:, mine], b[:, None]], axis=1)
        borne = responses(self.found.G, right, others, self.friction)
        return (right + self.found.G @ borne)[mine], borne


def with_slots(q: PerCoordinate, slots: Float[Array, "contacts 2"]) -> PerCoordinate:
    """Return the coordinates with other slots, which come last."""
    return jnp.append(q[: -slots.size], slots)


# numerics, m: greatest depth below the ground of the flight that sums bounces; less makes round-off larger
SETTLES = 1e-11
LOWEST = 1e-15  # numerics, m: a rebound lower than this is round-off of the gap
STEADY = 1e-2  # numerics: greatest relative change of speed from a rebound to the next impact of a series


def _struck(at: At, touches: ContactFlags, strikes: ContactFlags, i: int) -> tuple:
    """Return the impulses of an impact, by `impulse` at contact i or by Moreau's law at all contacts; which
    contacts it closes, and which stick; and whether the law has a solution, whether it is decided, and
    whether there are several.
    """
    restitution = jnp.stack([jnp.asarray(row.restitution) for row in at.rows])
    e_n = jnp.where(strikes & ~at.settles, restitution, 0.0)
    no, w = jnp.zeros_like(touches), at.found.rows.w
    target, mu = -e_n * at.w[:, 0], at.friction
    law = Law(at.found.G, w, target, mu, mu, touches, no, no, at.modes.direction)
    found = coulomb(law)
    stays = (found.modes.closed > 0) & (target < LEAST_SLIP)  # by the law, not by its round-off
    if at.rows[i].impact == "moreau":
        return found.P, stays, found.modes.rolls, jnp.all(found.holds), True, found.several
    alone, borne = at.alone(i, w, found.modes)
    own = impulse(at.rows[i].impact, alone[:, :3], alone[:, 3], e_n[i], mu[i])
    modes = found.modes._replace(rolls=found.modes.rolls.at[i].set(jnp.where(own.slips, 0.0, 1.0)))
    P = (borne[:, :3] @ own.P + borne[:, 3]).reshape(-1, 3).at[i].set(own.P)
    others = holds(law, P, modes).at[i].set(True)
    is_decided = strikes[i] & (jnp.sum(strikes) == 1) & jnp.all(others) & jnp.all(jnp.isfinite(P))
    return P, stays, modes.rolls, own.exists, is_decided, found.several


class After(NamedTuple):
    """The state after an event of contact i. `slots`: as in the state; `direction`: of slip of contact i;
    `found`: the response at these coordinates and speeds, in the modes before the law for accelerations.
    """

    numbers: PerContact
    slots: Float[Array, "contacts 2"]
    u: Speeds
    direction: Float[Array, "2"]
    found: ContactResponse


def after(at: At, i: int, strikes: ContactFlags, stops: ContactFlags, begins: ContactFlags) -> After:
    """Return speeds, modes and directions of slip after an event of contact i.

    If contacts strike, impulses of impact act. Impulses also remove slip that `stops`, and speeds of
    round-off at which closed contacts would open. Then Coulomb's law for accelerations decides which contacts
    without slip open, stick or begin to slip. Contacts at which slip `begins` slip. If the law has no
    solution, or an impact would gain energy, the mode of contact i becomes a negative number, a code for the
    reason.
    """
    motion, rows = at.motion, at.found.rows
    hits, goes_on = jnp.any(strikes), jnp.any(begins)
    closed = (at.number != FLIES) | strikes | (hits & at.settles)
    P, stays, sticks, has_law, is_decided, several = _struck(at, closed, strikes, i)
    P = jnp.where(hits, P.ravel(), 0.0)
    w = (rows.w + at.found.G @ P).reshape(-1, 3)
    # the law opens contacts that have no impulse and leave at a speed of round-off; they stay closed
    slow = w[:, 0] < LEAST_SLIP + jnp.sqrt(2 * LOWEST * jnp.abs(at.found.b[::3]))
    touches = jnp.where(hits, stays | (closed & slow), closed)
    rolls = jnp.where(hits, sticks, jnp.where(stops, 1.0, at.modes.rolls))
    slides = touches & jnp.where(goes_on, at.number == SLIPS, moves(w, LEAST_SLIP) & (rolls == 0))
    e = jnp.where((slides & ~goes_on)[:, None], unit(w[:, 1:]), at.modes.direction)
    numbers = jnp.where(touches, jnp.where(slides, SLIPS, ROLLS), FLIES)
    modes, zero = Modes(1.0 * touches, 1.0 * (touches & ~slides), e), jnp.zeros_like(at.friction)
    P += responses(at.found.G, w.reshape(-1, 1), modes, zero)[:, 0]
    w = (rows.w + at.found.G @ P).reshape(-1, 3)
    gained = 0.5 * P @ (rows.w + w.ravel())
    u = motion.u.array + jnp.where(jnp.isfinite(gained), at.found.impulses @ P, 0.0)
    then = at.then(numbers, e, motion.q.array, u)
    response = then.found.G, then.found.b, zero, then.friction, then.static
    rest = coulomb(Law(*response, touches, slides, begins, e))
    numbers = jnp.where(rest.modes.closed > 0, jnp.where(rest.modes.rolls > 0, ROLLS, SLIPS), FLIES)
    bounces = strikes & (numbers == FLIES) & (at.w[:, 0] < -w[:, 0])
    falls = -(then.found.G @ rest.P.ravel() + then.found.b)[::3]
    share = 1 + w[:, 0] / jnp.where(bounces, at.w[:, 0], 1.0)
    steady = jnp.abs(at.w[:, 0] + at.slots[:, 0]) <= STEADY * at.slots[:, 0]
    settles = bounces & steady & (falls > 0) & (2 * w[:, 0] ** 2 <= SETTLES * falls * share**2)
    rests = motion.t + 2 * w[:, 0] / jnp.where(settles, falls * share, 1.0)
    waits = jnp.where(((at.number == FLIES) & ~hits)[:, None], at.slots, 0.0)
    waits = jnp.where(bounces[:, None], jnp.stack([w[:, 0], zero], axis=1), waits)
    waits = jnp.where(settles[:, None], jnp.stack([rests, zero + 1], axis=1), waits)
    slots = jnp.where((numbers == SLIPS)[:, None], rest.modes.direction, waits)

    has_law = jnp.all(rest.holds) & (~hits | has_law)
    flat = [] if (above := at.above_flat[i]) is None else [((touches | strikes)[i] & (above < 0), FLAT)]
    for fault, why in (
        (rest.several | (hits & several), AMBIGUOUS),
        (~has_law, PAINLEVE if len(numbers) == 1 else UNDECIDED),
        (hits & (gained > ROUND_OFF * jnp.abs(P @ rows.w)), GAINS_ENERGY),
        (~(jnp.isfinite(gained) & (~hits | is_decided)), UNDECIDED),
        *flat,
    ):
        numbers = numbers.at[i].set(jnp.where(fault, why, numbers[i]))
    return After(numbers, slots, u, rest.modes.direction[i], then.found)


NEARLY = 1e-4  # numerics: least share of the ground's response that friction leaves; 0 at Painleve's paradox
# numerics, m/s: slip ends at this speed against its direction; larger than the round-off when it starts
STOPS = 1e-13
SAME = 1e-12  # numerics, s: a contact that closes within this time strikes together with another
TOUCHES = 1e-8  # numerics, m: a gap below this counts as closed at the start


def contact_events(at: At) -> dict[str, Scalar]:
    """Return values of the events of all switching contacts."""
    events, one = {}, jnp.ones_like(at.motion.t)
    forces = switching_forces(at.scene, at.motion, at.found).reshape(-1, 3)
    for i, name in enumerate(at.scene.switching.contacts):
        number, normal, tangential, slip = at.number[i], forces[i, 0], forces[i, 1:], at.w[i, 1:]
        bound, along = at.static[i] * normal, at.modes.direction[i] @ slip
        ahead = jnp.where(at.settles[i], at.slots[i, 0] - at.motion.t, at.found.rows.gap[i])
        events[f"{name} normal"] = jnp.where(number == FLIES, ahead, normal)
        holds = bound * bound - tangential @ tangential
        while_closed = jnp.where(number == ROLLS, holds, along + STOPS)
        events[f"{name} tangent"] = jnp.where(number == FLIES, one, while_closed)
        bears, stands = _bearing(at, i), one
        if (above := at.above_flat[i]) is not None:
            stands = jnp.where(number == ROLLS, above, one)
            bears = bears * above / jnp.sqrt(bears**2 + above**2)  # zero with either factor
        events[f"{name} law"] = jnp.where(number == SLIPS, bears, stands)
    return events


def contact_changes(at: At) -> dict[str, Event]:
    """Return the events of the switching contacts by name, each with the state and the modes after it. If
    speeds or forces jump, all modes come from `after`; otherwise only that of the event's contact changes.
    """
    events, names, now = {}, at.scene.switching.contacts, at.motion.u.array
    together = (at.found.rows.gap < -SAME * at.w[:, 0]) & (at.w[:, 0] < 0)
    values = contact_events(at)
    for i, name in enumerate(names):
        number, own = at.number[i], jnp.arange(len(names)) == i
        normal, tangent = values[f"{name} normal"], values[f"{name} tangent"]
        strikes, rolls, stops = number == FLIES, number == ROLLS, (number == SLIPS) & (tangent < LEAST_SLIP)
        force = jnp.sum(at.found.size) / at.found.G[3 * i, 3 * i]  # a scale also where the forces vanish
        breaks = (~strikes & (normal < -ROUND_OFF * force)) | (rolls & (tangent < -ROUND_OFF * force**2))
        met = own | together if at.rows[i].impact == "moreau" else own
        found = after(at, i, strikes & (at.number == FLIES) & met, own & stops, own & rolls & ~breaks)
        ends = PAINLEVE
        if (above := at.above_flat[i]) is not None:
            ends = jnp.where(above < FLAT_BELOW, FLAT, ends)
        for what, jumps, mode, slot in (
            ("normal", strikes | breaks, FLIES, jnp.zeros(2)),
            # at the start of slip the law at rest gives the direction, even if it sticks by round-off
            ("tangent", stops | breaks, SLIPS, found.direction),
            ("law", False, ends, at.slots[i]),
        ):
            numbers = jnp.where(jumps, found.numbers, at.number.at[i].set(mode))
            slots = jnp.where(jumps, found.slots, at.slots.at[i].set(slot))
            jump = dict(zip(at.scene.speed_names.entries, jnp.where(jumps, found.u, now), strict=True))
            jump |= {f"{other}_slip_{k}": slots[j, k - 1] for j, other in enumerate(names) for k in (1, 2)}
            to = dict(zip(names, numbers, strict=True))
            events[f"{name} {what}"] = Event(jnp.ones_like(at.motion.t), to=to, jump=jump)
    return events


def put_back(at: At) -> tuple[PerCoordinate, Speeds]:
    """Return coordinates on the ground, with directions of slip e of length one, and speeds at which closed
    contacts do not open and rolling contacts do not slip.

        q - D' (D D')^-1 gap,  D = d gap/dq;       e/|e|;       u + M^-1 A' P
    """
    scene, motion, modes = at.scene, at.motion, at.modes
    q, closed = motion.q.array, modes.closed

    def gaps(q):
        pose = motion_at(scene, motion.t, q, motion.u.array, motion.inputs.array).pose()
        return closed * gaps_of(scene, pose)

    D = jax.jacfwd(gaps)(q)
    moved = solved(list(D @ D.T + jnp.diag(1 - closed)), list(gaps(q)[:, None]))
    q = q - jnp.concatenate(moved) @ D
    e = jnp.where((closed > 0)[:, None], unit(modes.direction), at.slots)
    P = responses(at.found.G, at.found.rows.w[:, None], modes, 0.0 * at.friction)[:, 0]
    return with_slots(q, e), motion.u.array + at.found.impulses @ P


def contacts_at_start(at: At) -> Float[Array, "numbers"]:
    """Return the contacts at the start of a motion: the numbers of their modes, the depth (m) of a body below
    its ground, and coordinates and speeds. Contacts that touch are put on the ground, and impacts have
    happened.
    """
    gap, w, q, u = at.found.rows.gap, at.w, at.motion.q.array, at.motion.u.array
    touches = gap < TOUCHES
    strikes = touches & (w[:, 0] < -LEAST_SLIP)
    closed = touches & (jnp.abs(w[:, 0]) <= LEAST_SLIP)
    slips = moves(w, SLOW)
    numbers = jnp.where(closed, jnp.where(slips, SLIPS, ROLLS), FLIES)
    e = jnp.where((closed & slips)[:, None], unit(w[:, 1:]), 0.0)
    q, u = put_back(at.then(numbers, e, q, u, at.found))
    no = jnp.zeros_like(strikes)
    first = next((i for i, row in enumerate(at.rows) if row.impact != "moreau"), 0)
    numbers, slots, u, _, found = after(at.then(numbers, e, q, u), first, strikes, no, no)
    # of the response, `_bearing` reads G alone, which does not depend on modes or directions of slip
    then = at.then(numbers, slots, q, u, found)
    bears = jnp.stack([_bearing(then, i) > 0 for i in range(len(numbers))])
    numbers = jnp.where((numbers == SLIPS) & ~bears, PAINLEVE, numbers)
    return jnp.hstack([numbers, jnp.max(-gap, initial=0.0), then.motion.q.array, u])


def _bearing(at: At, i: int) -> Scalar:
    """Return the normal response `G_nn - mu G_nt.e` of contact i while it slips, less a small share of G_nn;
    positive where the ground can bear the body.
    """
    normal = at.alone(i, at.found.b, at.modes)[0][0]
    return (1 - NEARLY) * normal[0] - at.friction[i] * (normal[1:3] @ at.modes.direction[i])
