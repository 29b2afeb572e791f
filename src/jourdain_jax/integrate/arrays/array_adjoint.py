"""Reverse mode of the loop in JAX, by the same code as machine code (`integrate/loop/adjoint.py`).

The motion is integrated once more, and its trial steps are recorded in a window of limited length. At the
end, the window contains the last steps. The steps of each earlier window are computed again, with equal bits,
from the nearest checkpoint, which is a state stored at the beginning of a window. The number of checkpoints
is also limited; at the limit, every second checkpoint is dropped.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import equinox.internal as eqxi
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from jourdain_jax.calculus.reals import Count
from jourdain_jax.integrate.arrays.array_loop import Going, Loop, numbers
from jourdain_jax.integrate.event_search import MOST_STEPS
from jourdain_jax.integrate.explicit_steps import Method
from jourdain_jax.integrate.loop.adjoint import step_back
from jourdain_jax.integrate.loop.event_adjoint import event_back, is_located
from jourdain_jax.integrate.loop.handover import Start
from jourdain_jax.integrate.loop.lanes import Lanes
from jourdain_jax.integrate.loop.record import Slot
from jourdain_jax.integrate.loop.transitions import is_noted, reset_back

SLOTS = (
    # maximum number of trial steps per window and of checkpoints; a memory limit may reduce both, to a
    # sixteenth
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
    of: Loop,
    asked: Sequence[int],
    memory: int,
    start: Start,
    g_ys: Array,
    g_end: Array,
    g_t: Array,
    g_log: Array,
) -> tuple[Array, list[Array]]:
    """Return the cotangents of the initial state, and of the known arrays with the indices `asked`.

    `g_ys`, `g_end`, `g_t`, `g_log`: cotangents of the saved states, of the final state and its time, and of
    the times of transitions. `memory`: limit in bytes; the window and the checkpoints each use at most a
    quarter.
    """
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
