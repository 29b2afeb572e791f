"""The stages of a step of lanes side by side, and what is watched at each: pivots, directions of rows, how near rows are to losing rank."""

import math
import operator
from functools import reduce
from typing import NamedTuple

import numpy as np

from jourdain_jax.motion.integrators.erk_step import LEAST_SHARE, NEAR_SINE
from jourdain_jax.motion.integrators.event_search import any_of
from jourdain_jax.motion.integrators.explicit_steps import Method
from jourdain_jax.motion.native.layout import Form, Lanes, copied, each_row
from jourdain_jax.motion.native.writers import MachineWriter
from jourdain_jax.native.ir import Value


class Rank(NamedTuple):
    """How near to a loss of rank the rows are in a step."""

    near: Value  # at its start
    square: Value  # the smallest squared sine between a row and those before it, of all stages


def stages(w: MachineWriter, form: Form, method: Method, p: Lanes, k: Value, t: Value, step: Value, y1: Value) -> tuple[Value, Value, Rank | None]:
    """The smallest magnitude of a pivot, whether any changed its sign, and how near rows are to losing rank.

    Puts the slopes of all stages into `k`, and into `y1` the state of the next stage, worked out once, until it is that at the end of the step.
    """
    count, every = form.pivots, form.integrated
    at, pivots, square = y1, w.room(max(len(form.monitored), 1)), w.room()
    n = method.needed
    A, c, no = w.table(np.array([*method.A[1:n, :n], method.b[:n]])), w.table(method.c[:n]), w.literal(0, w.truth)
    copied(w, every, p.pointer, y1)
    w.store(math.inf, square)

    turning = range(count, count + form.turning)

    def stage(i: int, found: tuple) -> tuple:
        first, low, high, turned, near = found
        time = w.fma(step, c[i], t)
        if form.squares and not w.is_first(i):
            put_near_rows(w, form, p.pointer, near, time, at)
        w.run("rates", p.pointer, time, at, w.at(k, i * every), pivots)
        now, directions = w.every(pivots, range(count)), [w.load(pivots, j) for j in turning]
        if form.squares:
            by_rows = squares_of(w, form, pivots)
            near = w.at_first(i, near_rank_loss(by_rows), near)
            w.if_any(near, lambda: w.store(reduce(w.smaller, [left / size for left, size in by_rows], w.load(square)), square))
        first = [w.at_first(i, new, old) for new, old in zip(directions, first, strict=True)]
        turned = turned | turns_round(w, form, first, directions)
        low, high = [w.smaller(a, b) for a, b in zip(low, now, strict=True)], [w.larger(a, b) for a, b in zip(high, now, strict=True)]
        each_row(w, every, y1, lambda row: w.fma(step, weighted(w, A[i], k, form, row), w.load(p.pointer, row)))
        return first, low, high, turned, near

    low, high = ([w.number(x)] * len(w.every(pivots, range(count))) for x in (math.inf, -math.inf))
    found = [w.number(0.0)] * form.turning, low, high, no, no
    _, low, high, changed, near = w.over_stages(n, stage, found)
    smallest = w.least([w.smaller(w.magnitude(a), w.magnitude(b)) for a, b in zip(low, high, strict=True)])
    changed = changed | w.in_any([(a < 0.0) & (b > 0.0) for a, b in zip(low, high, strict=True)])
    return smallest, changed, Rank(near, w.load(square)) if form.squares else None


def squares_of(w: MachineWriter, form: Form, monitored: Value) -> list[tuple[Value, Value]]:
    """What is left of each row beside those before it, and its size, squared."""
    found = [w.load(monitored, j) for j in range(len(form.monitored) - len(form.squares), len(form.monitored))]
    return list(zip(found[::2], found[1::2], strict=True))


def near_rank_loss(squares: list[tuple[Value, Value]]) -> Value:
    """Whether some row is nearly one of those before it."""
    return any_of([left < NEAR_SINE**2 * size for left, size in squares])


def put_near_rows(w: MachineWriter, form: Form, state: Value, near: Value, t: Value, y: Value) -> None:
    """Puts the state `y` of a stage back onto the rows in lanes that are `near` a loss of rank."""

    def put() -> None:
        on_rows = w.room(form.integrated)
        copied(w, form.integrated, y, on_rows)
        w.run("project", state, t, on_rows)
        copied(w, form.integrated, on_rows, y, near)

    w.if_any(near, put)


def turns_round(w: MachineWriter, form: Form, first: list[Value], now: list[Value]) -> Value:
    """Return whether the part of a row's slope along its first one has fallen below its least share; entries of directions alone."""
    along = lambda row, slope: reduce(operator.add, (first[k] * slope[k] for k in row))  # noqa: E731
    width = max(form.speeds, 1)
    rows = [range(k, k + width) for k in range(0, form.turning, width)]
    lasting = [along(row, now) > LEAST_SHARE * along(row, first) for row in rows]
    return ~reduce(operator.and_, lasting) if lasting else w.literal(0, w.truth)


def weighted(w: MachineWriter, weights: np.ndarray, k: Value, form: Form, row: int | Value) -> Value:
    """sum_j w_j k_j of one number of the state; numbers of a loop over stages may all be other than zero."""
    first, *others = [j for j in range(len(weights)) if w.may_count(weights, j)]
    total = w.load(k, row + first * form.integrated) * weights[first]
    for j in others:
        total = w.fma(w.load(k, row + j * form.integrated), weights[j], total)
    return total
