"""Contacts that fly, roll, slip and strike: what ends each phase, and what comes after it.

    M du/dt = h + A' L          flies: L = 0      rolls: dw = 0      slips: dw_n = 0, L_t = -mu L_n e, e along w_t      creeps: slips more slowly than s

    ends        normal                       tangent                      speed
    flies       gap
    rolls       L_n                          (mu_s L_n)^2 - |L_t|^2
    slips       L_n                          e.w_t - s                    (G_nn - mu G_nt.e)/G_nn, which vanishes at Painleve's paradox
    creeps      L_n                          e.w_t                        2 s - e.w_t

The direction of slip is a number of the state with the rate `n (n.dw_t)/(e.w_t)`, n = J e: errors of w_t across it do not turn it (`slip_turns`). It has no
limit at rest: below the speed s it turns no faster than at s. A contact that strikes gets an impulse P by Newton's restitution and Coulomb's law on the slip
afterwards (Moreau); closed contacts take part in their modes:

    u+ = u- + M^-1 A' P,   w_n+ = -e w_n-,   |P_t| <= mu P_n, and w_t+ = 0 or P_t against w_t+

Source: J. J. Moreau, in: Nonsmooth Mechanics and Applications (1988), for impacts; Antali and Stepan (`contact_laws.py`) for slip that begins.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jourdain_jax.calculus.reals import Flag, Scalar, Speeds
from jourdain_jax.equations.contact_laws import LEAST_SLIP, ROUND_OFF, SLOW, Impulse, Modes, coulomb, impulse, moves, responses, solved
from jourdain_jax.equations.contact_rows import switching_contacts
from jourdain_jax.equations.kinematics import motion_at
from jourdain_jax.equations.virtual_power import ContactResponse, contact_modes, contact_response, friction_of, switching_forces
from jourdain_jax.scene.modes import Event
from jourdain_jax.scene.motion_state import Motion
from jourdain_jax.scene.scene import Scene
from jourdain_jax.scene.switching import CREEPS, FLIES, GAINS_ENERGY, PAINLEVE, ROLLS, SLIPS, UNDECIDED

LEAST_REBOUND = 1e-6  # m/s: a contact that would rebound with less is closed
NEARLY = 1e-4  # of the response of the ground that is left near Painleve's paradox
STOPS = 1e-13  # m/s against its direction end a slip: round-off where slip begins does not
ROUNDS = 4  # in which the modes of several contacts in an impact are looked for
TOUCHES = 1e-8  # m: a gap that counts as none at the start


class At:
    """The contacts that switch, at the state of a motion, with what their forces do there (default: worked out).

    `responses`: those that were worked out, here and at states after this one, each after its coordinates, speeds and inputs.
    """

    def __init__(self, scene: Scene, motion: Motion, found: ContactResponse | None = None, responses: list | None = None):
        self.scene, self.motion, self.responses = scene, motion, [] if responses is None else responses
        self.found = contact_response(scene, motion) if found is None else found
        self.responses += [(motion.q.array, motion.u.array, motion.inputs.array, self.found)] if found is None else []
        self.friction = friction_of(scene, motion)
        self.static = jnp.stack([contact.friction.static for contact in switching_contacts(scene, motion.pose()).values() if contact.friction])
        self.modes: Modes = contact_modes(scene, motion)
        self.w = self.found.rows.w.reshape(-1, 3)
        self.number = jnp.stack([motion.modes[name] for name in scene.switching.contacts])

    @property
    def forces(self) -> Float[Array, "contacts 3"]:
        """Normal forces, and those along both tangents, N."""
        return switching_forces(self.scene, self.motion, self.found).reshape(-1, 3)

    def alone(self, i: int, b: Float[Array, "rows"], modes: Modes | None = None) -> "Alone":
        """Return how contact i responds, with `G L + b`, while the others are in their modes (default: those that they are in)."""
        modes, mine = self.modes if modes is None else modes, slice(3 * i, 3 * i + 3)
        if len(self.number) == 1:
            return Alone(self.found.G, b, jnp.zeros((3, 4), b.dtype), jnp.diagonal(self.found.G))
        others = modes._replace(closed=modes.closed.at[i].set(0.0), rolls=modes.rolls.at[i].set(0.0))
        right = jnp.concatenate([self.found.G[:, mine], b[:, None]], axis=1)
        borne = responses(self.found.G, right, others, self.friction)
        total = (right + self.found.G @ borne)[mine]
        return Alone(total[:, :3], total[:, 3], borne, jnp.diagonal(self.found.G)[mine])


class Alone(NamedTuple):
    """The response of one contact while the others are in their modes."""

    G: Float[Array, "3 3"]
    b: Float[Array, "3"]
    borne: Float[Array, "rows 4"]  # forces of all for those of this one, and without
    sizes: Float[Array, "3"]  # of the diagonal of G, were all others open

    def every(self, i: int, own: Float[Array, "3"]) -> Float[Array, "rows"]:
        """Return the forces of all contacts where contact i has its `own`."""
        return (self.borne[:, :3] @ own + self.borne[:, 3]).at[3 * i : 3 * i + 3].set(own)


def contact_events(at: At) -> dict[str, Scalar]:
    """Values of the events of all contacts that switch."""
    events, forces, one = {}, at.forces, jnp.ones_like(at.motion.t)
    for i, name in enumerate(at.scene.switching.contacts):
        number, normal, tangential, slip = at.number[i], forces[i, 0], forces[i, 1:], at.w[i, 1:]
        bound, along = at.static[i] * normal, at.modes.direction[i] @ slip
        events[f"{name} normal"] = jnp.where(number == FLIES, at.found.rows.gap[i], normal)
        while_closed = along - jnp.where(number == SLIPS, SLOW, -STOPS)
        events[f"{name} tangent"] = jnp.where(number == FLIES, one, jnp.where(number == ROLLS, bound * bound - tangential @ tangential, while_closed))
        events[f"{name} speed"] = jnp.where(number == CREEPS, 2 * SLOW - along, jnp.where(number == SLIPS, _bearing(at, i) - NEARLY, one))
    return events


def contact_changes(at: At) -> dict[str, Event]:
    """Return what each event of the contacts that switch makes of the state and the modes."""
    events = {}
    for i, name in enumerate(at.scene.switching.contacts):
        number = at.number[i]
        strikes, stops = number == FLIES, number == CREEPS
        after = After(at, i, strikes)
        events[f"{name} normal"] = _event(after, strikes, FLIES, after.direction)
        # the law at rest, from where slip begins, says the direction of slip also where round-off would let it stick
        e = jnp.where(number == SLIPS, at.modes.direction[i], after.direction)
        events[f"{name} tangent"] = _event(after, stops, CREEPS, e)
        faster = jnp.where(number == CREEPS, float(SLIPS), float(PAINLEVE))
        events[f"{name} speed"] = _event(after, jnp.asarray(False), faster, at.modes.direction[i], _speeds_on_rows(at, at.number.at[i].set(float(SLIPS))))
    return events


def _event(after: "After", jumps: Flag, mode: Scalar | int, e: Float[Array, "2"], u: Speeds | None = None) -> Event:
    """Where speeds jump all modes are those `after` it, otherwise the contact's own becomes this one."""
    at, i, names = after.at, after.i, after.at.scene.switching.contacts
    numbers = jnp.where(jumps, after.numbers, at.number.at[i].set(mode))
    u, e = jnp.where(jumps, after.u, at.motion.u.array if u is None else u), jnp.where(jumps, after.e, at.modes.direction.at[i].set(e))
    e = jnp.where((numbers >= SLIPS)[:, None], e, 0.0)
    directions = {f"{name}_slip_{k}": e[j, k - 1] for j, name in enumerate(names) for k in (1, 2)}
    jump = dict(zip(at.scene.speed_names.entries, u, strict=True)) | directions
    return Event(jnp.ones_like(at.motion.t), to=dict(zip(names, numbers, strict=True)), jump=jump)


def _bearing(at: At, i: int) -> Scalar:
    """Return how much of the ground's response along the normal is left while contact i slips."""
    own = at.alone(i, at.found.b)
    return 1 - at.friction[i] * (own.G[0, 1:] @ at.modes.direction[i]) / own.G[0, 0]


class After:
    """Speeds, modes and direction of slip where contact i closes: after an impact if it `strikes`, otherwise as its slip stops or is about to begin.

    Other contacts that are closed take part: one that would pull opens, and one that would hold with more than its friction slips. Where that does not come
    out, where an impact would gain energy, or has no answer, the mode is a negative number that says why.
    """

    def __init__(self, at: At, i: int, strikes: Flag):
        self.at, self.i = at, i
        scene, motion, friction = at.scene, at.motion, at.friction[i]
        contact = list(switching_contacts(scene, motion.pose()).values())[i]
        rebounds = strikes & (-jnp.asarray(contact.restitution) * at.w[i, 0] > LEAST_REBOUND)
        restitution = jnp.where(rebounds, contact.restitution, 0.0)

        def impulses(modes: Modes) -> tuple[Impulse, Float[Array, "contacts 3"]]:
            own = at.alone(i, at.found.rows.w, modes)
            struck = impulse(contact.impact, own.G, own.b, restitution, friction, own.sizes)
            sticking = jnp.concatenate(solved(list(own.G), list(-own.b[:, None]), list(own.sizes)))
            return struck, own.every(i, jnp.where(strikes, struck.P, sticking)).reshape(-1, 3)

        modes = at.modes
        struck, P = impulses(modes)
        right = jnp.asarray(True)
        for turn in range(ROUNDS if len(at.number) > 1 else 0):
            modes = _yielding(at, i, modes, P, turn % 2 == 1)
            struck, P = impulses(modes)
            right = _is_lawful(at, i, modes, P)
        jumps = at.number[i] != ROLLS  # otherwise nothing strikes or stops
        w = (at.found.rows.w + at.found.G @ P.ravel()).reshape(-1, 3)
        gained = 0.5 * P.ravel() @ (at.found.rows.w + w.ravel())
        self.u = motion.u.array + jnp.where(jumps & jnp.isfinite(gained), at.found.impulses @ P.ravel(), 0.0)
        slipping = jnp.where(moves(w, SLOW), float(SLIPS), float(CREEPS))
        slides = moves(w, LEAST_SLIP)
        others = jnp.where(modes.closed == 0, float(FLIES), jnp.where(slides & (modes.rolls == 0), slipping, float(ROLLS)))
        own_number = jnp.where(rebounds, float(FLIES), jnp.where(strikes & struck.slips, slipping[i], float(ROLLS)))
        numbers, e = jnp.where(jumps, others, at.number).at[i].set(own_number), jnp.where(slides[:, None], _along(w[:, 1:]), modes.direction)
        q = jnp.append(motion.q.array[: -e.size], e)
        then = At(scene, _switched(scene, motion, numbers, q, self.u), None, at.responses)
        modes, has_law = then.modes, jnp.where(strikes, struck.exists, True)
        for j in (i, *(j for j in range(len(numbers)) if j != i)):  # what does not slip settles by the law at rest
            own = then.alone(j, then.found.b, modes)
            rest = coulomb(own.G, own.b, jnp.zeros_like(friction), at.friction[j], at.static[j], own.sizes)
            settled = jnp.where(rest.opens, float(FLIES), jnp.where(rest.sticks, float(ROLLS), float(CREEPS)))
            waits = (numbers[j] == ROLLS) & (jumps | (i == j))
            number = jnp.where(waits, settled, numbers[j])
            numbers, e = numbers.at[j].set(number), e.at[j].set(jnp.where(waits, rest.direction, e[j]))
            closed, rolls = jnp.where(number == FLIES, 0.0, 1.0), jnp.where(number == ROLLS, 1.0, 0.0)
            direction = jnp.where(number >= SLIPS, e[j], 0.0)
            modes = Modes(modes.closed.at[j].set(closed), modes.rolls.at[j].set(rolls), modes.direction.at[j].set(direction))
            has_law &= ~waits | rest.exists
        most = ROUND_OFF * jnp.abs(P.ravel() @ at.found.rows.w)
        for lawful, fault in ((has_law, PAINLEVE), (~(gained > most), GAINS_ENERGY), (right & jnp.isfinite(gained), UNDECIDED)):
            numbers = numbers.at[i].set(jnp.where(lawful | (~jumps & (fault != PAINLEVE)), numbers[i], float(fault)))
        self.numbers, self.e, self.direction = numbers, e, e[i]


def _excess(at: At, P: Float[Array, "contacts 3"]) -> tuple[Float[Array, "contacts"], Float[Array, "contacts"]]:
    """Return by how much (m/s) each contact pulls, and holds more than its friction does, under these impulses."""
    response = jnp.diagonal(at.found.G)[::3]
    tangential = jnp.sum(P[:, 1:] ** 2, axis=1)
    held = jnp.where(tangential > 0, jnp.sqrt(jnp.where(tangential > 0, tangential, 1.0)), 0.0)
    return -response * P[:, 0], response * (held - at.friction * P[:, 0])


def _yielding(at: At, i: int, modes: Modes, P: Float[Array, "contacts 3"], sticking: bool) -> Modes:
    """Return better modes of the others in an impact of contact i.

    closed, pulls: opens;   sticks, holds more than friction does: slips;   slips: along the slip afterwards;   open, moves into the ground: slips so, too

    `sticking`: what slips against its direction sticks.
    """
    pulled, exceeded = _excess(at, P)
    w = (at.found.rows.w + at.found.G @ P.ravel()).reshape(-1, 3)
    closed, sticks = modes.closed > 0, modes.rolls > 0
    pulls, enters = closed & (pulled > LEAST_SLIP), ~closed & (at.number != FLIES) & (w[:, 0] < -LEAST_SLIP)
    gives = sticks & (exceeded > LEAST_SLIP)
    stops = closed & ~sticks & (jnp.sum(w[:, 1:] * modes.direction, axis=1) < -LEAST_SLIP)
    fast = moves(w, LEAST_SLIP)
    along = jnp.where(fast[:, None], _along(w[:, 1:]), modes.direction)
    e = jnp.where(sticks[:, None], -_along(P[:, 1:]), along)
    now = jnp.where(pulls, 0.0, jnp.where(enters, 1.0, modes.closed))
    rolls = jnp.where(pulls | gives, 0.0, jnp.where((stops & sticking) | (enters & ~fast), 1.0, modes.rolls))
    return Modes(now.at[i].set(1.0), rolls, e)


def _is_lawful(at: At, i: int, modes: Modes, P: Float[Array, "contacts 3"]) -> Flag:
    """Whether no contact but i pulls, holds more than its friction does, is pushed by friction along its slip or aside, or moves into the ground."""
    w, (pulled, exceeded) = (at.found.rows.w + at.found.G @ P.ravel()).reshape(-1, 3), _excess(at, P)
    e, closed = modes.direction, modes.closed > 0
    along, aside = jnp.sum(w[:, 1:] * e, axis=1), w[:, 1] * e[:, 1] - w[:, 2] * e[:, 0]
    slips = closed & (modes.rolls == 0) & (pulled < -LEAST_SLIP)
    against = slips & ((along < -LEAST_SLIP) | (jnp.abs(aside) > LEAST_SLIP + 1e-6 * jnp.abs(along)))
    wrong = closed & ((pulled > LEAST_SLIP) | ((modes.rolls > 0) & (exceeded > LEAST_SLIP)) | against)
    into = (at.number != FLIES) & (w[:, 0] < -LEAST_SLIP)
    return ~jnp.any((wrong | into).at[i].set(False))


def put_back(at: At) -> tuple[Float[Array, "coordinates"], Speeds]:
    """Coordinates on the ground, by one step of Gauss-Newton, and speeds on the rows, of contacts that are closed.

    q - D' (D D')^-1 gap,  D = d gap/dq;       u + M^-1 A' P,  w + G P = 0 along the normals, and along the tangents of those that roll;       e/|e|
    """
    scene, motion, modes = at.scene, at.motion, at.modes
    q, closed = motion.q.array, modes.closed

    def gaps(q):
        pose = motion_at(scene, motion.t, q, motion.u.array, motion.inputs.array).pose()
        return closed * jnp.stack([contact.gap() for contact in switching_contacts(scene, pose).values()])

    D = jax.jacfwd(gaps)(q)
    moved = solved(list(D @ D.T + jnp.diag(1 - closed)), list(gaps(q)[:, None]))
    q = q - jnp.concatenate(moved) @ D
    return jnp.append(q[: -modes.direction.size], _along(modes.direction)), _speeds_on_rows(at, at.number)


def _speeds_on_rows(at: At, number: Float[Array, "contacts"]) -> Speeds:
    """Return `u + M^-1 A' T P`, `(T G T + 1 - T) P = -T w`, for contacts in these modes.

    T: the projection of w onto what vanishes: along the normal of closed contacts, all slip of those that roll, and slip across e of those that slip.
    """
    found, blocks = at.found, []
    for closed, rolls, e, slips in zip(*at.modes, number == SLIPS, strict=True):
        n = jnp.where(slips, jnp.stack([-e[1], e[0]]), 0.0)
        blocks.append(jnp.diag(jnp.stack([closed, rolls, rolls])).at[1:, 1:].add(jnp.outer(n, n)))
    T = jax.scipy.linalg.block_diag(*blocks)
    P = solved(list(T @ found.G @ T + jnp.eye(len(T)) - T), list(-(T @ found.rows.w)[:, None]))
    return at.motion.u.array + found.impulses @ T @ jnp.concatenate(P)


def _along(x: Float[Array, "*contacts 2"]) -> Float[Array, "*contacts 2"]:
    """Return unit vectors, and zero for zero."""
    square = jnp.sum(x * x, axis=-1, keepdims=True)
    return x / jnp.sqrt(jnp.where(square > 0, square, 1.0))


class Begun(NamedTuple):
    """Contacts at the start of a motion."""

    numbers: Float[Array, "contacts"]  # of their modes
    below: Scalar  # m, how far a body is below its ground; infinite where contacts have no answer
    q: Float[Array, "coordinates"]  # on the ground where they touch it
    u: Speeds  # after an impact where they strike it


def contacts_at_start(at: At) -> Begun:
    """Return in which modes contacts begin, and the state then."""
    scene, motion, gap, w = at.scene, at.motion, at.found.rows.gap, at.w
    touches = gap < TOUCHES
    strikes = touches & (w[:, 0] < -LEAST_REBOUND)
    closed = touches & (jnp.abs(w[:, 0]) <= LEAST_REBOUND)
    slips = moves(w, SLOW)
    numbers = jnp.where(closed, jnp.where(slips, float(SLIPS), float(ROLLS)), float(FLIES))
    e = jnp.where((closed & slips)[:, None], _along(w[:, 1:]), 0.0)
    q = jnp.append(motion.q.array[: -e.size], e)
    q, u = put_back(At(scene, _switched(scene, motion, numbers, q, motion.u.array), at.found))
    for i in range(len(numbers)):
        after = After(At(scene, _switched(scene, motion, numbers, q, u), None, at.responses), i, strikes[i])
        settles = closed[i] & ~slips[i]
        numbers = jnp.where(strikes[i], after.numbers, numbers.at[i].set(jnp.where(settles, after.numbers[i], numbers[i])))
        u = jnp.where(strikes[i], after.u, u)
        e = jnp.where(strikes[i], after.e, jnp.where(settles, e.at[i].set(after.direction), e))
        q = jnp.append(q[: -e.size], jnp.where((numbers >= SLIPS)[:, None], e, 0.0))
    then = At(scene, _switched(scene, motion, numbers, q, u), None, at.responses)
    bears = jnp.stack([(number != SLIPS) | (_bearing(then, i) > NEARLY) for i, number in enumerate(numbers)])
    below = jnp.where(jnp.all(bears & (numbers >= FLIES)), jnp.max(-gap, initial=0.0), jnp.inf)
    return Begun(numbers, below, q, u)


def _switched(scene: Scene, motion: Motion, numbers: Float[Array, "contacts"], q, u) -> Motion:
    inputs = jnp.concatenate([motion.inputs.array[: len(scene.inputs) - len(numbers)], numbers])
    return motion_at(scene, motion.t, q, u, inputs)
