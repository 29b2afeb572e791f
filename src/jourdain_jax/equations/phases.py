"""Contacts that fly, roll, slip and strike: the end of each phase, and the next one.

    M du/dt = h + A' L       L: forces,  w = dg/dt and slip,  n, t: normal and tangential parts,  s: `SLOW`

    flies       L = 0
    rolls       dw/dt = 0
    slips       dw_n/dt = 0,  L_t = -mu L_n e,  e along w_t
    creeps      slips more slowly than s

    event       normal          tangent                      speed
    flies       gap
    rolls       L_n             (mu_s L_n)^2 - |L_t|^2
    slips       L_n             e.w_t - s                    1 - mu G_nt.e/G_nn (Painleve's paradox at 0)
    creeps      L_n             e.w_t                        2 s - e.w_t

A phase ends when one of the values in its line falls through zero; the head of the column names the event.
The event `speed` also ends the motion of a disc or wheel that falls flat.

The direction of slip e is part of the state, with the rate `n (n.dw_t/dt)/(e.w_t)`, n = e rotated by a right
angle (`slip_turns`). Errors of w_t across e therefore do not change e. The rate has no limit at rest: below
the speed s, s replaces e.w_t.

When a contact closes, the impact changes speeds, modes and directions of slip:

    u+ = u- + M^-1 A' P,   w_n+ = -e w_n-,   |P_t| <= mu P_n, and w_t+ = 0 or P_t against w_t+

P are the impulses, e the restitution. Contacts that close at one instant strike together, and closed contacts
take part with restitution 0 (`coulomb` in `contact_laws.py`). For a single contact that strikes, `impulse`
may integrate over the normal impulse instead. Source: J. J. Moreau, in: Nonsmooth Mechanics and Applications
(1988).

Bounces whose speeds shrink by the ratio r end after the time 2 w/(a (1 - r)): w speed of rebound, a downward
acceleration. If one flight ends at most `SETTLES` deep in the ground, it replaces them and the contact closes
with restitution 0. Meanwhile the slots of the slip direction hold the time at which the flight ends, and 1.

`At` holds the switching contacts at one state: their modes and their response to forces.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jourdain_jax.calculus.reals import (
    ContactFlags,
    ContactVectors,
    Flag,
    PerContact,
    PerCoordinate,
    PerRow,
    Scalar,
    Speeds,
)
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
from jourdain_jax.equations.rows import gaps_of, switching_rows
from jourdain_jax.equations.virtual_power import (
    ContactResponse,
    contact_modes,
    contact_response,
    switching_forces,
)
from jourdain_jax.scene.modes import (
    CREEPS,
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
        rows = switching_rows(scene, motion).values()
        self.friction = jnp.stack([row.friction.sliding for row in rows])
        self.static = jnp.stack([row.friction.static for row in rows])
        self.restitution = jnp.stack([row.restitution for row in rows])
        self.impacts = [row.impact for row in rows]
        leans = [row.lean() for row in rows]
        self.above_flat = [None if x is None else x - FLAT_BELOW for x in leans]
        self.modes: Modes = contact_modes(scene, motion)
        self.w = self.found.rows.w.reshape(-1, 3)
        self.number = jnp.stack([motion.modes[name] for name in scene.switching.contacts])
        self.slots = motion.q.array[-2 * len(self.number) :].reshape(-1, 2)
        self.settles = (self.number == FLIES) & (self.slots[:, 1] > 0)

    @property
    def forces(self) -> ContactVectors:
        """Return the normal and the two tangential forces, N."""
        return switching_forces(self.scene, self.motion, self.found).reshape(-1, 3)

    def alone(self, i: int, b: PerRow, modes: Modes | None = None) -> "Alone":
        """Return the response of contact i while the others stay in `modes` (default: the current ones)."""
        modes, mine = self.modes if modes is None else modes, slice(3 * i, 3 * i + 3)
        others = modes._replace(closed=modes.closed.at[i].set(0.0), rolls=modes.rolls.at[i].set(0.0))
        right = jnp.concatenate([self.found.G[:, mine], b[:, None]], axis=1)
        borne = responses(self.found.G, right, others, self.friction)
        total = (right + self.found.G @ borne)[mine]
        return Alone(total[:, :3], total[:, 3], borne)


class Alone(NamedTuple):
    """The response of one contact while the others stay in their modes."""

    G: Float[Array, "3 3"]
    b: Float[Array, "3"]
    # forces of all contacts: three columns per unit force of this one, one without it
    borne: Float[Array, "rows 4"]

    def every(self, i: int, own: Float[Array, "3"]) -> ContactVectors:
        """Return the forces of all contacts if contact i has the force `own`."""
        return (self.borne[:, :3] @ own + self.borne[:, 3]).reshape(-1, 3).at[i].set(own)


def switched(scene: Scene, motion: Motion, numbers: PerContact, q, u) -> Motion:
    """Return the motion at other coordinates and speeds, with contacts in the modes `numbers`."""
    inputs = jnp.concatenate([motion.inputs.array[: len(scene.inputs) - len(numbers)], numbers])
    return motion_at(scene, motion.t, q, u, inputs)


# numerics, m: greatest depth below the ground of the flight that sums bounces; less makes round-off larger
SETTLES = 1e-11


class Changes(NamedTuple):
    """Transitions of each contact at an instant."""

    strikes: ContactFlags
    stops: ContactFlags  # stops slipping
    begins: ContactFlags  # starts to slip


class Struck(NamedTuple):
    """Impulses at all contacts, their modes during the impact, and whether the result is valid."""

    P: ContactVectors
    modes: Modes
    has_law: Flag
    is_decided: Flag


def _struck(at: At, touches: ContactFlags, strikes: ContactFlags, i: int) -> Struck:
    """Return the impulses of an impact: by `impulse` at contact i, or by Moreau's law at all contacts at
    once.
    """
    e_n = jnp.where(strikes & ~at.settles, at.restitution, 0.0)
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
        hits, goes_on = jnp.any(strikes), jnp.any(begins)
        closed = (at.number != FLIES) | (hits & at.settles)
        struck = _struck(at, closed | strikes, strikes, i)
        held = at.modes._replace(rolls=jnp.where(stops, 1.0, at.modes.rolls))
        stopping = responses(at.found.G, rows.w[:, None], held, at.friction)[:, 0]
        P = jnp.where(goes_on, 0.0, jnp.where(hits, struck.P.ravel(), stopping))
        rolls = jnp.where(hits, struck.modes.rolls, held.rolls)
        w = (rows.w + at.found.G @ P).reshape(-1, 3)
        gained = 0.5 * P @ (rows.w + w.ravel())
        self.u = motion.u.array + jnp.where(jnp.isfinite(gained), at.found.impulses @ P, 0.0)

        touches = jnp.where(goes_on, closed, (closed | strikes) & (w[:, 0] < LEAST_SLIP))
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
        self.direction = rest.modes.direction[i]
        bounces = strikes & (numbers == FLIES) & (at.w[:, 0] < -w[:, 0])
        falls = -(then.found.G @ rest.P.ravel() + then.found.b)[::3]
        share = 1 + w[:, 0] / jnp.where(bounces, at.w[:, 0], 1.0)
        settles = bounces & (falls > 0) & (2 * w[:, 0] ** 2 <= SETTLES * falls * share**2)
        rests = motion.t + 2 * w[:, 0] / jnp.where(settles, falls * share, 1.0)
        waits = jnp.where((at.settles & ~hits)[:, None], at.slots, 0.0)
        waits = jnp.where(settles[:, None], jnp.stack([rests, zero + 1], axis=1), waits)
        self.slots = jnp.where((numbers >= SLIPS)[:, None], rest.modes.direction, waits)

        has_law = jnp.all(rest.holds) & (~hits | struck.has_law)
        faults = (
            (~has_law, PAINLEVE if len(numbers) == 1 else UNDECIDED),
            (hits & (gained > ROUND_OFF * jnp.abs(P @ rows.w)), GAINS_ENERGY),
            ((hits & ~struck.is_decided) | ~jnp.isfinite(gained), UNDECIDED),
        )
        if (above := at.above_flat[i]) is not None:
            faults = (*faults, ((touches | strikes)[i] & (above < 0), FLAT))
        for fault, why in faults:
            numbers = numbers.at[i].set(jnp.where(fault, float(why), numbers[i]))
        self.numbers = numbers


NEARLY = 1e-4  # numerics: least share of the ground's response that friction leaves; 0 at Painleve's paradox
# numerics, m/s: slip ends at this speed against its direction; larger than the round-off when it starts
STOPS = 1e-13
SAME = 1e-12  # numerics, m: a contact that closes within this gap strikes together with another
TOUCHES = 1e-8  # numerics, m: a gap below this counts as closed at the start


def contact_events(at: At) -> dict[str, Scalar]:
    """Return values of the events of all switching contacts."""
    events, forces, one = {}, at.forces, jnp.ones_like(at.motion.t)
    for i, name in enumerate(at.scene.switching.contacts):
        number, normal, tangential, slip = at.number[i], forces[i, 0], forces[i, 1:], at.w[i, 1:]
        bound, along = at.static[i] * normal, at.modes.direction[i] @ slip
        ahead = jnp.where(at.settles[i], at.slots[i, 0] - at.motion.t, at.found.rows.gap[i])
        events[f"{name} normal"] = jnp.where(number == FLIES, ahead, normal)
        while_closed = along - jnp.where(number == SLIPS, SLOW, -STOPS)
        events[f"{name} tangent"] = jnp.where(
            number == FLIES,
            one,
            jnp.where(number == ROLLS, bound * bound - tangential @ tangential, while_closed),
        )
        bears, stands = _bearing(at, i) - NEARLY, one
        if (above := at.above_flat[i]) is not None:
            stands = jnp.where(number == ROLLS, above, one)
            bears = bears * above / jnp.sqrt(bears**2 + above**2)  # zero with either factor
        while_slips = jnp.where(number == SLIPS, bears, stands)
        events[f"{name} speed"] = jnp.where(number == CREEPS, 2 * SLOW - along, while_slips)
    return events


def contact_changes(at: At) -> dict[str, Event]:
    """Return the events of the switching contacts by name, each with the state and the modes after it."""
    events = {}
    for i, name in enumerate(at.scene.switching.contacts):
        number, own = at.number[i], jnp.arange(len(at.number)) == i
        strikes, stops = number == FLIES, number == CREEPS
        together = own if at.impacts[i] != "moreau" else own | ((at.found.rows.gap < SAME) & (at.w[:, 0] < 0))
        flying = strikes & (at.number == FLIES) & together
        after = After(at, i, Changes(flying, own & stops, own & (number == ROLLS)))
        events[f"{name} normal"] = _event(after, strikes, FLIES, jnp.zeros(2))
        # at the start of slip the law at rest gives the direction, even if the contact sticks by round-off
        e = jnp.where(number == SLIPS, at.modes.direction[i], after.direction)
        events[f"{name} tangent"] = _event(after, stops, CREEPS, e)
        ends = jnp.asarray(float(PAINLEVE))
        if (above := at.above_flat[i]) is not None:
            ends = jnp.where(above < FLAT_BELOW, float(FLAT), ends)
        faster = jnp.where(number == CREEPS, float(SLIPS), ends)
        events[f"{name} speed"] = _event(
            after,
            jnp.asarray(False),
            faster,
            at.modes.direction[i],
            _speeds_on_rows(at, at.number.at[i].set(float(SLIPS))),
        )
    return events


def _event(
    after: "After", jumps: Flag, mode: Scalar | int, e: Float[Array, "2"], u: Speeds | None = None
) -> Event:
    """Return an event. If speeds jump, all modes come from `after`; otherwise contact i gets `mode`."""
    at, i, names = after.at, after.i, after.at.scene.switching.contacts
    numbers = jnp.where(jumps, after.numbers, at.number.at[i].set(mode))
    u = jnp.where(jumps, after.u, at.motion.u.array if u is None else u)
    e = jnp.where(jumps, after.slots, at.slots.at[i].set(e))
    directions = {f"{name}_slip_{k}": e[j, k - 1] for j, name in enumerate(names) for k in (1, 2)}
    jump = dict(zip(at.scene.speed_names.entries, u, strict=True)) | directions
    return Event(jnp.ones_like(at.motion.t), to=dict(zip(names, numbers, strict=True)), jump=jump)


def put_back(at: At) -> tuple[PerCoordinate, Speeds]:
    """Return coordinates on the ground, with directions of slip e of length one, and speeds that satisfy the
    laws of closed contacts.

        q - D' (D D')^-1 gap,  D = d gap/dq;       e/|e|;       u by `_speeds_on_rows`
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
    return jnp.append(q[: -e.size], e), _speeds_on_rows(at, at.number)


def _speeds_on_rows(at: At, number: PerContact) -> Speeds:
    """Return `u + M^-1 A' T P` with `(T G T + 1 - T) P = -T w`, for contacts in the modes `number`.

    T projects the speeds w onto the parts that must vanish: normal speeds of closed contacts, slip of rolling
    contacts, and slip across e of slipping contacts.
    """
    found, blocks = at.found, []
    for closed, rolls, e, slips in zip(*at.modes, number == SLIPS, strict=True):
        n = jnp.where(slips, jnp.stack([-e[1], e[0]]), 0.0)
        blocks.append(jnp.diag(jnp.stack([closed, rolls, rolls])).at[1:, 1:].add(jnp.outer(n, n)))
    T = jax.scipy.linalg.block_diag(*blocks)
    P = solved(list(T @ found.G @ T + jnp.eye(len(T)) - T), list(-(T @ found.rows.w)[:, None]))
    return at.motion.u.array + found.impulses @ T @ jnp.concatenate(P)


class Begun(NamedTuple):
    """Contacts at the start of a motion."""

    numbers: PerContact  # of the modes
    below: Scalar  # m, depth of a body below its ground; infinite if the contacts have no solution
    q: PerCoordinate  # on the ground for contacts that touch
    u: Speeds  # after an impact, if contacts strike


def contacts_at_start(at: At) -> Begun:
    """Return the modes of the contacts at the start of a motion, and the state in these modes."""
    scene, motion, gap, w = at.scene, at.motion, at.found.rows.gap, at.w
    touches = gap < TOUCHES
    strikes = touches & (w[:, 0] < -LEAST_SLIP)
    closed = touches & (jnp.abs(w[:, 0]) <= LEAST_SLIP)
    slips = moves(w, SLOW)
    numbers = jnp.where(closed, jnp.where(slips, float(SLIPS), float(ROLLS)), float(FLIES))
    e = jnp.where((closed & slips)[:, None], unit(w[:, 1:]), 0.0)
    q = jnp.append(motion.q.array[: -e.size], e)
    q, u = put_back(At(scene, switched(scene, motion, numbers, q, motion.u.array), at.found))
    no = jnp.zeros_like(strikes)
    begun = At(scene, switched(scene, motion, numbers, q, u), None, at.responses)
    first = next((i for i, impact in enumerate(at.impacts) if impact != "moreau"), 0)
    after = After(begun, first, Changes(strikes, no, no))
    numbers, u = after.numbers, after.u
    q = jnp.append(q[: -e.size], after.slots)
    then = At(scene, switched(scene, motion, numbers, q, u), None, at.responses)
    bears = jnp.stack([(number != SLIPS) | (_bearing(then, i) > NEARLY) for i, number in enumerate(numbers)])
    below = jnp.where(jnp.all(bears & (numbers >= FLIES)), jnp.max(-gap, initial=0.0), jnp.inf)
    return Begun(numbers, below, q, u)


def _bearing(at: At, i: int) -> Scalar:
    """Return `1 - mu G_nt.e/G_nn`, the share of the normal response that friction leaves while contact i
    slips.
    """
    own = at.alone(i, at.found.b)
    return 1 - at.friction[i] * (own.G[0, 1:] @ at.modes.direction[i]) / own.G[0, 0]
