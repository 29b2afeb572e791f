"""The memory layout of lanes: a lane is a column, each number is a row, and a row is one vector for all lanes
side by side.

A lane is handed over with all rows of `Form.given`, its progress at the start among them, and handed back with those of its progress. Where tangents are
pushed along, the state is followed by its own, and so are the numbers that the rates are given; `dt` are those of time, which only an event's has. Of
derivatives of order n in directions e_1 to e_n the tangents are 2^n - 1, in the order of the binary numbers that say which e_i are taken together: of the
second order those along e_1, e_2, and both. `taken` is by how far the last step has gone; of
a step by Taylor series, `before` is the time at which it began, and `bound` how long the next one may be
after one that was rejected.

Where inputs are given by samples, rows of pointers and whole numbers say where the samples of a lane are (`table`), how many each input has (`samples`), and
where the next knot is at which a step must end (`knot`; `samples.py`).

Where events let the motion go on (`transitions.py`), `mode` are the modes, `passed` counts the transitions, and `log_event`, `log_mode`, `log_lost` and `log_t`
hold of each the event, the modes after it, by how much the energy fell, and the time with its tangents. `begun` is how many steps had been tried at the
last one, `disarmed` tells which events have not been left since they happened, and `left` holds what the last try left by a transition: the event's number
and 1 (negative where its value has no slope), or 0 for none; its time; the state and the modes before it.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

from jourdain_jax.calculus.reals import Indices
from jourdain_jax.lowering.lowered import Lowered
from jourdain_jax.native.ir import Value, Writer
from jourdain_jax.native.math_functions import power

PROGRESS = ("t", "h", "code", "accepted", "rejected", "event", "pivot", "crossings")
SAMPLES = ("table", "samples", "knot")
CONTROL = ("direction", "last_goal", "rtol", "atol", "shortest", "longest", "max_steps", "origin")


@dataclass(frozen=True)
class Form:
    """The integrated form: a lowered scene with its options: work, projection, events, monitored pivots."""

    program: Lowered
    with_work: bool
    projects: bool
    affine: bool
    has_events: bool
    pivots: int  # how many are monitored
    moving: tuple[Indices, ...] = ()  # of every tangent, which of the numbers known have it
    sampled: Indices = ()  # which of the inputs are given by samples
    time_moves: bool = False  # whether time has tangents
    compensated: bool = False  # whether the state is summed with what rounding leaves off, as in single precision
    switched: Indices = ()  # which of the inputs are modes
    stops: tuple[bool, ...] = ()  # whether each event ends the motion; empty: all do
    most: int = 0  # transitions of a motion
    stopping: bool = True  # whether events that end a motion do
    sides: tuple[bool, ...] = ()  # of relations, the last modes and events: whether each is of whole numbers

    @property
    def rates(self) -> list[int]:
        """The rates of the state."""
        program = self.program
        return [*program.qdot, *program.ydot, *([program.power] if self.with_work else [])]

    @property
    def modes(self) -> int:
        """Return the number of modes of the scene."""
        return len(self.switched) - len(self.sides)

    @property
    def stated(self) -> int:
        """Numbers of events that the scene states."""
        return self.events - len(self.sides)

    @property
    def monitored(self) -> list[int]:
        """Return the monitored quantities at all stages of a step: pivots first, then directions of rows,
        then distances from a loss of rank."""
        return [*self.program.pivots[: self.pivots], *self.program.directions, *self.squares]

    @property
    def speeds(self) -> int:
        """Numbers of speeds."""
        return len(self.program.ydot)

    @property
    def turning(self) -> int:
        """Numbers of all entries of directions of rows."""
        return len(self.program.directions)

    @property
    def known(self) -> dict[str, int]:
        """Rows of the numbers known beside time and the state, and of their tangents."""
        return {"known": len(self.program.fixed) + len(self.program.inputs), "dknown": sum(map(len, self.moving))}

    @property
    def squares(self) -> Indices:
        """Return the squared parts of rows normal to their predecessors, and squared sizes, alternating."""
        return self.program.squares if self.projects else ()

    @property
    def moves(self) -> list[int]:
        """A projection step by step, 1: of the coordinates, 0: of the speeds."""
        return [1, 1] + [0] * (0 if not self.program.projected_u else 1 if self.affine else 2)

    @property
    def nodes(self) -> list[int]:
        """All that is evaluated."""
        program = self.program
        projected = [*program.projected_q, *program.projected_u] if self.projects else []
        events = program.events if self.has_events else ()
        return [*self.rates, *program.guards, *program.pivots, *program.directions, *self.squares, *projected, *events]

    def split(self, variables: list[int]) -> tuple[list[int], int, list[int], list[int]]:
        """Return the nodes of fixed values, of time, of the state without work, and of the inputs."""
        t = len(self.program.fixed)
        end = t + 1 + self.q_and_v
        return variables[:t], variables[t], variables[t + 1 : end], variables[end:]

    @property
    def coordinates(self) -> int:
        """Numbers of coordinates."""
        return len(self.program.qdot)

    @property
    def goes_on(self) -> bool:
        """Whether a motion goes on after some events."""
        return self.has_events and not all(self.stops)

    @property
    def transitions(self) -> int:
        """Return the largest number of transitions that a motion notes; zero if all of the scene's events end
        it."""
        return self.most if self.goes_on and not all(self.stops[: self.stated]) else 0

    @property
    def rows_of_transition(self) -> dict[str, range]:
        """Return the results of a transition: the state after it, modes, the loss of energy, and its time
        with its tangents."""
        counts = {"y": self.integrated, "mode": len(self.switched), "lost": 1, "t": 1 + len(self.moving)}
        return _in_a_row(counts)

    @property
    def q_and_v(self) -> int:
        """Numbers of coordinates and speeds."""
        return self.coordinates + self.speeds

    @property
    def events(self) -> int:
        """Numbers of stop events."""
        return len(self.program.events) if self.has_events else 0

    @property
    def y(self) -> int:
        """Return the number of integrated values: coordinates, speeds, and then the work, if any."""
        return self.q_and_v + self.with_work

    @property
    def integrated(self) -> int:
        """Numbers of the state and of its tangents."""
        return self.y * (1 + len(self.moving))

    @property
    def ends(self) -> int:
        """Return the number of values stored for the final state, its time, the times of transitions, and
        their tangents.
        """
        return (self.y + 1 + self.transitions) * (1 + len(self.moving))

    @property
    def parts(self) -> list[range]:
        """Return rows of the coordinates, of the speeds and of the work, if there are any."""
        ends = [0, self.coordinates, self.q_and_v, self.y]
        return [range(a, b) for a, b in pairwise(ends) if b > a]

    @property
    def rows(self) -> dict[str, range]:
        """Name -> rows."""
        search = {"search_t": 3, "search_c": 3 * self.events, "search_step": 1, "search_left": 1, "search_shift": 1, "search_slope": self.events}
        most, modes = self.transitions, len(self.switched)
        log = {"passed": 1, "log_event": most, "log_mode": most * self.modes, "log_lost": most, "log_t": most * (1 + len(self.moving))}
        log = log if self.goes_on else {}
        counts = {"y": self.integrated, **dict.fromkeys(PROGRESS, 1), "dt": len(self.moving), **log, **dict.fromkeys(CONTROL, 1), "mode": modes}
        counts |= {
            **self.known,
            "goal": 1,
            "taken": 1,
            "before": 1,
            "bound": 1,
            **(search if self.events else {}),
            **dict.fromkeys(SAMPLES if self.sampled else (), 1),
        }
        counts |= dict.fromkeys(("rest", "next_rest"), self.y) if self.compensated else {}
        counts |= {"begun": 1, "disarmed": self.events, "left": 2 + self.integrated + modes} if self.goes_on else {}
        return _in_a_row(counts)

    @property
    def returned(self) -> int:
        """How many rows are handed back."""
        return self.rows[CONTROL[0]].start

    @property
    def given(self) -> int:
        """How many rows are handed over."""
        return self.rows["goal"].start

    @property
    def all(self) -> int:
        """How many rows there are."""
        return max(rows.stop for rows in self.rows.values())


def _in_a_row(counts: dict[str, int]) -> dict[str, range]:
    found, first = {}, 0
    for name, count in counts.items():
        found[name] = range(first, first + count)
        first += count
    return found


Number = Any  # of a step: a value of machine code, an array, or a pointer to memory of either
StepWriter = Any  # `MachineWriter`, or `ArrayWriter`, by which the source runs on arrays of JAX


class MachineWriter(Writer):
    """Writes the source of a step as machine code.

    The source needs, beside arithmetic and memory, the following operations. Each is a method, so that a
    writer may use another form than instructions in a row:

        if_any(c, body)            what the body does counts where c holds in any lane; lanes are told apart by `where`
        over_stages(n, body, x)    x <- body(i, x)
        each(rows, body)           the body for every row, none of which needs what another one makes

    `common`: rows of a start that are equal in all lanes of a GPU, and are stored once.
    """

    common: Sequence[bool] = ()

    def constant(self, pointer: Value, index: int) -> Value:
        """Return a number that is equal in all threads of a GPU, from memory that does not change during the
        kernel.
        """
        place = self.converted("addrspacecast", self.at(pointer, index), "ptr addrspace(1)").name
        text = f"load {self.real}, ptr addrspace(1) {place}, align 8, !invariant.load !{{}}"
        return self.instruction(self.real, text)

    def power(self, x: Value, exponent: float) -> Value:
        """x^exponent"""
        return power(self, x, exponent)

    def if_any(self, condition: Value, body: Callable[[], object]) -> None:
        """Run the body's code if the condition holds in any lane."""
        with self.when(self.any(condition)):
            body()

    def over_stages(self, count: int, body: Callable[[int, Any], Any], found: Any) -> Any:
        """Return the result of the body on the stages, stage by stage."""
        for i in range(count):
            found = body(i, found)
        return found

    def in_step(self, t: Value, h: Value) -> None:
        """Begin with the stages of a step: samples are interpolated by the time only."""

    def is_first(self, i: int) -> bool:
        """Return whether this is known to be the first stage."""
        return i == 0

    def at_first(self, i: int, first: Any, otherwise: Any) -> Any:
        """Return `first` in the first stage, otherwise the other."""
        return first if i == 0 else otherwise

    def table(self, numbers: Any) -> Any:
        """Return numbers that stages look up."""
        return numbers

    def put_at(self, place: Value, rows: int, index: Value, value: Value, where: Value) -> None:
        """Put a value into the row with each lane's own index, in lanes for which `where` is true. Indices
        beyond the last row are skipped.
        """
        values, indices = self.room(), self.room()
        self.store(value, values)
        self.store(self.where(where & (index < float(rows)), index, -1.0), indices)
        with self.each_lane() as lane:
            row = self.load(indices, lane, "double")
            with self.when(row >= 0.0):
                into = self.converted("fptosi", row, "i64") * self.lanes + lane
                self.store(self.load(values, lane, "double"), self.at(place, into, "double"))

    def may_count(self, weights: Any, j: int) -> bool:
        """Return whether a weight may be other than zero."""
        return bool(weights[j] != 0)

    def each(self, rows: range, body: Callable[[Any], object]) -> None:
        """Call the body for the number of every row."""
        # 12 numbers of a state; more are gone through by loops, whose code is short
        if len(rows) <= 12:
            for i in rows:
                body(i)
        else:
            with self.counted(rows.stop, first=rows.start) as i:
                body(i)

    def _total(self, rows: range, added: Callable[[Value, Any], Value]) -> Value:
        total = self.room()
        self.store(0.0, total)
        self.each(rows, lambda i: self.store(added(self.load(total), i), total))
        return self.load(total)

    def sum_of_squares(self, rows: range, value: Callable[[Any], Value]) -> Value:
        """Return the sum of the squares of the values of all rows."""
        return self._total(rows, lambda total, i: self.fma(x := value(i), x, total))

    def largest(self, rows: range, value: Callable[[Any], Value]) -> Value:
        """Return the largest of the values of all rows, all of them non-negative."""
        return self._total(rows, lambda total, i: self.larger(total, value(i)))


class Lanes:
    """The rows of the lanes side by side, in memory at `pointer`."""

    def __init__(self, w: StepWriter, form: Form, pointer: Number) -> None:
        self.w, self.form, self.pointer, self.rows = w, form, pointer, form.rows

    def __getitem__(self, name: str) -> Number:
        """Return the first row of this name."""
        return self.w.load(self.pointer, self.rows[name].start)

    def __setitem__(self, name: str, value: Number) -> None:
        """Set the first row of this name."""
        self.w.store(value, self.pointer, self.rows[name].start)

    def every(self, name: str) -> list[Number]:
        """Return the vectors of all rows of this name."""
        return [self.w.load(self.pointer, row) for row in self.rows[name]]

    def put(self, name: str, values: Sequence[Number]) -> None:
        """Sets all rows of this name."""
        for row, value in zip(self.rows[name], values, strict=True):
            self.w.store(value, self.pointer, row)

    def place(self, name: str, lane: Number) -> Number:
        """Return where the number of one lane is."""
        return self.w.at(self.pointer, lane + self.rows[name].start * self.w.lanes, "double")

    def of(self, name: str, lane: Number, type: str = "double") -> Number:
        """Return the number of one lane."""
        return self.w.load(self.place(name, lane), type=type)

    def set(self, name: str, lane: Number, value) -> None:
        """Sets the number of one lane."""
        self.w.store(self.w.literal(value, "double"), self.place(name, lane))


def each_row(w: StepWriter, rows: range | int, into: Number, value: Callable[[int | Number], Number | float]) -> None:
    """Set rows of a state in memory, so many of them, or these."""
    w.each(range(rows) if isinstance(rows, int) else rows, lambda i: w.store(value(i), into, i))


def copied(w: StepWriter, rows: int, source: Number, into: Number, where: Number | None = None) -> None:
    """Copy so many rows from another place, in lanes `where` this holds."""
    each_row(w, rows, into, lambda i: w.load(source, i) if where is None else w.where(where, w.load(source, i), w.load(into, i)))


def stated(w: MachineWriter, lanes: Lanes, name: str) -> list[Value]:
    """Return the vectors of all rows of this name, which steps do not change.

    On a GPU, rows that all lanes share are read from the operand.
    """
    rows = lanes.rows[name]
    if not any(w.common[row] for row in rows if w.device):
        return lanes.every(name)
    common = w.load(lanes.pointer, lanes.form.all, "ptr")
    return [
        w.constant(common, sum(w.common[:row])) if w.common[row] else w.load(lanes.pointer, row)
        for row in rows
    ]


def room_of_lanes(w: MachineWriter, form: Form) -> Value:
    """Return memory for all rows. On a GPU, the location of the shared rows comes after them."""
    return w.room(form.all + w.device)


def arguments_of_samples(form: Form) -> int:
    """Return how many arguments of a handler are samples."""
    return 2 if form.sampled else 0


def set_goal(w: MachineWriter, lanes: Lanes, lane: Value, goal: Value) -> None:
    """Set the next time of a lane: the goal, or the next knot if that comes first."""
    if lanes.form.sampled:
        knot = w.load(lanes.of("knot", lane, "ptr"), type="double")
        goal = w.where((knot - goal) * lanes.of("direction", lane) < 0.0, knot, goal)
    lanes.set("goal", lane, goal)
