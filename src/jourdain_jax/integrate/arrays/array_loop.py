"""The loop over steps in JAX: the code of a step (`integrate/loop/step.py`), with JAX functions.

The batch axis is last. In each pass of the loop all samples try a step, each towards its own next time; a
sample that has ended does not change. Tangents are integrated together with the state, and JAX differentiates
only the rates:

    (y, dy)' = (f(y, p), df/dy dy + df/dp dp)

For higher derivatives, tangents of these values are added (`integrate/loop/form.py`).

Reverse mode uses the same code as machine code (`integrate/loop/adjoint.py`). The motion is integrated once
more, and its trial steps are recorded in a window of limited length. At the end, the window contains the last
steps. The steps of each earlier window are computed again, with equal bits, from the nearest checkpoint,
which is a state stored at the beginning of a window. The number of checkpoints is also limited; at the limit,
every second checkpoint is dropped.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import equinox.internal as eqxi
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PyTree

from jourdain_jax.calculus.reals import Count, PerLane
from jourdain_jax.integrate.arrays.array_functions import Functions
from jourdain_jax.integrate.arrays.array_writer import ArrayWriter, Pointer, Rows
from jourdain_jax.integrate.arrays.implicit_stages import tried_by_equations
from jourdain_jax.integrate.event_search import LOCATING, MOST_STEPS, RUNNING
from jourdain_jax.integrate.explicit_steps import Method, code_at_end
from jourdain_jax.integrate.implicit_steps import ImplicitMethod
from jourdain_jax.integrate.loop.adjoint import step_back
from jourdain_jax.integrate.loop.event_adjoint import event_back, is_located
from jourdain_jax.integrate.loop.form import CONTROL, Form
from jourdain_jax.integrate.loop.lanes import Lanes
from jourdain_jax.integrate.loop.loop_function import Found, Start, constant_rows
from jourdain_jax.integrate.loop.record import Slot
from jourdain_jax.integrate.loop.step import IDLE, step, tried_by_stages
from jourdain_jax.integrate.loop.transitions import is_noted, reset_back


class Going(NamedTuple):
    """Motion during integration."""

    y: Float[Array, "y *lanes"]  # with its tangents
    rows: dict[int, PerLane]  # other rows that steps change
    log: list[Float[Array, "transitions *lanes"]]
    passed: Int[Array, "*lanes"]  # number of saved times


class Loop(NamedTuple):
    """Loop over the steps of a motion, without arrays, which are in the `Start`."""

    form: Form
    method: Method | ImplicitMethod
    rest: tuple  # arguments of the rates, without their arrays
    most: int  # maximum number of steps

    def begun(self, start: Start) -> tuple[Going, dict[int, Array]]:
        """Return the motion at its start, and the rows that steps do not change."""
        t, form = start.goals[0], self.form
        given = {first + i: x for first, run in constant_rows(form).items() for i, x in enumerate(run)}
        later = [row for row in range(form.integrated, form.rows["mode"].stop) if row not in given]
        given |= dict(zip(later, start._replace(known=((),)).numbers(), strict=True))
        given = {row: jnp.broadcast_to(jnp.asarray(x, t.dtype), t.shape) for row, x in given.items()}
        fixed = {row: given[row] for name in CONTROL for row in form.rows[name]}
        last = start.goals[-1]
        fixed |= {self._row("last_goal"): last, self._row("direction"): jnp.sign(last)}
        logged = {row for block in self.log for row in block}
        moving = {
            row: given.get(row, jnp.zeros_like(t))
            for row in range(form.integrated, form.all)
            if row not in fixed and row not in logged
        }
        log = [jnp.zeros((len(block), *t.shape), t.dtype) for block in self.log]
        return Going(jnp.concatenate(start.y), moving, log, jnp.zeros(t.shape, jnp.int32)), fixed

    @property
    def log(self) -> list[range]:
        """Return the rows that record transitions, one range per recorded quantity."""
        rows, most = self.form.log, max(self.form.transitions, 1)
        return [range(k, k + most) for k in rows[::most]]

    def writer(self, start: Start, asked: Sequence[int] = ()) -> ArrayWriter:
        """Return a writer with the functions that a step calls."""
        w = ArrayWriter(start.goals[0])
        w.functions = Functions(w, self.form, self.rest, start.known, tuple(asked), self.method)
        return w

    def rows_in(self, w: ArrayWriter, going: Going, fixed: dict) -> Pointer:
        """Put the rows of all samples into memory."""
        state = w.holding(going.y)
        logged = {
            row: (array, i)
            for block, array in zip(self.log, going.log, strict=True)
            for i, row in enumerate(block)
        }
        rows = going.rows | fixed | logged
        state.room.rows.extend(rows[row] for row in range(self.form.integrated, self.form.all))
        return state

    def tried(self, going: Going, fixed: dict, start: Start) -> tuple[Going, Array]:
        """Try a step in all running samples. Also return the rates at its stages."""
        w = self.writer(start)
        state, k = self.rows_in(w, going, fixed), w.room(self.form.integrated * self.method.needed)
        tried = tried_by_stages if isinstance(self.method, Method) else tried_by_equations
        step(w, self.form, self.method, Lanes(w, self.form, state), k, tried)
        return going._replace(
            y=w.load(state, Rows(0, self.form.integrated)),
            rows={row: w.load(state, row) for row in going.rows},
            log=[w.load(state, Rows(block.start, len(block))) for block in self.log],
        ), w.whole(k.room)

    def _row(self, name: str) -> int:
        return self.form.rows[name].start

    def saving(self, start: Start, going: Going, ys: Array | None) -> tuple[Going, Array | None]:
        """Count the times reached, set the next one, and, unless `ys` is None, save the states there."""
        code_, t_, goal_ = map(self._row, ("code", "t", "goal"))
        times, y = len(start.goals), going.y

        def due(code, passed):
            return (code == RUNNING) & (
                going.rows[t_] == at_number(start.goals, jnp.minimum(passed, times - 1))
            )

        def save(carry):
            code, passed, ys = carry
            here = due(code, passed)
            if ys is not None:
                ys = (
                    jnp.where((numbers(times, y) == passed) & here, y, ys)
                    if y.ndim > 1
                    else jax.lax.dynamic_update_index_in_dim(ys, y, passed, 0)
                )
            passed = passed + here
            return jnp.where(here & (passed >= times), IDLE, code), passed, ys

        code, passed, ys = jax.lax.while_loop(
            lambda carry: eqxi.unvmap_any(jnp.any(due(*carry[:2]))),
            save,
            (going.rows[code_], going.passed, ys),
        )
        goal = at_number(start.goals, jnp.minimum(passed, times - 1))
        for knots in start.of_samples:
            direction = jnp.sign(start.goals[-1])
            ahead = jnp.where((knots - going.rows[t_]) * direction > 0, knots * direction, jnp.inf)
            goal = direction * jnp.minimum(goal * direction, jnp.min(ahead, axis=0))
        return going._replace(rows=going.rows | {code_: code, goal_: goal}, passed=passed), ys

    def on_its_way(self, going: Going) -> Array:
        """Return whether any sample is still running."""
        code = going.rows[self._row("code")]
        return eqxi.unvmap_any(jnp.any((code == RUNNING) | (code == LOCATING)))

    def run(self, start: Start) -> Found:
        """Integrate the motion to its end."""
        begun, fixed = self.begun(start)
        ys = jnp.zeros((len(start.goals), *begun.y.shape), begun.y.dtype)

        def tried(carry):
            going, ys = carry
            return self.saving(start, self.tried(going, fixed, start)[0], ys)

        going, ys = jax.lax.while_loop(
            lambda carry: self.on_its_way(carry[0]), tried, self.saving(start, begun, ys)
        )
        ys = jnp.where(numbers(len(ys), going.y) >= going.passed, going.y, ys)
        code, w = self._row("code"), self.writer(start)
        rows = going.rows | {code: jnp.where(going.rows[code] == IDLE, RUNNING * 1.0, going.rows[code])}
        state = self.rows_in(w, going._replace(rows=rows), fixed)
        w.store(code_at_end(w, self.form, Lanes(w, self.form, state)), state, code)
        end = jnp.concatenate([w.load(state, Rows(0, self.form.returned)), *going.log])
        return Found.of(self.form, ys, end, going.passed.astype(end.dtype)[None])


def at_number(x: Float[Array, "times *lanes"], i) -> PerLane:
    """Return for each sample the time with its index `i`."""
    return x[i] if x.ndim == 1 else jnp.take_along_axis(x, i[None], 0)[0]


def numbers(times: int, y: Float[Array, "y *lanes"]) -> Int[Array, "times *ones"]:
    """Return the indices of the times, shaped to broadcast against states `y`."""
    return jnp.reshape(jnp.arange(times), (-1, *[1] * y.ndim))


SLOTS = (  # code
    # maximum number of trial steps per window and of checkpoints; at least 1/16 of it if memory is limited
    256
)


class _Record(NamedTuple):
    """Record of the forward steps of a motion: their number, the window in memory, and a checkpoint at every
    `every`-th window.
    """

    going: Going
    tries: Count
    window: Float[Array, "slots rows *lanes"]
    checkpoints: PyTree
    every: Count


def cotangents(
    of: Loop, asked: Sequence[int], memory: int, start: Start, g: Found
) -> tuple[Array, list[Array]]:
    """Return the cotangents of the initial state, and of the known arrays with the indices `asked`, from the
    cotangents `g` of the motion.

    `memory`: limit in bytes; the window and the checkpoints each use at most a quarter.
    """
    (g_ys,), (g_end,), (g_t,), (g_log,), _ = g
    form, slot = of.form, Slot.of(of.form, of.method)
    begun, fixed = of.begun(start)
    begun, _ = of.saving(start, begun, None)
    lanes, most = begun.passed.shape, of.most + MOST_STEPS + 2
    t, taken = form.rows["t"].start, form.rows["taken"].start

    def room(rows: int, most: int) -> int:
        return max(SLOTS // 16, min(most, memory // (32 * rows * math.prod(lanes))))

    slots = room(slot.all, SLOTS)
    kept = 2 * room(2 * form.all, most // (2 * slots) + 1)

    def recorded(record: _Record) -> _Record:
        going, tries, window, checkpoints, every = record
        place = jnp.where(tries % (slots * every) == 0, tries // (slots * every), kept)
        checkpoints = jax.tree.map(
            lambda kept, x: jax.lax.dynamic_update_index_in_dim(kept, x, place, 0), checkpoints, going
        )
        new, k = of.tried(going, fixed, start)
        rows = jnp.concatenate(
            [
                *(going.y, k),
                jnp.stack([going.rows[t], new.rows[taken], going.passed.astype(going.y.dtype)]),
                *(new.rows[row][None] for row in form.rows.get("left", ())),
            ]
        )
        window = jax.lax.dynamic_update_index_in_dim(window, rows, tries % slots, 0)
        return _Record(of.saving(start, new, None)[0], tries + 1, window, checkpoints, every)

    def filled(record: _Record) -> _Record:
        full = kept * slots * record.every
        record = jax.lax.while_loop(
            lambda record: of.on_its_way(record.going) & (record.tries < full), recorded, record
        )
        is_full = record.tries == full
        rest = jax.tree.map(
            lambda x: jnp.where(is_full, jnp.concatenate([x[:-1:2], x[kept // 2 :]]), x), record.checkpoints
        )
        return record._replace(checkpoints=rest, every=jnp.where(is_full, 2 * record.every, record.every))

    checkpoints = jax.tree.map(lambda x: jnp.zeros((kept + 1, *x.shape), x.dtype), begun)
    record = _Record(
        begun, jnp.int32(0), jnp.zeros((slots, slot.all, *lanes), begun.y.dtype), checkpoints, jnp.int32(1)
    )
    record = jax.lax.while_loop(lambda record: of.on_its_way(record.going), filled, record)
    end, index = record.going, numbers(len(start.goals), begun.y)

    def added(g, first, last):
        """Add the cotangents of the states saved at the times with indices `first` to `last - 1`."""
        more = lambda: g + jnp.sum(jnp.where((index >= first) & (index < last), g_ys, 0.0), axis=0)
        return jax.lax.cond(eqxi.unvmap_any(jnp.any(first < last)), more, lambda: g)

    w = of.writer(start, asked)
    known = sum(w.functions.sizes())
    g = w.holding(added(g_end, end.passed, jnp.full(lanes, len(start.goals), jnp.int32)))
    by_known = w.room(max(known, 1))
    if form.has_events:
        state = of.rows_in(w, end, fixed)
        located = is_located(w, Lanes(w, form, state))
        w.if_any(
            located, lambda: event_back(w, form, known, state, located, w.holding(g_t[None]), g, by_known)
        )

    def step_of(carry):
        last, saved, g, by_known, changed, window = carry
        w = of.writer(start, asked)
        going = end._replace(rows=end.rows | changed)
        state = of.rows_in(w, going, fixed)
        here = jax.lax.dynamic_index_in_dim(window, last % slots, 0, keepdims=False)
        before = here[slot.saved].astype(jnp.int32)
        at, g, by_known = w.holding(here), w.holding(added(g, before, saved)), w.holding(by_known)
        if form.goes_on:
            lanes_, left = Lanes(w, form, state), w.at(at, slot.left)
            switched = w.load(left) != 0.0
            lanes_["passed"] = lanes_["passed"] - jnp.where(is_noted(w, form, w.load(left)), 1.0, 0.0)
            number = lanes_["passed"].astype(jnp.int32)
            own = (numbers(form.transitions, g_t) == number) & is_noted(w, form, w.load(left))
            g_time = jnp.sum(jnp.where(own, g_log, 0.0), axis=0)
            w.if_any(
                switched,
                lambda: reset_back(w, form, known, state, left, w.holding(g_time[None]), g, by_known),
            )
        if isinstance(of.method, Method):
            step_back(w, form, of.method, known, state, at, g, by_known)
        else:
            w.in_step(here[slot.t], here[slot.taken])
            w.run("pull_step", state, here[slot.t], here[slot.taken], at, g, by_known)
        changed = {row: w.load(state, row) for row in changed}
        return last - 1, before, w.whole(g.room), w.whole(by_known.room), changed, window

    def window_of(carry):
        first = carry[0] // slots * slots
        last, *found, window = jax.lax.while_loop(lambda carry: carry[0] >= first, step_of, carry)

        def again():
            number = last // (slots * record.every)
            begin = jax.tree.map(
                lambda x: jax.lax.dynamic_index_in_dim(x, number, 0, keepdims=False), record.checkpoints
            )
            passing = record._replace(going=begin, tries=number * slots * record.every, window=window)
            return jax.lax.while_loop(lambda record: record.tries < first, recorded, passing).window

        return last, *found, jax.lax.cond(last >= 0, again, lambda: window)

    changing = [row for name in ("mode", "passed") for row in form.rows.get(name, ())]
    changed = {row: end.rows[row] for row in changing}
    carry = record.tries - 1, end.passed, w.whole(g.room), w.whole(by_known.room), changed, record.window
    _, saved, found, by_known, *_ = jax.lax.while_loop(lambda carry: carry[0] >= 0, window_of, carry)
    return added(found, jnp.zeros(lanes, jnp.int32), saved), w.functions.leaves(by_known)
