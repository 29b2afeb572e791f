"""Steps by Taylor series: the coefficients of a state along its motion, how far they reach, and the state at any time within reach.

    y(t + s) = sum_{k=0}^p y_k s^k,        h = safety min((1/N_{p-1})^{1/(p-1)}, (1/N_p)^{1/p}),   N_k = rms(y_k/(atol + rtol |y_0|))

so that neither of the last two terms of a step is larger than what is allowed. Source: A. Jorba and M. Zou, Experimental Mathematics 14 (2005) 99, section 3.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from jourdain_jax.motion.native.functions import Form, known_values, outputs_of
from jourdain_jax.motion.native.layout import Lanes, Layout
from jourdain_jax.native import series
from jourdain_jax.native.exponentials import exponential, logarithm
from jourdain_jax.native.ir import Value, Writer
from jourdain_jax.native.scalar_program import as_real, written
from jourdain_jax.native.series import Coefficients, Series


@dataclass(frozen=True)
class TaylorSteps:
    """Taylor series up to this order, in place of a tableau."""

    order: int

    @property
    def needed(self) -> int:
        """Rows of a state that a step keeps: the coefficients, and the slope at its end."""
        return self.order + 2

    @property
    def at_the_end(self) -> int:
        """The place of the slope at the end, counted from that at the start."""
        return self.order


class Monitored(NamedTuple):
    """What must not change its sign."""

    holds: Value  # whether all guards are positive
    values: list[Value]  # as `Form.monitored`, pivots relative to their usual sizes


class Jet(NamedTuple):
    """The coefficients of every number that is integrated, and what is monitored at their start."""

    rows: list[Coefficients]
    monitored: Monitored


def jet(w: Writer, form: Form, p: Lanes, t: Value, order: int) -> Jet:
    """The Taylor series of the lanes' states, and of their tangents, at the time t."""
    program, layout, y = form.program, form.layout, p.pointer
    rates = form.rates
    own = outputs_of(form, [*rates, *_monitored(form)], len(rates))
    first = len(program.fixed)  # time, then the state
    known = dict(zip(own.variables, known_values(w, form, y, t, y).values(), strict=True))
    states = own.variables[first + 1 : first + 1 + layout.coordinates + layout.speeds]
    given = {n: x for n, x in known.items() if n not in states} | dict(zip(own.known, p.every("dknown"), strict=True))
    given |= dict(zip(own.times, p.every("dt"), strict=True)) if own.times else {}

    def with_work(nodes: list[int], other: int | None) -> list:
        return [*nodes, *[other] * (layout.y - len(nodes))]

    moved = [n for part in (states, *own.states) for n in with_work(part, None)]
    nodes = [n for part in (own.values[: len(rates)], *own.tangents) for n in with_work(part, own.graph.zero)]
    start = [w.load(y, i) for i in range(layout.integrated)]
    found = Series(w, own.graph, given, moved, nodes, start, order, own.variables[first])
    values = {n: w.number(0.0) if x[0] is None else x[0] for n, x in found.of.items()}
    return Jet(found.state, _evaluated(w, form, own.graph, own.values[len(rates) :], values, known))


def products(form: Form, order: int) -> int:
    """About how many multiplications a step takes, tangents and all."""
    own = outputs_of(form, form.rates, form.layout.y)
    return series.products(own.graph, [*own.values, *(n for part in own.tangents for n in part)], order)


def _monitored(form: Form) -> list[int]:
    return [*form.program.guards, *form.monitored]


def monitored_at(w: Writer, form: Form, p: Lanes, t: Value, y: Value) -> Monitored:
    """What is monitored, at a state in memory."""
    known = known_values(w, form, p.pointer, t, y)
    return _evaluated(w, form, form.program.graph, _monitored(form), known, known)


def _evaluated(w: Writer, form: Form, graph, nodes: Sequence[int], values: Mapping[int, Value], known: Mapping[int, Value]) -> Monitored:
    found, of_variables = [as_real(w, x) for x in written(w, graph, nodes, values)], list(known.values())
    count, holds = len(form.program.guards), w.literal(-1, w.truth)
    for guard in found[:count]:
        holds = holds & (guard > 0.0)
    sizes = [of_variables[form.program.variables.index(n)] for n in form.program.sizes[: form.pivots]]
    pivots = [x / size for x, size in zip(found[count:], sizes, strict=False)]
    return Monitored(holds, [*pivots, *found[count + len(pivots) :]])


def radius(w: Writer, layout: Layout, p: Lanes, rows: Sequence[Coefficients]) -> Value:
    """How long a step may be; zero where a coefficient is no number."""
    rtol, atol, count = p["rtol"], p["atol"], layout.coordinates + layout.speeds
    inverse = [1.0 / w.fma(rtol, w.magnitude(w.load(p.pointer, i)), atol) for i in range(count)]
    order, least = len(rows[0]) - 1, w.number(math.inf)  # of log h
    for k in (order - 1, order):
        square = w.number(0.0)  # of N_k, times `count`
        for x, share in zip(rows, inverse, strict=False):
            if x[k] is not None:
                relative = x[k] * share
                square = w.fma(relative, relative, square)
        least = w.smaller(least, (-0.5 / k) * logarithm(w, square * (1.0 / count)))
    reach = w.where(least < math.inf, exponential(w, least), least)
    return 0.9 * w.where(w.is_nan(reach), 0.0, reach)


def at_time(w: Writer, series: Coefficients, s: Value) -> Value:
    """sum_k x_k s^k"""
    total = w.number(0.0) if series[-1] is None else series[-1]
    for x in reversed(series[:-1]):
        total = total * s if x is None else w.fma(total, s, x)
    return total


def slope(series: Coefficients) -> Coefficients:
    """Coefficients of the derivative."""
    return [x if x is None or k == 0 else x * float(k + 1) for k, x in enumerate(series[1:])]
