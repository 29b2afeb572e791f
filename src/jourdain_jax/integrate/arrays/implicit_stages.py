"""Step of an implicit method (`implicit_steps.py`) in JAX. Batches run under `vmap`.

Trial steps of the event search use the method, too. The last, very small shifts of the search are steps of
Tsit5, which carry the derivatives of the motion. If the equations of a step are not solved, its error is
infinite. Methods with equal steps cannot repeat a step; a rejected step ends the motion with a result code.
"""

import math
from functools import partial

from jourdain_jax.integrate import result_codes
from jourdain_jax.integrate.arrays.array_writer import ArrayWriter, Pointer
from jourdain_jax.integrate.event_search import RUNNING, search_of
from jourdain_jax.integrate.explicit_steps import TSIT5, aimed, judged
from jourdain_jax.integrate.implicit_steps import ImplicitMethod, even_step
from jourdain_jax.integrate.loop.lanes import Lanes, copied, each_row
from jourdain_jax.integrate.loop.step import Trial, norm, project, seen, stages, unseen, worst


def tried_by_equations(w: ArrayWriter, form, method: ImplicitMethod, p: Lanes, k: Pointer) -> Trial:
    """Try a step. Store the rates at its start, middle and end in `k` if events or pivots need them."""
    reach, y = p["h"], p.pointer
    if method.even:
        reach = w.smaller(reach, even_step(p["longest"], w.magnitude(p["goal"] - p["t"])))
    aim = aimed(w, p, p["goal"], reach, p["search_shift"] if form.has_events else None)
    y1, error, told = w.room(form.integrated), w.room(form.y), w.room(2)
    w.in_step(p["t"], aim.h)
    w.run("solve", y, p["t"], aim.h, y1, error, told)
    solved = w.load(told) > 0.0
    if form.has_events:
        near = w.room(form.integrated)
        stages(w, form, TSIT5, p, w.room(form.integrated * TSIT5.needed), p["t"], aim.h, near)
        shifts = aim.locating & ~search_of(form, p).trying
        copied(w, form.integrated, near, y1, shifts)
        solved = solved | shifts
    smallest, changed = w.number(math.inf), False
    if form.monitored or form.has_events:
        smallest, changed = _watched_within(w, form, p, k, y1, aim.h)
    fault = w.where(solved, RUNNING * 1.0, float(result_codes.UNSOLVED_STEP))
    if form.projects and method.even:
        w.run("onto_rows", y, aim.t_1, y1, told)
        # the projection may change at most half of the change by the step
        fault = w.where(solved & (w.load(told, 1) > 0.5), float(result_codes.OFF_CONSTRAINTS), fault)
    elif form.projects:
        project(w, form, p, aim.t_1, y1, error)
    size = w.number(0.0) if method.even else norm(w, form, p, error, y1)
    if form.monitored:
        fault = w.where(solved & changed, float(result_codes.SINGULAR_PARTITION), fault)
    size = w.where(w.differs(fault, RUNNING) & ~aim.locating, math.inf, size)
    accept, next_h = judged(w, w.power, p, aim, size, method.order)
    fails = ~accept if method.even else aim.locating & w.equal(fault, result_codes.UNSOLVED_STEP)
    return Trial(aim, y1, accept, next_h, smallest if form.pivots else None, fails, fault)


def _watched_within(w: ArrayWriter, form, p: Lanes, k: Pointer, y1: Pointer, h) -> tuple:
    """Return the smallest pivot at the ends and the middle of a step, and whether a pivot changed its sign or
    a constraint reversed its direction.
    """
    at = w.room(form.integrated)
    pivots = w.room(max(len(form.monitored), 1))
    halves = w.table([0.0, 0.5, 1.0])
    every = form.integrated

    def state(i, row):
        start = w.load(p.pointer, row)
        return w.fma(halves[i], w.load(y1, row) - start, start)

    def look(i, known: tuple) -> tuple:
        each_row(w, every, at, partial(state, i))
        w.run("rates", p.pointer, w.fma(halves[i], h, p["t"]), at, w.at(k, i * every), pivots)
        return seen(w, form, i, pivots, known)

    return worst(w, w.over_stages(3, look, unseen(w, form)))
