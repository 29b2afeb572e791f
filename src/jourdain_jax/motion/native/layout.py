"""Where the numbers of a lane are: a lane is a column of rows, one row per number, and a row is one vector for all lanes side by side.

A lane is handed over with all rows of `Layout.given`, its progress at the start among them, and handed back with those of its progress. Where tangents are
pushed along, the state is followed by its own, and so are the numbers that the rates are given; `dt` are those of time, which only an event's has. Of
derivatives of order n in directions e_1 to e_n the tangents are 2^n - 1, in the order of the binary numbers that say which e_i are taken together: of the
second order those along e_1, e_2, and both. `taken` is by how far the last step has gone; of
a step by Taylor series, `before` is the time at which it began, and `bound` how long the next one may be after one that was rejected. `last` are the numbers
whose signs are watched, and by the time `crossing_by` one of them is known to change (`motion/integrators/crossings.py`).

Where inputs are given by samples, rows of pointers and whole numbers say where the samples of a lane are (`table`), how many each input has (`samples`), and
where the next knot is at which a step must end (`knot`). Between samples lie straight lines:

    f(t) = f_k + (t - t_k)/(t_{k+1} - t_k) (f_{k+1} - f_k),   t_k <= t < t_{k+1};   constant before the first sample and after the last
    df/dt = (f_{k+1} - f_k)/(t_{k+1} - t_k)

Tables have the shape (tables, inputs, 2, samples): times since the start, then values, of every input that is given by samples, padded with infinite
times. Knots (`motion/inputs.py`) have the shape (rows, knots). Lanes that share them have one of each: of T tables, lane i of N has number i T / N.
"""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

from jourdain_jax.native.ffi import Given, last_size, product
from jourdain_jax.native.ir import Value, Writer

PROGRESS = ("t", "h", "code", "accepted", "rejected", "event", "pivot", "crossings", "together")
SAMPLES = ("table", "samples", "knot")
CONTROL = ("direction", "last_goal", "rtol", "atol", "shortest", "longest", "max_steps", "origin")


@dataclass(frozen=True)
class Layout:
    """The rows of a lane."""

    coordinates: int
    speeds: int
    with_work: bool
    known: int  # numbers that the rates are given: what depends on parameters alone, then the inputs
    events: int
    moving: tuple[int, ...] = ()  # of every tangent, how many of those known have it
    sampled: int = 0  # how many of the inputs are given by samples
    watched: int = 0  # numbers whose signs are watched

    @property
    def y(self) -> int:
        """Numbers of the integrated state."""
        return self.coordinates + self.speeds + self.with_work

    @property
    def integrated(self) -> int:
        """Numbers of the state and of its tangents."""
        return self.y * (1 + len(self.moving))

    @property
    def ends(self) -> int:
        """Numbers of the state at the end and of its time, and of their tangents."""
        return (self.y + 1) * (1 + len(self.moving))

    @property
    def parts(self) -> list[range]:
        """Rows of the coordinates, of the speeds and of the work, where there are any."""
        ends = [0, self.coordinates, self.coordinates + self.speeds, self.y]
        return [range(a, b) for a, b in pairwise(ends) if b > a]

    @property
    def rows(self) -> dict[str, range]:
        """Name -> rows."""
        search = {"search_t": 3, "search_c": 3 * self.events, "search_step": 1, "search_left": 1, "search_shift": 1, "search_slope": self.events}
        counts = {"y": self.integrated, **dict.fromkeys(PROGRESS, 1), "dt": len(self.moving), **dict.fromkeys(CONTROL, 1)}
        counts |= {"known": self.known, "dknown": sum(self.moving)}
        counts |= {"goal": 1, "taken": 1, "before": 1, "bound": 1, **(search if self.events else {}), **dict.fromkeys(SAMPLES if self.sampled else (), 1)}
        counts |= {"last": self.watched, "crossing_by": 1} if self.watched else {}
        found, first = {}, 0
        for name, count in counts.items():
            found[name] = range(first, first + count)
            first += count
        return found

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


class Lanes:
    """The rows of the lanes side by side, in memory at `pointer`."""

    def __init__(self, w: Writer, layout: Layout, pointer: Value) -> None:
        self.w, self.layout, self.pointer, self.rows = w, layout, pointer, layout.rows

    def __getitem__(self, name: str) -> Value:
        return self.every(name)[0]

    def __setitem__(self, name: str, value: Value) -> None:
        self.put(name, [value])

    def every(self, name: str) -> list[Value]:
        """The vectors of all rows of this name."""
        return [self.w.load(self.pointer, row) for row in self.rows[name]]

    def put(self, name: str, values: list[Value]) -> None:
        """Sets all rows of this name."""
        for row, value in zip(self.rows[name], values, strict=True):
            self.w.store(value, self.pointer, row)

    def place(self, row, lane: Value) -> Value:
        """Where the number of one lane is."""
        return self.w.at(self.pointer, row * self.w.lanes + lane if isinstance(row, Value) else lane + row * self.w.lanes, "double")

    def of(self, name: str, lane: Value, type: str = "double") -> Value:
        """The number of one lane."""
        return self.w.load(self.place(self.rows[name].start, lane), type=type)

    def set(self, name: str, lane: Value, value) -> None:
        """Sets the number of one lane."""
        self.w.store(self.w.literal(value, "double"), self.place(self.rows[name].start, lane))


def for_rows(w: Writer, rows: range, body: Callable[[int | Value], object]) -> None:
    """`body` for the number of every row."""
    # 12 numbers of a state; more are gone through by loops, whose code is short
    if len(rows) <= 12:
        for i in rows:
            body(i)
    else:
        with w.counted(rows.start, rows.stop) as i:
            body(i)


def each_row(w: Writer, rows: range | int, into: Value, value: Callable[[int | Value], Value | float]) -> None:
    """Sets rows of a state in memory, so many of them, or these."""
    for_rows(w, range(rows) if isinstance(rows, int) else rows, lambda i: w.store(value(i), into, i))


def copied(w: Writer, rows: int, source: Value, into: Value, where: Value | None = None) -> None:
    """Sets so many rows to those from another place, in lanes `where` this holds."""
    each_row(w, rows, into, lambda i: w.load(source, i) if where is None else w.where(where, w.load(source, i), w.load(into, i)))


def over_rows(w: Writer, rows: range, start: float, added: Callable[[Value, int | Value], Value]) -> Value:
    """What `added(total, i)` makes of all rows one after the other."""
    total = w.room()
    w.store(start, total)
    for_rows(w, rows, lambda i: w.store(added(w.load(total), i), total))
    return w.load(total)


WORDS_OF_SAMPLES = 6  # of a job: pointers to the tables and the knots, how many there are of each, samples of a table, knots of a row
_TABLES, _KNOTS, _TABLE_COUNT, _KNOT_COUNT, _SAMPLES, _KNOTS_EACH = range(WORDS_OF_SAMPLES)


def arguments_of_samples(layout: Layout) -> int:
    """How many arguments of a handler are samples."""
    return 2 if layout.sampled else 0


def store_samples(w: Writer, words: Value, given: list[Given]) -> None:
    """The words of a job that say where samples are."""
    tables, knots = given
    for word, value in (
        (_TABLES, tables.data),
        (_KNOTS, knots.data),
        (_TABLE_COUNT, product(w, tables, 3)),
        (_KNOT_COUNT, product(w, knots, 1)),
        (_SAMPLES, last_size(w, tables)),
        (_KNOTS_EACH, last_size(w, knots)),
    ):
        w.store(value, words, word)


def begin_samples(w: Writer, layout: Layout, words: Value, count: Value, lanes: Lanes, lane: Value, number: Value) -> None:
    """A place takes the table and the knots of the lane with this number, of so many."""
    size = w.load(words, _SAMPLES, "i64")

    def share(of: int) -> Value:
        return w.binary("sdiv", number * w.load(words, of, "i64"), count)

    table = w.at(w.load(words, _TABLES, "ptr"), share(_TABLE_COUNT) * size * (2 * layout.sampled), "double")
    knot = w.at(w.load(words, _KNOTS, "ptr"), share(_KNOT_COUNT) * w.load(words, _KNOTS_EACH, "i64"), "double")
    for name, value in (("table", table), ("samples", size), ("knot", knot)):
        lanes.set(name, lane, value)


def nearer_knot(w: Writer, lanes: Lanes, lane: Value, goal: Value) -> Value:
    """The next knot or the goal, whichever comes first."""
    knot = w.load(lanes.of("knot", lane, "ptr"), type="double")
    return w.where((knot - goal) * lanes.of("direction", lane) < 0.0, knot, goal)


def pass_knot(w: Writer, lanes: Lanes, lane: Value) -> None:
    """The next knot is behind."""
    lanes.set("knot", lane, w.at(lanes.of("knot", lane, "ptr"), 1, "double"))


def write_sampled_inputs(w: Writer, layout: Layout, with_slopes: bool) -> None:
    """`sampled_inputs(state, t, values)`: the values of all inputs that are given by samples, at the time t since the start, of each lane; then df/dt."""
    with w.procedure("sampled_inputs", "state t:real values") as (state, t, values):
        lanes, times, low, high = Lanes(w, layout, state), w.room(), w.room(type="i64"), w.room(type="i64")
        w.store(t, times)
        with w.counted(0, w.lanes) as lane:
            now, count = w.load(times, lane, "double"), lanes.of("samples", lane, "i64")
            for i in range(layout.sampled):
                ts = w.at(lanes.of("table", lane, "ptr"), count * (2 * i), "double")
                fs = w.at(ts, count, "double")
                w.store(w.literal(0, "i64"), low)
                w.store(count - 1, high)
                with w.repeated() as leave:
                    a, b = w.load(low, type="i64"), w.load(high, type="i64")
                    leave((b - a) <= 1)
                    middle = w.binary("sdiv", a + b, 2)
                    after = w.load(ts, middle, "double") <= now
                    w.store(w.where(after, middle, a), low)
                    w.store(w.where(after, b, middle), high)
                k = w.load(low, type="i64")
                t_k, f_k = w.load(ts, k, "double"), w.load(fs, k, "double")
                span, rise = w.load(ts, k + 1, "double") - t_k, w.load(fs, k + 1, "double") - f_k
                there = (now - t_k) / span
                share = w.smaller(w.larger(there, 0.0), 1.0)
                w.store(f_k + share * rise, w.at(values, i * w.lanes + lane, "double"))
                if with_slopes:
                    w.store(w.where(there.equals(share), rise / span, 0.0), w.at(values, (layout.sampled + i) * w.lanes + lane, "double"))


def looked_up(w: Writer, layout: Layout, state: Value, t: Value, with_slopes: bool) -> list[Value]:
    """The values at the time t since the start of all inputs that are given by samples, then their slopes."""
    if not layout.sampled:
        return []
    count = layout.sampled * (1 + with_slopes)
    values = w.room(count)
    w.run("sampled_inputs", state, t, values)
    return [w.load(values, i) for i in range(count)]
