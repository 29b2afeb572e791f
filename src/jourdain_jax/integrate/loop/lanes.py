"""Lanes in memory, the writer that translates the code of a step to machine code on lanes, and the arrays
that a call of this code takes.

One sample of a batch is integrated in each lane; `form.py` describes the memory layout.
"""

from collections.abc import Callable, Sequence
from itertools import groupby
from typing import Any, NamedTuple

import numpy as np
from jax import lax
from jaxtyping import Array

from jourdain_jax.integrate.loop.form import Form
from jourdain_jax.kernels.ir import Value, Writer
from jourdain_jax.kernels.math_functions import power

Number = Any  # a machine-code value, an array, or a pointer to memory of either
StepWriter = Any  # `MachineWriter`, or `ArrayWriter` for JAX arrays


class MachineWriter(Writer):
    """Writer that translates the code of a step to machine code.

    Besides arithmetic and memory access, the code of a step uses operations that each writer implements in
    its own way:

        if_any(c, body)            run the body if c holds in any lane; the body selects lanes by `where`
        seldom(c, body)            the same, for a body that changes only lanes in which c holds
        over_stages(n, body, x)    x <- body(i, x) for all stages i
        each(rows, body)           run the body for each row, independently
    """

    def constant(self, pointer: Value, index: int) -> Value:
        """Load a number that all threads of a GPU share, from memory that is constant during the kernel."""
        place = self.converted("addrspacecast", self.at(pointer, index), "ptr addrspace(1)").name
        text = f"load {self.real}, ptr addrspace(1) {place}, align 8, !invariant.load !{{}}"
        return self.instruction(self.real, text)

    def power(self, x: Value, exponent: float) -> Value:
        """Return `x^exponent`."""
        return power(self, x, exponent)

    def if_any(self, condition: Value, body: Callable[[], object]) -> None:
        """Run the body if the condition holds in any lane."""
        with self.when(self.any(condition)):
            body()

    seldom = if_any

    def over_stages(self, count: int, body: Callable[[int, Any], Any], found: Any) -> Any:
        """Apply the body to all stages in order, and return its last result."""
        for i in range(count):
            found = body(i, found)
        return found

    def in_step(self, t: Value, h: Value) -> None:
        """Begin the stages of a step. Machine code does nothing here, because samples depend only on time."""

    def is_first(self, i: int) -> bool:
        """Return whether this is known to be the first stage."""
        return i == 0

    def at_first(self, i: int, first: Any, otherwise: Any) -> Any:
        """Return `first` in the first stage and `otherwise` in all others."""
        return first if i == 0 else otherwise

    def table(self, numbers: Any) -> Any:
        """Return numbers as a table that stages can index."""
        return numbers

    def put_at(self, place: Value, rows: int, index: Value, value: Value, where: Value) -> None:
        """Store a value in the row `index`, which may differ between lanes, in the lanes selected by `where`.
        An index beyond the last row has no effect.
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
        """Return whether a weight may be nonzero."""
        return bool(weights[j] != 0)

    def each(self, rows: range, body: Callable[[Any], object]) -> None:
        """Call the body with the index of every row."""
        # for more than 12 rows use a loop, whose code is shorter
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
        """Return the sum of squares of the values of all rows."""
        return self._total(rows, lambda total, i: self.fma(x := value(i), x, total))

    def largest(self, rows: range, value: Callable[[Any], Value]) -> Value:
        """Return the largest of the values of all rows, which are non-negative."""
        return self._total(rows, lambda total, i: self.larger(total, value(i)))


class Lanes:
    """Rows of all lanes, at `pointer` in memory."""

    def __init__(self, w: StepWriter, form: Form, pointer: Number) -> None:
        self.w, self.form, self.pointer, self.rows = w, form, pointer, form.rows

    def __getitem__(self, name: str) -> Number:
        """Return the first row with this name."""
        return self.w.load(self.pointer, self.rows[name].start)

    def __setitem__(self, name: str, value: Number) -> None:
        """Set the first row with this name."""
        self.w.store(value, self.pointer, self.rows[name].start)

    def every(self, name: str) -> list[Number]:
        """Return the vectors of all rows with this name."""
        return [self.w.load(self.pointer, row) for row in self.rows[name]]

    def put(self, name: str, values: Sequence[Number]) -> None:
        """Set all rows with this name."""
        for row, value in zip(self.rows[name], values, strict=True):
            self.w.store(value, self.pointer, row)

    def place(self, name: str, lane: Number) -> Number:
        """Return a pointer to the value of one lane in the first row with this name."""
        return self.w.at(self.pointer, lane + self.rows[name].start * self.w.lanes, "double")

    def of(self, name: str, lane: Number, type: str = "double") -> Number:
        """Return the value of one lane in the first row with this name."""
        return self.w.load(self.place(name, lane), type=type)

    def set(self, name: str, lane: Number, value) -> None:
        """Set the value of one lane in the first row with this name."""
        self.w.store(self.w.literal(value, "double"), self.place(name, lane))


def each_row(
    w: StepWriter, rows: range | int, into: Number, value: Callable[[int | Number], Number | float]
) -> None:
    """Store `value(i)` in each row i of `into`. `rows`: the rows, or the number of first rows."""
    w.each(range(rows) if isinstance(rows, int) else rows, lambda i: w.store(value(i), into, i))


def copied(w: StepWriter, rows: int, source: Number, into: Number, where: Number | None = None) -> None:
    """Copy the first `rows` rows of `source` to `into`, in the lanes selected by `where` (None: all)."""
    each_row(
        w,
        rows,
        into,
        lambda i: w.load(source, i) if where is None else w.where(where, w.load(source, i), w.load(into, i)),
    )


def stated(w: MachineWriter, lanes: Lanes, name: str) -> list[Value]:
    """Return the vectors of all rows with this name, which steps do not change.

    On a GPU, rows that all lanes share are read from the operand of the kernel.
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
    """Return memory for all rows, on a GPU followed by a pointer to the shared rows."""
    return w.room(form.all + w.device)


def arguments_of_samples(form: Form) -> int:
    """Return the number of arguments of a kernel that belong to sampled inputs."""
    return 2 if form.sampled else 0


def set_goal(w: MachineWriter, lanes: Lanes, lane: Value, goal: Value) -> None:
    """Set the next time of a lane: the goal, or the next knot if the knot comes first."""
    if lanes.form.sampled:
        knot = w.load(lanes.of("knot", lane, "ptr"), type="double")
        goal = w.where((knot - goal) * lanes.of("direction", lane) < 0.0, knot, goal)
    lanes.set("goal", lane, goal)


class Operands(NamedTuple):
    """Operands of one call, some of them with batch axes, and the arrays that the kernel takes.

    The rows of a start are vectors and numbers. On a CPU they become one array with a batch axis. On a GPU,
    the rows that all lanes share form a separate array without batch axis. Saved times also have no batch
    axis if lanes share them.
    """

    batch: tuple[int, ...]  # batch sizes, one for each `vmap`
    ranks: tuple[int, ...]  # ranks of the operands without batch axes
    samples: int  # number of leading operands that are samples
    others: int  # number of trailing operands that are separate arrays; those in between are rows of a start
    # rows of a start that are not operands: index of the first row, and values
    constant: tuple[tuple[int, tuple[float, ...]], ...]
    counted: bool  # whether the last operand is the number of trial steps, which a CPU does not take

    def _laned(self, x: Array, rank: int) -> Array:
        """Return an operand with all batch axes."""
        shape = (*self.batch, *x.shape[x.ndim - rank :])
        return lax.broadcast_in_dim(x, shape, range(len(shape) - x.ndim, len(shape)))

    def _rows(self, values: Sequence) -> list[tuple[Any, int, bool]]:
        """Return each vector, number or constant of a start, with its rank and whether all lanes share it."""
        constant, row, found = dict(self.constant), 0, list[tuple[Any, int, bool]]()
        operands = [*range(self.samples, len(values) - self.others)]
        while operands or row in constant:
            if row in constant:
                found.append((np.array(constant[row]), 1, True))
                row += len(constant[row])
            else:
                x, rank = values[k := operands.pop(0)], self.ranks[k]
                if count := x.shape[-1] if rank else 1:
                    found.append((x, rank, x.ndim == rank))
                row += count
        return found

    def shared(self, values: Sequence) -> tuple[bool, ...]:
        """Return for each row of a start whether all lanes share it."""
        rows = self._rows(values)
        return tuple(is_shared for x, rank, is_shared in rows for _ in range(x.shape[-1] if rank else 1))

    def _joined(self, rows: list, dtype, laned: bool) -> Array:
        """Join rows to one array; `laned`: with all batch axes. Neighbours with equal batch axes are joined
        first; then the missing axes are added.
        """
        found = []
        for _, some in groupby(rows, lambda row: np.shape(row[0])[: np.ndim(row[0]) - row[1]]):
            each = []
            for x, rank, _ in some:
                x = lax.convert_element_type(x, dtype)
                each.append(
                    lax.transpose(x, (x.ndim - 1, *range(x.ndim - 1))) if rank else lax.expand_dims(x, (0,))
                )
            # XLA compiles a concatenation of numbers faster with the batch axis last (`markers.entries_of`)
            part = lax.concatenate(each, 0)
            part = lax.transpose(part, (*range(1, part.ndim), 0))
            found.append(self._laned(part, 1) if laned else part)
        found = found or [np.zeros(1, dtype)]  # nothing reads the number of an array without rows
        return lax.concatenate(found, found[0].ndim - 1)

    def side_by_side(self, *values: Array) -> list[Array]:
        """Return the arrays for a CPU. The batch axis is first; samples that lanes share have none."""
        rows, last, end = self._rows(values), len(values) - self.others, len(values) - self.counted
        start = self._joined(rows, values[-1].dtype, True)
        return [*values[: self.samples], start, *map(self._laned, values[last:end], self.ranks[last:end])]

    def given_once(self, *values: Array) -> list[Array]:
        """Return the arrays for a GPU. The shared rows of a start form an array of their own, without batch
        axis, after that of the other rows. If all lanes share the times, these have no batch axis either. The
        number of trial steps is the largest of the batch.
        """
        rows, last, end = self._rows(values), len(values) - self.others, len(values) - self.counted
        starts = [
            self._joined([x for x in rows if x[2] is shared], values[-1].dtype, not shared)
            for shared in (False, True)
        ]
        others = [*map(self._laned, values[last:end], self.ranks[last:end])]
        if others and values[end - 1].ndim == self.ranks[end - 1]:
            others[-1] = values[end - 1]
        tries = [lax.reduce_max(lax.expand_dims(x, (0,)), range(1, x.ndim + 1)) for x in values[end:]]
        return [*values[: self.samples], *starts, *others, *tries]
