"""Memory layout of the loop: a lane is a column, each number is a row, and a row is one vector for all lanes.

A sample enters with the rows of `Form.given`, which include its initial progress, and leaves with the rows of
its final progress. Tangents are stored after the values: after the state, and after the known numbers of the
rates. `dt` are tangents of time, which only the time of an event has. Derivatives of order n in
directions e_1 to e_n have 2^n - 1 tangents, one per subset of the directions, indexed by the binary number of
the subset. For second order, these are the tangents along e_1, along e_2, and along both. `taken` is the
advance by the last step. For Taylor series, `before` is the start time of the step, and `bound` limits the
next step after a rejection.

For sampled inputs (`samples.py`), `table` points to the samples of a lane, `samples` is their number per
input, and `knot` points to the next knot, at which a step must end.

If the motion continues after events (`transitions.py`), `mode` are the modes, and `passed` counts the
transitions. For each transition, `log_event`, `log_mode`, `log_lost` and `log_t` record the event, the new
modes, the loss of energy, and the time with its tangents. `begun` is the number of steps accepted up to the
last transition. `disarmed` marks events whose value has not left zero since they happened. `left` describes
the transition in the last trial step: the index of the event plus 1 (negative if its value has zero slope),
or 0 if there was none; its time; the state and the modes before it.
"""

from dataclasses import dataclass
from itertools import pairwise

from jourdain_jax.calculus.reals import Indices
from jourdain_jax.lowering.lowered_equations import Lowered

PROGRESS = ("t", "h", "code", "accepted", "rejected", "event", "pivot", "crossings")
SAMPLES = ("table", "samples", "knot")
CONTROL = ("rtol", "atol", "longest", "max_steps", "origin")


@dataclass(frozen=True)
class Form:
    """Options that determine the loop and its memory: scalar program, work, projection, events, monitored
    pivots.
    """

    program: Lowered
    with_work: bool
    projects: bool
    affine: bool
    has_events: bool
    pivots: int  # number of monitored pivots
    moving: tuple[Indices, ...] = ()  # for each tangent, the indices of the known numbers that have it
    sampled: Indices = ()  # indices of sampled inputs
    time_moves: bool = False  # whether time has tangents
    compensated: bool = False  # whether the state uses compensated summation, as in single precision
    switched: Indices = ()  # indices of the inputs that are modes
    stops: tuple[bool, ...] = ()  # whether each event ends the motion; empty: all do
    most: int = 0  # maximum number of transitions of a motion
    stopping: bool = True  # whether events that end a motion are active
    # whether each relation has integer sides (`floor`, `ceil`); relations are the last modes and events
    sides: tuple[bool, ...] = ()

    @property
    def rates(self) -> list[int]:
        """Return the nodes of the state's rates."""
        program = self.program
        return [*program.qdot, *program.ydot, *([program.power] if self.with_work else [])]

    @property
    def modes(self) -> int:
        """Return the number of modes of the scene."""
        return len(self.switched) - len(self.sides)

    @property
    def stated(self) -> int:
        """Return the number of events that the scene states."""
        return self.events - len(self.sides)

    @property
    def monitored(self) -> list[int]:
        """Return the nodes monitored at all stages of a step: pivots, directions of constraints, then
        distances from a loss of rank (`squares`).
        """
        return [*self.program.pivots[: self.pivots], *self.program.directions, *self.squares]

    @property
    def speeds(self) -> int:
        """Return the number of speeds."""
        return len(self.program.ydot)

    @property
    def turning(self) -> int:
        """Return the total number of entries of the directions of constraints."""
        return len(self.program.directions)

    @property
    def known(self) -> dict[str, int]:
        """Return the numbers of rows for known numbers (except time and state) and for their tangents."""
        return {
            "known": len(self.program.fixed) + len(self.program.inputs),
            "dknown": sum(map(len, self.moving)),
        }

    @property
    def squares(self) -> Indices:
        """Return two nodes for each constraint: its squared component normal to the earlier constraints, and
        its squared size.
        """
        return self.program.squares if self.projects else ()

    @property
    def moves(self) -> list[int]:
        """Return the sequence of projection steps: 1 for coordinates, 0 for speeds."""
        return [1, 1] + [0] * (0 if not self.program.projected_u else 1 if self.affine else 2)

    @property
    def nodes(self) -> list[int]:
        """Return all evaluated nodes."""
        program = self.program
        projected = [*program.projected_q, *program.projected_u] if self.projects else []
        events = program.events if self.has_events else ()
        return [
            *self.rates,
            *program.guards,
            *program.pivots,
            *program.directions,
            *self.squares,
            *projected,
            *events,
        ]

    def split(self, variables: list[int]) -> tuple[list[int], int, list[int], list[int]]:
        """Split `variables` into the nodes of fixed values, of time, of coordinates and integrated speeds,
        and of inputs.
        """
        t = len(self.program.fixed)
        end = t + 1 + self.q_and_v
        return variables[:t], variables[t], variables[t + 1 : end], variables[end:]

    @property
    def coordinates(self) -> int:
        """Return the number of coordinates."""
        return len(self.program.qdot)

    @property
    def goes_on(self) -> bool:
        """Return whether a motion continues after some events."""
        return self.has_events and not all(self.stops)

    @property
    def transitions(self) -> int:
        """Return the maximum number of recorded transitions; zero if all events of the scene are final."""
        return self.most if self.goes_on and not all(self.stops[: self.stated]) else 0

    @property
    def rows_of_transition(self) -> dict[str, range]:
        """Return the rows of the results of a transition: the state after it, the modes, the loss of energy,
        and the time with its tangents.
        """
        counts = {"y": self.integrated, "mode": len(self.switched), "lost": 1, "t": 1 + len(self.moving)}
        return _in_a_row(counts)

    @property
    def q_and_v(self) -> int:
        """Return the number of coordinates and speeds."""
        return self.coordinates + self.speeds

    @property
    def events(self) -> int:
        """Return the number of stop events."""
        return len(self.program.events) if self.has_events else 0

    @property
    def y(self) -> int:
        """Return the number of integrated values: coordinates, speeds, and then the work, if any."""
        return self.q_and_v + self.with_work

    @property
    def integrated(self) -> int:
        """Return the number of values of the state and its tangents."""
        return self.y * (1 + len(self.moving))

    @property
    def ends(self) -> int:
        """Return the number of cotangents of the end: final state, its time, times of transitions, and the
        tangents of all these.
        """
        return (self.y + 1 + self.transitions) * (1 + len(self.moving))

    @property
    def parts(self) -> list[range]:
        """Return the rows of the coordinates, of the speeds and of the work, if any."""
        ends = [0, self.coordinates, self.q_and_v, self.y]
        return [range(a, b) for a, b in pairwise(ends) if b > a]

    @property
    def rows(self) -> dict[str, range]:
        """Return the rows of each quantity, by name."""
        search = {
            "search_t": 3,
            "search_c": 3 * self.events,
            "search_step": 1,
            "search_left": 1,
            "search_shift": 1,
            "search_slope": self.events,
        }
        most, modes = self.transitions, len(self.switched)
        log = {
            "log_event": most,
            "log_mode": most * self.modes,
            "log_lost": most,
            "log_t": most * (1 + len(self.moving)),
        }
        counts = {
            "y": self.integrated,
            **dict.fromkeys(PROGRESS, 1),
            "dt": len(self.moving),
            **({"passed": 1} if self.goes_on else {}),
            **dict.fromkeys(CONTROL, 1),
            "mode": modes,
        }
        counts |= {
            **self.known,
            **dict.fromkeys(("goal", "last_goal", "direction", "taken"), 1),
            **dict.fromkeys(("before", "bound"), 1),
            **(search if self.events else {}),
            **dict.fromkeys(SAMPLES if self.sampled else (), 1),
        }
        counts |= dict.fromkeys(("rest", "next_rest"), self.y) if self.compensated else {}
        counts |= (
            {"begun": 1, "disarmed": self.events, "left": 2 + self.integrated + modes, **log}
            if self.goes_on
            else {}
        )
        return _in_a_row(counts)

    @property
    def log(self) -> range:
        """Return the rows that record transitions, which are the last rows."""
        return range(self.rows["log_event"].start if self.goes_on else self.all, self.all)

    @property
    def returned(self) -> int:
        """Return the number of rows returned by a motion, before those of `log`."""
        return self.rows[CONTROL[0]].start

    @property
    def given(self) -> int:
        """Return the number of rows passed to a motion."""
        return self.rows["goal"].start

    @property
    def all(self) -> int:
        """Return the number of all rows."""
        return max(rows.stop for rows in self.rows.values())


def _in_a_row(counts: dict[str, int]) -> dict[str, range]:
    found, first = {}, 0
    for name, count in counts.items():
        found[name] = range(first, first + count)
        first += count
    return found
