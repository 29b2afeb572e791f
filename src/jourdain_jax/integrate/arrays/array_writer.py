"""Writer that evaluates the code of a step (`integrate/loop/step.py`) on JAX arrays.

The batch axis is last. Stages run in a loop, so that the rates are compiled once. A branch is a `lax.cond`.
Each branch or loop is first traced to find the memory that it changes.
"""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import count
from typing import Any, NamedTuple

import equinox.internal as eqxi
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array


class Rows(NamedTuple):
    """Range of rows, used in place of the index of a single row."""

    first: Any
    many: int

    def __add__(self, by) -> "Rows":
        """Return the range shifted by `by` rows."""
        return Rows(self.first + by, self.many)


@dataclass(eq=False)
class Room:
    """Memory whose rows are arrays, or pairs of an array of several rows and an index."""

    rows: list
    number: int  # serial number


class Pointer(NamedTuple):
    """Pointer to a row of a `Room`."""

    room: Room
    first: Any


class ArrayWriter:
    """Writer for JAX arrays. `functions`: object whose methods `run` calls."""

    real, truth = "real", "truth"
    where, magnitude, larger, smaller, root = map(
        staticmethod, (jnp.where, jnp.abs, jnp.maximum, jnp.minimum, jnp.sqrt)
    )
    equal, differs, is_nan, power = map(staticmethod, (jnp.equal, jnp.not_equal, jnp.isnan, jnp.power))

    def __init__(self, like: Array, functions: Any = None) -> None:
        self.functions, self._numbers = functions, count()
        self.lanes, self.dtype, self.eps = like.shape, like.dtype, float(jnp.finfo(like.dtype).eps)
        self._stored: dict[Room, list] = {}  # rooms stored to, with their previous rows

    def number(self, value: float) -> Array:
        """Return a number for all lanes."""
        return jnp.full(self.lanes, value, self.dtype)

    def literal(self, value: Any, type: str) -> Any:
        """Return a number or a boolean."""
        return bool(value) if type == self.truth else value

    def fma(self, a, b, c):
        """Return a b + c."""
        return a * b + c

    def run(self, function: str, *arguments) -> None:
        """Call the function with this name, in the current modes of the lanes."""
        self.functions.take_modes(arguments[0])
        getattr(self.functions, function)(*arguments)

    # memory

    def _holding(self, rows: list) -> Pointer:
        return Pointer(Room(rows, next(self._numbers)), 0)

    def room(self, rows: int = 1) -> Pointer:
        """Return memory for `rows` rows, initially zero."""
        return self._holding([jnp.zeros(self.lanes, self.dtype)] * rows)

    def holding(self, *parts: Array) -> Pointer:
        """Return memory that contains the rows of the given arrays."""
        return self._holding([(part, i) for part in parts for i in range(len(part))])

    def at(self, pointer: Pointer, index) -> Pointer:
        """Return a pointer to the row with this index."""
        return Pointer(pointer.room, pointer.first + index)

    def _place(self, pointer: Pointer, index) -> tuple[Any, int]:
        """Return the first row and the number of rows."""
        if isinstance(index, Rows):
            return pointer.first + index.first, index.many
        return pointer.first + index, 1

    def load(self, pointer: Pointer, index=0) -> Array:
        """Return a row, or a range of rows as one array."""
        first, count = self._place(pointer, index)
        if isinstance(first, jax.Array):
            found = jax.lax.dynamic_slice_in_dim(self.whole(pointer.room), first, count)
            return found if isinstance(index, Rows) else found[0]
        rows = pointer.room.rows
        return self._of(rows[first : first + count]) if isinstance(index, Rows) else self._row(rows[first])

    def store(self, value, pointer: Pointer, index=0) -> None:
        """Store one or several rows in memory."""
        (first, rows), room = self._place(pointer, index), pointer.room
        value = jnp.broadcast_to(jnp.asarray(value, self.dtype), (rows, *self.lanes))
        self._stored.setdefault(room, list(room.rows))
        if isinstance(first, jax.Array):
            value, first = jax.lax.dynamic_update_slice_in_dim(self.whole(room), value, first, 0), 0
        room.rows[first : first + len(value)] = [(value, i) for i in range(len(value))]

    def _row(self, row) -> Array:
        return row[0][row[1]] if isinstance(row, tuple) else row

    def _of(self, rows: list) -> Array:
        """Return rows as one array, concatenated from slices that are as long as possible."""
        parts: list[tuple[Array, int, int]] = []
        for row in rows:
            array, i = row if isinstance(row, tuple) else (row[None], 0)
            if parts and parts[-1][0] is array and parts[-1][2] == i:
                parts[-1] = (array, parts[-1][1], i + 1)
            else:
                parts.append((array, i, i + 1))
        found = [array if b - a == len(array) else array[a:b] for array, a, b in parts]
        return found[0] if len(found) == 1 else jnp.concatenate(found)

    def whole(self, room: Room) -> Array:
        """Return all rows of a room."""
        return self._of(room.rows)

    # branches and loops

    def _traced(self, body: Callable) -> tuple[list[Room], Any]:
        """Return the rooms to which the function `body` writes, and the shapes of its results. Their contents
        stay unchanged.
        """
        outer, self._stored = self._stored, {}
        newest, shapes = next(self._numbers), jax.eval_shape(body)
        stored, self._stored = self._stored, outer
        for room, rows in stored.items():
            room.rows = rows
        return [room for room in stored if room.number < newest], shapes

    def _within(self, rooms: list[Room], arrays: list[Array], body: Callable) -> tuple[list[Array], Any]:
        """Run the body with `arrays` as contents of the rooms. Return the new contents, and the result."""
        for room, array in zip(rooms, arrays, strict=True):
            self._stored.setdefault(room, list(room.rows))
            room.rows = [(array, i) for i in range(len(array))]
        found = body()
        return [self.whole(room) for room in rooms], found

    def if_any(self, condition: Array | bool, body: Callable[[], object]) -> None:
        """Run the body if the condition holds in any lane."""
        rooms, _ = self._traced(lambda: body() and None)
        arrays = [self.whole(room) for room in rooms]
        yes = eqxi.unvmap_any(jnp.any(condition))
        found = jax.lax.cond(
            yes, lambda arrays: self._within(rooms, arrays, body)[0], lambda arrays: arrays, arrays
        )
        self._within(rooms, found, lambda: None)

    def seldom(self, condition: Array | bool, body: Callable[[], object]) -> None:
        """Run the body, which changes only lanes in which the condition holds. Under XLA a branch would cost
        more than a short body.
        """
        body()

    def over_stages(self, stages: int, body: Callable[[Any, Any], Any], found: Any) -> Any:
        """Apply the body to all stages in order, and return its last result."""
        rooms, shapes = self._traced(lambda: body(jnp.zeros((), jnp.int32), found))
        found = jax.tree.map(
            lambda x, like: jnp.broadcast_to(jnp.asarray(x, like.dtype), like.shape), found, shapes
        )
        begin = [self.whole(room) for room in rooms], found
        arrays, found = jax.lax.fori_loop(
            0, stages, lambda i, carry: self._within(rooms, carry[0], lambda: body(i, carry[1])), begin
        )
        self._within(rooms, arrays, lambda: None)
        return found

    def each(self, rows: range, body: Callable[[Rows], object]) -> None:
        """Call the body for all rows at once."""
        if rows:
            body(Rows(rows.start, len(rows)))

    def in_step(self, t: Array, h: Array) -> None:
        """Begin the stages of a step."""
        self.functions.in_step(t, h)

    # operations on stages and rows

    def is_first(self, i) -> bool:
        """Return whether this is known to be the first stage."""
        return False

    def intrinsic(self, name: str, a: Array) -> Array:
        """Apply the JAX counterpart of an LLVM function."""
        return getattr(jnp, name)(a)

    def at_first(self, i, first, otherwise):
        """Return `first` in the first stage and `otherwise` in all others."""
        return jnp.where(i == 0, first, otherwise)

    def table(self, numbers) -> Array:
        """Return numbers as an array that stages can index. Integers stay integers."""
        found = np.asarray(numbers)
        return jnp.asarray(found, self.dtype if found.dtype.kind == "f" else jnp.int32)

    def put_at(self, place: Pointer, rows: int, index: Array, value: Array, where: Array) -> None:
        """Store a value in the row `index`, which may differ between lanes, in the lanes selected by `where`.
        An index beyond the last row has no effect.
        """
        every = Rows(0, rows)
        here = jnp.reshape(jnp.arange(rows), (-1, *[1] * len(self.lanes))) == index
        self.store(jnp.where(here & where, value, self.load(place, every)), place, every)

    def may_count(self, weights, j: int) -> bool:
        """Return whether a weight may be nonzero."""
        return isinstance(weights, jax.Array) or bool(weights[j] != 0)

    def sum_of_squares(self, rows: range, value: Callable[[Rows], Array]) -> Array:
        """Return the sum of squares of the values of all rows."""
        return jnp.sum(value(Rows(rows.start, len(rows))) ** 2, axis=0)

    def largest(self, rows: range, value: Callable[[Rows], Array]) -> Array:
        """Return the largest of the values of all rows, which are non-negative."""
        return jnp.max(value(Rows(rows.start, len(rows))), axis=0, initial=0.0)
