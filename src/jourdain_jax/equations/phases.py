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
angle (`slip_turns`). Errors of w_t across e therefore do not turn it. The rate has no limit at rest: below
the speed s, s replaces e.w_t. Impacts: `impacts.py`.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jourdain_jax.calculus.reals import Flag, Scalar, Speeds
from jourdain_jax.equations.contact_laws import SLOW, moves, solved, unit
from jourdain_jax.equations.contact_rows import gaps_of
from jourdain_jax.equations.contact_state import FLAT_BELOW, At, switched
from jourdain_jax.equations.impacts import LEAST_REBOUND, After, Changes
from jourdain_jax.equations.kinematics import motion_at
from jourdain_jax.scene.contact.friction_contacts import CREEPS, FLAT, FLIES, PAINLEVE, ROLLS, SLIPS
from jourdain_jax.scene.modes import Event

# least share of the ground's response that friction must leave; it is zero at Painleve's paradox
NEARLY = 1e-4
STOPS = 1e-13  # m/s: slip ends at this speed against its direction; larger than the round-off when it starts
SAME = 1e-12  # m: a contact that closes within this gap strikes together with another
TOUCHES = 1e-8  # m: a gap below this counts as closed at the start


def contact_events(at: At) -> dict[str, Scalar]:
    """Return values of the events of all switching contacts."""
    events, forces, one = {}, at.forces, jnp.ones_like(at.motion.t)
    for i, name in enumerate(at.scene.switching.contacts):
        number, normal, tangential, slip = at.number[i], forces[i, 0], forces[i, 1:], at.w[i, 1:]
        bound, along = at.static[i] * normal, at.modes.direction[i] @ slip
        events[f"{name} normal"] = jnp.where(number == FLIES, at.found.rows.gap[i], normal)
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
    """Return an event, with the state and the modes afterwards, for each event of the switching contacts."""
    events = {}
    for i, name in enumerate(at.scene.switching.contacts):
        number, own = at.number[i], jnp.arange(len(at.number)) == i
        strikes, stops = number == FLIES, number == CREEPS
        together = own if at.impacts[i] != "moreau" else own | ((at.found.rows.gap < SAME) & (at.w[:, 0] < 0))
        flying = strikes & (at.number == FLIES) & together
        after = After(at, i, Changes(flying, own & stops, own & (number == ROLLS)))
        events[f"{name} normal"] = _event(after, strikes, FLIES, after.direction)
        # at the start of slip the law at rest gives the direction, even if the contact would stick by
        # round-off
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
    e = jnp.where(jumps, after.e, at.modes.direction.at[i].set(e))
    e = jnp.where((numbers >= SLIPS)[:, None], e, 0.0)
    directions = {f"{name}_slip_{k}": e[j, k - 1] for j, name in enumerate(names) for k in (1, 2)}
    jump = dict(zip(at.scene.speed_names.entries, u, strict=True)) | directions
    return Event(jnp.ones_like(at.motion.t), to=dict(zip(names, numbers, strict=True)), jump=jump)


def put_back(at: At) -> tuple[Float[Array, "coordinates"], Speeds]:
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
    return jnp.append(q[: -modes.direction.size], unit(modes.direction)), _speeds_on_rows(at, at.number)


def _speeds_on_rows(at: At, number: Float[Array, "contacts"]) -> Speeds:
    """Return `u + M^-1 A' T P` with `(T G T + 1 - T) P = -T w`, for contacts in these modes.

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

    numbers: Float[Array, "contacts"]  # of the modes
    below: Scalar  # m, depth of a body below its ground; infinite if the contacts have no solution
    q: Float[Array, "coordinates"]  # on the ground for contacts that touch
    u: Speeds  # after an impact, if contacts strike


def contacts_at_start(at: At) -> Begun:
    """Return the modes of the contacts at the start of a motion, and the state in these modes."""
    scene, motion, gap, w = at.scene, at.motion, at.found.rows.gap, at.w
    touches = gap < TOUCHES
    strikes = touches & (w[:, 0] < -LEAST_REBOUND)
    closed = touches & (jnp.abs(w[:, 0]) <= LEAST_REBOUND)
    slips = moves(w, SLOW)
    numbers = jnp.where(closed, jnp.where(slips, float(SLIPS), float(ROLLS)), float(FLIES))
    e = jnp.where((closed & slips)[:, None], unit(w[:, 1:]), 0.0)
    q = jnp.append(motion.q.array[: -e.size], e)
    q, u = put_back(At(scene, switched(scene, motion, numbers, q, motion.u.array), at.found))
    no = jnp.zeros_like(strikes)
    begun = At(scene, switched(scene, motion, numbers, q, u), None, at.responses)
    first = next((i for i, impact in enumerate(at.impacts) if impact != "moreau"), 0)
    after = After(begun, first, Changes(strikes, no, no))
    numbers, u, e = after.numbers, after.u, jnp.where((after.numbers >= SLIPS)[:, None], after.e, 0.0)
    q = jnp.append(q[: -e.size], e)
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
