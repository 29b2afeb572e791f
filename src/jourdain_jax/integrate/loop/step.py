"""One step of several lanes: an explicit Runge-Kutta method with embedded error estimate, and trial steps of
the event search.

    k_i = f(t + c_i h, y + h sum_j a_ij k_j),   y_1 = y + h sum b_i k_i,   e = h sum b^err_i k_i
    |e| = rms(e / (atol + rtol max(|y|, |y_1|))) <= 1 accepts
    h <- min(h clip(0.9 |e|^(-1/order), 0.2, 10), longest)

Machine code and JAX arrays share this code of a step. A writer object provides arithmetic, memory, branches
and loops: `MachineWriter` (`lanes.py`) generates machine code, `ArrayWriter`
(`integrate/arrays/array_writer.py`) computes with JAX arrays. `integrate/event_search.py` locates events,
including those of relations (`lowering/sides.py`).

Steps end at each requested time and at each knot of the inputs. After a step shortened for this purpose, the
previous step size is used again. The state advances by the difference of the rounded times at the ends of a
step.

Near a loss of rank, let sigma be the sine of the angle between a constraint and the earlier ones. Round-off
eps of a constraint then causes a velocity eps/sigma^2 across it, which dominates the error of short steps. If
sigma < 0.1 at the start of a step, its stages are projected onto the constraints. Its error is the larger of
two parts: the error along the constraints, less n^2, and the displacement by the projection, less n. Here n =
16 eps/sigma^2, at most eps^0.4, for the smallest sigma of all stages; a displacement n across the constraints
moves the state by n^2 along them. So the position decides whether a motion passes a loss of rank, and the
tolerance does not.

In single precision, the state uses compensated summation (Kahan). Without it, a state whose increments are
below its last digit would not change at all, and the error estimate would not detect this.
"""

import math
import operator
from collections.abc import Callable
from functools import reduce
from typing import Any, NamedTuple

import numpy as np

from jourdain_jax.equations.reductions import SMALLEST_PIVOT
from jourdain_jax.integrate import result_codes
from jourdain_jax.integrate.event_search import LOCATING, RUNNING, monitored
from jourdain_jax.integrate.event_values import any_of
from jourdain_jax.integrate.explicit_steps import Aim, Method, aimed, judged, taken
from jourdain_jax.integrate.loop.form import Form
from jourdain_jax.integrate.loop.lanes import Lanes, Number, StepWriter, copied, each_row
from jourdain_jax.integrate.loop.taylor import TaylorSteps, at_time, jet, monitored_at, radius, slope
from jourdain_jax.integrate.relation_sides import first_sides

# a relative displacement of eps^NOISE counts as noise; near a loss of rank, at most eps^(1 - NOISE)
NOISE = 0.6  # numerics


IDLE = -9.0  # code: a lane that has no sample, or whose sample has saved all its times


class Trial(NamedTuple):
    """Trial step of all lanes."""

    aim: Aim
    y1: Number  # pointer to the state after the step
    accept: Number
    next_h: Number  # length of the next step, positive
    pivot: Number | None  # smallest magnitude of a monitored pivot
    fails: Number | None = None  # whether the step ends the motion with `code`
    code: Number | None = None


def write_step(w: StepWriter, form: Form, method: Method | TaylorSteps) -> None:
    """Write `step(state, k)`, which makes one trial step of all running lanes. `k`: memory for the rates of
    its stages, or for Taylor coefficients.
    """
    with w.procedure("step", "state:noalias k:noalias") as (state, k):
        lanes = Lanes(w, form, state)
        if isinstance(method, TaylorSteps):
            if form.sides:
                first_sides(w, form, lanes)
            take(
                w, form, method, lanes, w.at(k, form.integrated), _tried_by_series(w, form, method, lanes, k)
            )
        else:
            step(w, form, method, lanes, k, tried_by_stages)


def step(w: StepWriter, form: Form, method, p: Lanes, k: Number, tried: Callable) -> None:
    """Make one trial step of all running lanes. `tried`: function that returns the `Trial`."""
    if form.sides:
        first_sides(w, form, p)
    take(w, form, method, p, k, tried(w, form, method, p, k))


def tried_by_stages(w: StepWriter, form: Form, method: Method, p: Lanes, k: Number) -> Trial:
    """Try a Runge-Kutta step, which ends at the next saved time at the latest."""
    aim = aimed(w, p, p["goal"], p["h"], p["search_shift"] if form.has_events else None)
    t1, step = aim.t_1, aim.h
    y1, error = w.room(form.integrated), w.room(form.y)
    w.in_step(p["t"], step)
    smallest, changed_sign, rank = stages(w, form, method, p, k, p["t"], step, y1)
    # include stages of weight zero, so that their NaN reaches the error; comparisons would hide it
    weights = method.b_error[: method.needed]
    each_row(w, form.y, error, lambda i: step * weighted(w, weights, k, form, i, every=True))
    if form.compensated:
        _compensate(w, form, p, y1, lambda i: step * weighted(w, method.b, k, form, i))
    if form.projects:
        project(w, form, p, t1, y1, error, rank)
    size_of_error = norm(w, form, p, error, y1)
    if form.pivots or form.turning:
        size_of_error = w.where(changed_sign & ~aim.locating, math.inf, size_of_error)
    accept, next_h = judged(w, w.power, p, aim, size_of_error, method.order)
    return Trial(aim, y1, accept, next_h, smallest if form.pivots else None)


def _compensate(w: StepWriter, form: Form, p: Lanes, y1: Number, increment: Callable[[Any], Number]) -> None:
    """Add increments and the round-off of earlier sums to the state (Kahan), and store the new round-off."""
    rest, first = w.at(p.pointer, form.rows["rest"].start), w.at(p.pointer, form.rows["next_rest"].start)

    def sums(i: Any) -> None:
        whole, start = increment(i) + w.load(rest, i), w.load(p.pointer, i)
        total = start + whole
        w.store(whole - (total - start), first, i)
        w.store(total, y1, i)

    w.each(range(form.y), sums)


def _tried_by_series(w: StepWriter, form: Form, method: TaylorSteps, p: Lanes, k: Number) -> Trial:
    """Try a step by Taylor series, which may pass saved times. Store the coefficients in `k`, followed by the
    rates at the end of the step.
    """
    count = form.integrated
    t, last_goal, direction = p["t"], p["last_goal"], p["direction"]
    locating = w.equal(p["code"], LOCATING)
    rows, at_start = jet(w, form, p, t, method.order)
    for row, series in enumerate(rows):
        for j, x in enumerate(series):
            w.store(x, k, j * count + row)
    length = w.smaller(radius(w, form, p, rows), p["longest"])
    size = w.smaller(length, p["bound"])
    rest = w.magnitude(last_goal - t)
    lands = ~locating & (size >= 0.999 * rest)
    size = w.where(lands, rest, size)
    step = w.where(locating, p["search_shift"], direction * size) if form.has_events else direction * size
    t1 = w.where(lands, last_goal, t + step)
    step = t1 - t
    y1, pivot, accept = w.room(count), None, size > 0.0
    for row, series in enumerate(rows):
        w.store(at_time(w, series, step), y1, row)
        if form.has_events:
            w.store(at_time(w, slope(series), step), k, (method.order + 1) * count + row)
    at_end = monitored_at(w, form, p, t1, y1)
    holds = at_start.holds & at_end.holds
    w.store(w.where(holds, w.load(y1), math.nan), y1)
    accept, length = accept & holds, w.where(at_start.holds, length, 0.0)
    for a, b in zip(at_start.values[: form.pivots], at_end.values, strict=False):
        least = w.smaller(w.magnitude(a), w.magnitude(b))
        pivot = least if pivot is None else w.smaller(pivot, least)
        accept = accept & ~(((a < 0.0) & (b > 0.0)) | ((a > 0.0) & (b < 0.0)))
    accept = accept & ~turns_round(
        w, form, *(x.values[form.pivots : form.pivots + form.turning] for x in (at_start, at_end))
    )
    if form.projects:
        error = w.room(form.y)
        each_row(w, form.y, error, lambda i: 0.0)
        project(w, form, p, t1, y1, error)
        accept = accept & (norm(w, form, p, error, y1) <= 1.0)
    accept = locating | accept
    p["bound"] = w.where(accept, math.inf, 0.5 * size)
    p["before"] = t
    return Trial(
        Aim(t1, step, size, locating),
        y1,
        accept,
        w.where(accept, length, w.smaller(length, 0.5 * size)),
        pivot,
    )


def take(w: StepWriter, form: Form, method, p: Lanes, k: Number, trial: Trial) -> None:
    """Update the lanes after a trial step. `k`: rates at the stages, beginning with those at the start of the
    step.
    """
    y, count = p.pointer, form.integrated
    if form.goes_on:
        p["left"] = w.number(0.0)
    aim, y1, accept, next_h, smallest = trial[:5]
    t1, locating = aim.t_1, aim.locating
    new = taken(w, p, aim, accept, next_h)
    new["taken"] = w.where(accept, aim.h, 0.0)  # time by which the state has advanced
    each_row(w, count, y1, lambda i: w.where(accept, w.load(y1, i), w.load(y, i)))
    if form.has_events:
        ends = k, w.at(k, method.at_the_end * form.integrated)
        new = monitored(w, form, p, ends, y1, new, aim.h, accept & ~locating & w.equal(new["code"], RUNNING))
    if trial.fails is not None:
        new["code"] = w.where(trial.fails, trial.code, new["code"])
    counts = accept & ~locating & w.equal(new["code"], RUNNING) & w.equal(new["t"], t1)
    if smallest is not None:
        pivot = w.where(counts, w.smaller(p["pivot"], smallest), p["pivot"])
        new |= {
            "pivot": pivot,
            "code": w.where(counts & (pivot < SMALLEST_PIVOT), result_codes.SINGULAR_PARTITION, new["code"]),
        }
    moving = locating | w.equal(p["code"], RUNNING)
    copied(w, count, y1, y, moving)
    if form.compensated:  # round-off of a step that counts
        rest, left = (w.at(y, form.rows[name].start) for name in ("rest", "next_rest"))
        copied(w, form.y, left, rest, moving & accept & ~locating)
    for name, value in new.items():
        p[name] = w.where(moving, value, w.number(0.0) if name == "taken" else p[name])


class Rank(NamedTuple):
    """How close the constraints are to a loss of rank in a step."""

    near: Number  # whether they are close to it at the start of the step
    square: Number  # smallest squared sine between a constraint and the earlier ones, over all stages


def stages(
    w: StepWriter, form: Form, method: Method, p: Lanes, k: Number, t: Number, step: Number, y1: Number
) -> tuple[Number, Number, Rank | None]:
    """Compute all stages of a step. Return the smallest magnitude of a pivot, whether any pivot changed its
    sign or a constraint reversed, and the closeness to a loss of rank.

    The rates of all stages are stored in `k`. The state of each stage is stored in `y1`; at the end, `y1`
    contains the state at the end of the step.
    """
    every, n = form.integrated, method.needed
    pivots, square = w.room(max(len(form.monitored), 1)), w.room()
    A = w.table(np.array([*method.A[1:n, :n], method.b[:n]]))
    c = w.table(method.c[:n])
    no = w.literal(0, w.truth)
    copied(w, every, p.pointer, y1)
    w.store(math.inf, square)

    def stage(i: int, found: tuple) -> tuple:
        watched, near = found
        time = w.fma(step, c[i], t)
        if form.squares and not w.is_first(i):
            put_near_rows(w, form, p.pointer, near, time, y1)
        w.run("rates", p.pointer, time, y1, w.at(k, i * every), pivots)
        if form.squares:
            by_rows = squares_of(w, form, pivots)
            near = w.at_first(i, near_rank_loss(by_rows), near)
            sines = [left / size for left, size in by_rows]
            least = reduce(w.smaller, sines, w.load(square))
            w.store(w.where(near, least, w.load(square)), square)
        watched = seen(w, form, i, pivots, watched)
        each_row(
            w, every, y1, lambda row: w.fma(step, weighted(w, A[i], k, form, row), w.load(p.pointer, row))
        )
        return watched, near

    watched, near = w.over_stages(n, stage, (unseen(w, form), no))
    return *worst(w, watched), Rank(near, w.load(square)) if form.squares else None


def unseen(w: StepWriter, form: Form) -> tuple:
    """Return the initial values for monitoring: directions of constraints at the start, smallest and largest
    values of pivots, and whether a constraint reversed.
    """
    low, high = ([w.number(x)] * form.pivots for x in (math.inf, -math.inf))
    return [w.number(0.0)] * form.turning, low, high, w.literal(0, w.truth)


def seen(w: StepWriter, form: Form, i: Number, pivots: Number, known: tuple) -> tuple:
    """Update the values for monitoring after stage `i`, whose monitored numbers are `pivots`."""
    first, low, high, turned = known
    now, directions = (
        [w.load(pivots, j) for j in range(a, a + count)]
        for a, count in ((0, form.pivots), (form.pivots, form.turning))
    )
    first = [w.at_first(i, new, old) for new, old in zip(directions, first, strict=True)]
    low = [w.smaller(a, b) for a, b in zip(low, now, strict=True)]
    high = [w.larger(a, b) for a, b in zip(high, now, strict=True)]
    return first, low, high, turned | turns_round(w, form, first, directions)


def worst(w: StepWriter, known: tuple) -> tuple[Number, Number]:
    """Return the smallest magnitude of a pivot, and whether any pivot changed its sign or a constraint
    reversed.
    """
    _, low, high, turned = known
    smallest = reduce(
        w.smaller,
        [w.smaller(w.magnitude(a), w.magnitude(b)) for a, b in zip(low, high, strict=True)],
        w.number(math.inf),
    )
    return smallest, reduce(
        operator.or_, [(a < 0.0) & (b > 0.0) for a, b in zip(low, high, strict=True)], turned
    )


def squares_of(w: StepWriter, form: Form, monitored: Number) -> list[tuple[Number, Number]]:
    """Return two numbers for each constraint: its squared component normal to the earlier constraints, and
    its squared size.
    """
    found = [
        w.load(monitored, j) for j in range(len(form.monitored) - len(form.squares), len(form.monitored))
    ]
    return list(zip(found[::2], found[1::2], strict=True))


def near_rank_loss(squares: list[tuple[Number, Number]]) -> Number:
    """Return whether any constraint nearly depends on earlier ones: the sine between them is below 0.1."""
    return any_of(left < 0.1**2 * size for left, size in squares)


def put_near_rows(w: StepWriter, form: Form, state: Number, near: Number, t: Number, y: Number) -> None:
    """Project the state `y` of a stage onto the constraints, in lanes that are `near` a loss of rank."""

    def put() -> None:
        on_rows = w.room(form.integrated)
        copied(w, form.integrated, y, on_rows)
        w.run("project", state, t, on_rows)
        copied(w, form.integrated, on_rows, y, near)

    w.if_any(near, put)


def turns_round(w: StepWriter, form: Form, first: list[Number], now: list[Number]) -> Number:
    """Return whether a constraint has reversed: its component along its direction at the start has fallen
    below half of the initial value.
    """
    along = lambda row, slope: reduce(operator.add, (first[k] * slope[k] for k in row))
    width = max(form.speeds, 1)
    rows = [range(k, k + width) for k in range(0, form.turning, width)]
    # a step in which a component falls below half is repeated
    lasting = [along(row, now) > 0.5 * along(row, first) for row in rows]
    return ~reduce(operator.and_, lasting) if lasting else w.literal(0, w.truth)


def weighted(
    w: StepWriter, weights: Number, k: Number, form: Form, row: int | Number, every: bool = False
) -> Number:
    """Return `sum_j w_j k_j` for one row of the state. `every`: include terms of weight zero."""
    first, *others = [j for j in range(len(weights)) if every or w.may_count(weights, j)]
    total = w.load(k, row + first * form.integrated) * weights[first]
    for j in others:
        total = w.fma(w.load(k, row + j * form.integrated), weights[j], total)
    return total


def project(
    w: StepWriter, form: Form, p: Lanes, t1: Number, y1: Number, error: Number, rank: Rank | None = None
) -> None:
    """Project `y1` onto the constraints. The error estimate becomes at least as large as the displacement by
    the projection, apart from noise.
    """
    free = w.room(form.y)
    copied(w, form.y, y1, free)
    w.run("project", p.pointer, t1, y1)
    # near a loss of rank, 16 eps divided by the square of the sine counts as noise
    amplified = (
        None
        if rank is None
        else w.where(rank.near, w.smaller(16.0 * w.eps / rank.square, w.eps ** (1 - NOISE)), 0.0)
    )
    if rank is not None:

        def along_rows() -> None:
            both = w.room(2 * form.y)
            copied(w, form.y, y1, both)
            copied(w, form.y, error, w.at(both, form.y))
            w.run("along", p.pointer, t1, both)
            each_row(
                w, form.y, error, lambda i: w.where(rank.near, w.load(both, i + form.y), w.load(error, i))
            )

        w.if_any(rank.near, along_rows)
    for part in form.parts:
        largest = w.largest(part, lambda i: w.magnitude(w.load(y1, i)))
        noise = (w.eps**NOISE if amplified is None else w.larger(amplified, w.eps**NOISE)) * largest
        by_rows = None if amplified is None else amplified * amplified * largest

        def larger_error(i: int | Number, noise: Number = noise, by_rows: Number | None = by_rows) -> Number:
            moved = w.magnitude(w.load(y1, i) - w.load(free, i)) - noise
            along = w.magnitude(w.load(error, i))
            return w.larger(along if by_rows is None else along - by_rows, w.larger(moved, 0.0))

        each_row(w, part, error, larger_error)


def norm(w: StepWriter, form: Form, p: Lanes, error: Number, y1: Number) -> Number:
    """Return the root mean square of the errors of coordinates and speeds, relative to the tolerance;
    infinite if an error is NaN.
    """
    rtol, atol, count = p["rtol"], p["atol"], form.q_and_v

    def relative(i: int | Number) -> Number:
        size = w.larger(w.magnitude(w.load(p.pointer, i)), w.magnitude(w.load(y1, i)))
        return w.load(error, i) / w.fma(rtol, size, atol)

    total = w.sum_of_squares(range(count), relative) / float(count)
    return w.root(w.where(w.is_nan(total), math.inf, total))
