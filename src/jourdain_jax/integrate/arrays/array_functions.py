"""Rates, projection and events as JAX functions, in place of the scalar program that machine code uses.

The code of a step also computes its derivatives; JAX differentiates only these functions. Tangents are stored
after the values: after the state (`integrate/loop/form.py`), and after the arrays that all steps share.
`pushed` returns the values of a function with all tangents, by nested `jvp`.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from jourdain_jax.integrate import integrands
from jourdain_jax.integrate.arrays.array_writer import ArrayWriter, Pointer, Rows
from jourdain_jax.integrate.event_values import chosen
from jourdain_jax.integrate.inputs import Constant, Inputs, Mode
from jourdain_jax.integrate.loop.form import Form
from jourdain_jax.integrate.loop.lanes import copied, each_row
from jourdain_jax.integrate.vector_fields.field import Integrated


@dataclass(frozen=True)
class ArrayForm(Form):
    """Sizes of the integrated state if there is no scalar program."""

    program: None  # type: ignore[assignment]
    coordinates: int = 0  # type: ignore[assignment]
    speeds: int = 0  # type: ignore[assignment]
    events: int = 0  # type: ignore[assignment]
    turning: int = 0  # type: ignore[assignment]
    squares: range = range(0)  # type: ignore[assignment]
    switched: range = range(0)  # type: ignore[assignment]

    @property
    def monitored(self) -> range:  # type: ignore[override]
        """Return the indices of the quantities monitored at all stages of a step."""
        return range(self.pivots + self.turning + len(self.squares))

    @property
    def known(self) -> dict[str, int]:
        """Return no rows: known values are arrays that all steps share."""
        return {}


def pushed(f: Callable, parts: Sequence[Sequence]) -> list:
    """Return the value of `f` at the first of `parts`, then its tangents along the other parts, in order.
    None in a part means zero.
    """
    if len(parts) == 1:
        return [f(*parts[0])]
    half = len(parts) // 2
    places = [(i, k) for i, part in enumerate(parts[half:]) for k, x in enumerate(part) if x is not None]
    along = [parts[half + i][k] for i, k in places]

    def moved(*arrays):
        new = [list(part) for part in parts[:half]]
        for (i, k), x in zip(places, arrays, strict=True):
            new[i][k] = x
        return pushed(f, new)

    at = [
        jnp.zeros_like(dx) if (x := parts[i][k]) is None else x
        for (i, k), dx in zip(places, along, strict=True)
    ]
    found, tangents = jax.jvp(moved, at, along)
    return found + tangents


@dataclass
class Functions:
    """Functions that a step calls: rates, projection, events and their cotangents, on rows in memory."""

    w: ArrayWriter
    form: Form
    rest: tuple  # arguments of the rates, without their arrays
    shared: tuple[Sequence, ...]  # these arrays, then their tangents
    asked: tuple[int, ...]  # indices of arrays whose cotangents are requested
    method: Any
    middle: Array | None = None  # middle of the step whose stages are computed
    modes: Sequence[Array] = ()

    def __post_init__(self) -> None:
        self.y, self.count = Rows(0, self.form.y), self.form.y

    def take_modes(self, state: Pointer) -> None:
        """Set the modes of all functions to the current modes of the lanes."""
        self.modes = [self.w.load(state, row) for row in self.form.rows["mode"]]

    def in_step(self, t, h) -> None:
        """Evaluate the rates within this step, in which sampled inputs have one slope."""
        self.middle = t + 0.5 * h

    def _args(self, shared: Sequence, middle: Array | None = None) -> PyTree:
        args = joined(self.rest, shared)
        if self.modes:
            field, scene, inputs, *more = args
            left = iter(self.modes)
            channels = (
                Constant(next(left)) if isinstance(channel, Mode) else channel for channel in inputs.channels
            )
            args = field, scene, Inputs(tuple(channels)), *more
        return integrands.within(self.w.number(math.inf) if middle is None else middle, args)

    def _state(self, rows: Float[Array, "y *lanes"]) -> Integrated:
        return Integrated.of(rows, self.form)

    def _rates(self, t, y, *shared) -> Float[Array, "y *lanes"]:
        return integrands.rates(t, self._state(y), self._args(shared, self.middle)).rows

    def _projected(self, t, y, *shared) -> Float[Array, "y *lanes"]:
        return integrands.project(t, self._state(y), self._args(shared)).rows

    def _events(self, t, y, *shared) -> Float[Array, "events *lanes"]:
        return integrands.events(t, self._state(y), self._args(shared))

    def _solved(self, t, h, y, *shared) -> tuple:
        """Return the state after an implicit step, its error estimate, and whether the step was solved."""
        before = self._state(y)
        found = self.method.solve(self._args(shared, self.middle), t, before, h)
        return jax.tree.map(jnp.add, before, found.change), found.error, found.solved

    def _parts(self, state: Pointer, t, y: Pointer) -> list[list]:
        """Return lists of time, state and shared arrays: the values, then the tangents of each direction."""
        times = [
            t,
            *(self.w.load(state, row) if self.form.time_moves else None for row in self.form.rows["dt"]),
        ]
        of = [range(len(self.shared[0])), *self.form.moving]
        shared = [dict(zip(which, part, strict=True)) for which, part in zip(of, self.shared, strict=True)]
        return [
            [time, self.w.load(y, self.y + k * self.count), *map(part.get, of[0])]
            for k, (time, part) in enumerate(zip(times, shared, strict=True))
        ]

    def _store(self, found: Sequence, place: Pointer, rows: int) -> None:
        for k, x in enumerate(found):
            self.w.store(x, place, Rows(k * rows, rows))

    # counterparts of `integrate/loop/rate_functions.py` and `projection.py`

    def rates(self, state: Pointer, t, y: Pointer, k: Pointer, monitored: Pointer) -> None:
        """Store the rates of the state and the monitored quantities."""
        watching = Rows(0, len(self.form.monitored))

        def watched(t, y, *shared):
            found, pivots, directions, sine = integrands.rates_and_pivots(
                t, self._state(y), self._args(shared, self.middle)
            )
            seen = [jnp.reshape(x, (-1, *self.w.lanes)) for x in (pivots, directions)]
            seen += [jnp.stack([sine**2, jnp.ones_like(sine)])] if self.form.squares else []
            return found.rows, jax.lax.stop_gradient(jnp.concatenate(seen))

        found = pushed(watched if watching.many else self._rates, self._parts(state, t, y))
        if watching.many:
            self.w.store(found[0][1][: watching.many], monitored, watching)
            found = [slopes for slopes, _ in found]
        self._store(found, k, self.count)

    def project(self, state: Pointer, t, y: Pointer) -> None:
        """Project a state onto the constraints."""
        self._store(pushed(self._projected, self._parts(state, t, y)), y, self.count)

    def along(self, state: Pointer, t, y: Pointer) -> None:
        """Project an error onto the directions that the constraints allow. Its rows follow the state's."""
        at, error = self.w.load(y, self.y), self.w.load(y, self.y + self.count)
        self.w.store(
            jax.jvp(lambda y: self._projected(t, y, *self.shared[0]), (at,), (error,))[1],
            y,
            self.y + self.count,
        )

    def events(self, state: Pointer, t, y: Pointer, slope: Pointer, c: Pointer, rate: Pointer) -> None:
        """Store the values of events, and their rates if the state changes at the rate `slope`."""
        at, along = (t, self.w.load(y, self.y)), (jnp.ones_like(t), self.w.load(slope, self.y))
        for place, found in zip(
            (c, rate), jax.jvp(lambda t, y: self._events(t, y, *self.shared[0]), at, along), strict=True
        ):
            self._store([found], place, self.form.events)

    def event_tangents(self, state: Pointer, t, y: Pointer, dc: Pointer) -> None:
        """Store the tangents of the values of events."""
        self._store(pushed(self._events, self._parts(state, t, y))[1:], dc, self.form.events)

    # events after which the motion continues (`integrate/loop/transitions.py`)

    def _reset(self, event, t, y, *shared) -> Float[Array, "rows *lanes"]:
        """Return the state and the modes after an event."""
        found = integrands.resets(t, self._state(y), self._args(shared))
        after = chosen(self.w, event, list(found))
        state, modes, rise = jnp.split(after, (self.form.q_and_v, len(after) - 1))
        return jnp.concatenate([state, y[self.form.q_and_v :] - rise, modes])

    def _reset_at(
        self, event, t, parts: Sequence[Sequence], fixed: dict, modes: Sequence[Array]
    ) -> tuple[list, list]:
        """Return the state after an event and the time of the event, with their tangents.

        `parts`: the state and the varying arrays, with tangents; `fixed`: the other arrays, by index;
        `modes`: modes after the event.
        """
        given = lambda at: (
            dict(zip((k for k in range(len(fixed) + len(at)) if k not in fixed), at, strict=True)) | fixed
        )
        whole = lambda at: [given(at)[k] for k in range(len(fixed) + len(at))]
        if len(parts) == 1:
            return [self._reset(event, t, *whole(parts[0]))[: self.count]], [t]
        before, along = parts[: len(parts) // 2], parts[len(parts) // 2 :]

        def rates(states: Sequence[Array]) -> list[Array]:
            def f(*at):
                return self._rates(t, *whole(at))

            return pushed(f, [[y, *part[1:]] for y, part in zip(states, before, strict=True)])

        value = lambda t, *at: chosen(self.w, event, list(self._events(t, *whole(at))))
        now = rates([part[0] for part in before])
        dc = jax.jvp(partial(value, t), before[0], along[0])[1]
        zero = [jnp.zeros_like(x) for x in before[0][1:]]
        c_dot = jax.jvp(value, (t, *before[0]), (jnp.ones_like(t), now[0], *zero))[1]
        dt = -dc / c_dot
        moved = [[part[0] + rate * dt, *part[1:]] for part, rate in zip(along, now, strict=True)]
        (after, times), (d_after, d_times) = jax.jvp(
            lambda t, parts: self._reset_at(event, t, parts, fixed, modes), (t, before), (dt, moved)
        )
        own, self.modes = self.modes, modes
        later = rates(after)
        self.modes = own
        return after + [dy - rate * dt for dy, rate in zip(d_after, later, strict=True)], times + d_times

    def reset(self, state: Pointer, t, y: Pointer, event, after: Pointer) -> None:
        """Store the state after an event, the new modes, and the time of the event, with tangents."""
        of, parts = self.form.rows_of_transition, [part[1:] for part in self._parts(state, t, y)]
        modes = self._reset(event, t, *parts[0])[self.count :]
        moves = {0} | {k for part in parts[1:] for k, x in enumerate(part) if x is not None}
        fixed = {k: x for k, x in enumerate(parts[0]) if k not in moves}
        varying = [
            [jnp.zeros_like(parts[0][k]) if part[k] is None else part[k] for k in sorted(moves)]
            for part in parts
        ]
        states, times = self._reset_at(event, t, varying, fixed, list(modes))
        self._store(states, after, self.count)
        self.w.store(modes, after, Rows(of["mode"].start, len(modes)))
        if self.form.transitions:
            energy = integrands.energy(t, self._state(parts[0][0]), self._args(parts[0][1:]))
            own, self.modes = self.modes, list(modes)
            lost = energy - integrands.energy(t, self._state(states[0]), self._args(parts[0][1:]))
            self.modes = own
            self.w.store(lost, after, of["lost"].start)
        self._store([x[None] for x in times], self.w.at(after, of["t"].start), 1)

    def pull_reset(
        self, state: Pointer, t, y: Pointer, event, g: Pointer, to_y: Pointer, to_known: Pointer
    ) -> None:
        """Pull cotangents back from the state after an event to the state before it. In `to_known`, the
        cotangents of the arrays come first, then the cotangent of the event's time.
        """
        known = sum(self.sizes())
        of_state = lambda y, *shared: self._reset(event, t, y, *shared)[: self.count]
        self._pull(of_state, y, g, self.count, to_y, to_known)
        at, g_y = self.w.load(y, self.y), self.w.load(g, self.y)
        by_time = jax.vjp(lambda t: self._reset(event, t, at, *self.shared[0])[: self.count], t)[1](g_y)[0]
        self.w.store(self.w.load(to_known, known) + by_time + self.w.load(g, self.count), to_known, known)

    # implicit methods

    def solve(self, state: Pointer, t, h, y1: Pointer, error: Pointer, told: Pointer) -> None:
        """Take an implicit step. Store the state after it, its error estimate (zero if the method has none),
        and whether its equations were solved.
        """

        def f(t, y, *shared):
            after, estimate, solved = self._solved(t, h, y, *shared)
            return after.rows, jax.lax.stop_gradient(
                (jnp.zeros_like(after.rows) if estimate is None else estimate.rows, solved)
            )

        found = pushed(f, self._parts(state, t, state))
        self._store([after for after, _ in found], y1, self.count)
        (_, (estimate, solved)), *_ = found
        self.w.store(estimate, error, self.y)
        self.w.store(solved, told)

    def onto_rows(self, state: Pointer, t, y: Pointer, told: Pointer) -> None:
        """Project a state onto its constraints. Store the size of the change, relative to the change by the
        step, in `told[1]`.
        """
        free = self.w.load(y, self.y)
        self.project(state, t, y)
        rows = jax.lax.stop_gradient((self.w.load(state, self.y), free, self.w.load(y, self.y)))
        ratios = []
        for before, given, after in zip(*(jax.tree.leaves(self._state(x)) for x in rows), strict=True):
            # at least 1e-6 of the size of the state
            change = jnp.max(jnp.abs(after - before), initial=0.0) + 1e-6 * (
                1 + jnp.max(jnp.abs(after), initial=0.0)
            )
            ratios.append(jnp.max(jnp.abs(after - given), initial=0.0) / change)
        self.w.store(jnp.max(jnp.stack(ratios)), told, 1)

    # cotangents (of motions without tangents)

    def _pull(self, f: Callable, y: Pointer, g: Pointer, rows: int, to_y: Pointer, to_known: Pointer) -> None:
        """Pull the cotangents `g` back through `f`: store the cotangent of the state in `to_y`, and add those
        of the requested arrays to `to_known`.
        """

        def of(y, asked):
            return f(
                y, *(dict(enumerate(self.shared[0])) | dict(zip(self.asked, asked, strict=True))).values()
            )

        by_y, by_shared = jax.vjp(of, self.w.load(y, self.y), self._asked())[1](self.w.load(g, Rows(0, rows)))
        self.w.store(by_y, to_y, self.y)
        if known := sum(self.sizes()):
            lanes = len(self.w.lanes)
            flat = [
                jnp.reshape(jnp.moveaxis(x, range(lanes), range(-lanes, 0)), (-1, *self.w.lanes))
                for x in by_shared
            ]
            self.w.store(
                self.w.load(to_known, Rows(0, known)) + jnp.concatenate(flat), to_known, Rows(0, known)
            )

    def _asked(self) -> list[Array]:
        return [self.shared[0][i] for i in self.asked]

    def sizes(self) -> list[int]:
        """Return the number of values per sample in each array whose cotangent is requested."""
        return [math.prod(x.shape[len(self.w.lanes) :]) for x in self._asked()]

    def leaves(self, by_known: Array) -> list[Array]:
        """Return the cotangents of the requested arrays, with the batch axis first."""
        lanes = len(self.w.lanes)
        parts = jnp.split(by_known, [sum(self.sizes()[: k + 1]) for k in range(len(self.asked))])
        return [
            jnp.reshape(jnp.moveaxis(part, range(-lanes, 0), range(lanes)), x.shape)
            for part, x in zip(parts, self._asked(), strict=False)
        ]

    def pull_rates(self, state: Pointer, t, y: Pointer, g: Pointer, to_y: Pointer, to_known: Pointer) -> None:
        """Pull cotangents back through the rates."""
        self._pull(partial(self._rates, t), y, g, self.count, to_y, to_known)

    def project_back(self, state: Pointer, t, free: Pointer, g: Pointer, added: Pointer) -> None:
        """Pull cotangents back through a projection."""
        self._pull(partial(self._projected, t), free, g, self.count, g, added)

    def pull_events(
        self, state: Pointer, t, y: Pointer, g: Pointer, to_y: Pointer, to_known: Pointer
    ) -> None:
        """Pull cotangents back through the values of events."""
        self._pull(partial(self._events, t), y, g, self.form.events, to_y, to_known)

    def pull_step(self, state: Pointer, t, h, y: Pointer, g: Pointer, added: Pointer) -> None:
        """Pull cotangents back through an implicit step and its projection, in lanes that took the step."""

        def f(y, *shared):
            end = self._solved(t, h, y, *shared)[0].rows
            return self._projected(t + h, end, *shared) if self.form.projects else end

        took, known = h != 0.0, sum(self.sizes())
        before, more = self.w.room(self.count), self.w.room(max(known, 1))
        self._pull(f, y, g, self.count, before, more)
        copied(self.w, self.count, before, g, took)
        each_row(
            self.w,
            known,
            added,
            lambda i: self.w.load(added, i) + self.w.where(took, self.w.load(more, i), 0.0),
        )


def split(args: PyTree) -> tuple[tuple, tuple]:
    """Return the arrays of a tree, and the tree with None in their place."""
    leaves, treedef = jax.tree.flatten(args)
    return tuple(filter(eqx.is_array, leaves)), (treedef, [None if eqx.is_array(x) else x for x in leaves])


def joined(rest: tuple, arrays: Sequence) -> PyTree:
    """Return the tree from the parts made by `split`."""
    (treedef, leaves), left = rest, iter(arrays)
    return treedef.unflatten([next(left) if x is None else x for x in leaves])
