"""Events after which a motion continues: the state and modes afterwards, and derivatives through the event.

    z+ = R(t_e, z-, p),   c(t_e, z-, p) = 0        f, f+: rates before and after

The time of the event varies with the state and the numbers p. Tangents and cotangents at a fixed time change
at the event by

    dt_e = -(c_z dz + c_p dp)/cdot,   cdot = c_t + c_z f
    dz+ = R_z (dz + f dt_e) + R_t dt_e + R_p dp - f+ dt_e
    s = (g.(f+ - R_z f - R_t) - g_t)/cdot,   G = R_z' g + s c_z,   G_p += R_p' g + s c_p

where g_t is the cotangent of t_e (for tangents, this is the saltation matrix of hybrid systems). A state with
a tangent is again the state of a motion, whose reset consists of R and the equation for dz+. Second
derivatives therefore follow from the same formulas.

Source: M. A. Aizerman, F. R. Gantmakher, Quarterly Journal of Mechanics and Applied Mathematics 11 (1958)
433-447.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

from jourdain_jax.integrate import result_codes
from jourdain_jax.integrate.event_values import chosen
from jourdain_jax.integrate.loop.form import Form
from jourdain_jax.integrate.loop.lanes import Lanes, MachineWriter, Number, StepWriter, copied, each_row
from jourdain_jax.integrate.loop.rate_functions import Outputs, given_values, known_values, tangents_of
from jourdain_jax.kernels.ir import Value
from jourdain_jax.kernels.scalar_program import as_real, written_in_turn
from jourdain_jax.program.derivative import cotangents, derivatives, on_its_own
from jourdain_jax.program.graph import Graph, NodeList

SLOWLY = 2.0  # code: a disarmed value whose rate afterwards is positive, but within round-off
RESTS = 1e-3  # numerics: fraction of the absolute tolerance: far below errors of steps, and above round-off


class Reset(NamedTuple):
    """State after an event, with its tangents, as nodes of a separate graph."""

    own: Outputs  # variables and tangents; without values
    event: int  # input node: index of the event
    work: NodeList  # input nodes: the work and its tangents; empty if work is not integrated
    state: NodeList  # state after the event, with its tangents
    modes: NodeList
    lost: int  # loss of energy
    times: NodeList  # time of the event, with its tangents

    @property
    def graph(self) -> Graph:
        """Return the graph."""
        return self.own.graph

    @property
    def found(self) -> NodeList:
        """Return all results in the order of `Form.rows_of_transition`."""
        return [*self.state, *self.modes, self.lost, *self.times]


def reset_program(form: Form) -> Reset:
    """Return the reset of a form."""
    program, count, events = form.program, len(form.moving), form.events
    graph, values, variables = on_its_own(
        program.graph, [*form.rates, *program.events, *program.energies, *program.resets], program.variables
    )
    fixed, t, y, inputs = form.split(variables)
    event, modes = graph.input("event", True), [inputs[i] for i in form.switched]
    rates, of_events = values[: form.y], values[form.y : form.y + events]
    T, V, *resets = values[form.y + events :]
    each = len(resets) // events

    def chosen(nodes: Sequence[int]) -> int:
        found = nodes[0]
        for i, node in enumerate(nodes[1:], 1):
            found = graph.call("select", graph.call("eq", event, graph.const(float(i))), found, node)
        return found

    c, after = chosen(of_events), [chosen(resets[i::each]) for i in range(each)]
    kept = dict(zip([*y, *modes], after[:-1], strict=True))
    energy = graph.add(T, V)
    lost = graph.sub(energy, *graph.substituted([energy], kept)) if form.transitions else graph.zero
    state, modes_after, times = after[: form.q_and_v], after[form.q_and_v : -1], [t]
    # each list is extended below by the tangents, direction by direction
    work = [graph.input(f"tangent {k} of work", True) for k in range((1 + count) * form.with_work)]
    states, tangents = tangents_of(graph, form)
    slopes = [graph.input(f"slope of input {i}", True) for i in (form.sampled if form.time_moves else ())]
    known = [dict(enumerate([*fixed, *inputs])), *tangents]
    z = [part + work[k : k + 1] for k, part in enumerate([y, *states])]
    # integrated work excludes energy stored in loads, which is added at saved times
    state += [graph.sub(W, after[-1]) for W in z[0][form.q_and_v :]]
    while (parts := len(state) // form.y) <= count:
        before = [n for part in z[:parts] for n in part]
        along = {n: dn for k in range(parts) for n, dn in zip(z[k], z[k + parts], strict=True)}
        of_known = {known[k][i]: dn for k in range(parts) for i, dn in known[k + parts].items()}
        (dc,) = derivatives(graph, [c], along | of_known)
        (c_dot,) = derivatives(
            graph, [c], dict(zip([t, *before[: form.y]], [graph.one, *rates[: form.y]], strict=True))
        )
        dt = graph.neg(graph.div(dc, c_dot))
        moved = {n: graph.add(along[n], graph.mul(rate, dt)) for n, rate in zip(before, rates, strict=True)}
        of_time = {t: dt} | {
            inputs[i]: graph.mul(slope, dt) for i, slope in zip(form.sampled, slopes, strict=False)
        }
        direction = moved | of_known | of_time
        rates_after = graph.substituted(
            rates, dict(zip([*before, *modes], [*state, *modes_after], strict=True))
        )
        moved_after = derivatives(graph, state, direction)
        state = [
            *state,
            *(graph.sub(dx, graph.mul(rate, dt)) for dx, rate in zip(moved_after, rates_after, strict=True)),
        ]
        times = [*times, *derivatives(graph, times, direction)]
        rates = [*rates, *derivatives(graph, rates, along | of_known)]
    of_known = [n for part in known[1:] for n in part.values()]
    outputs = Outputs(graph, [], [], variables, states, of_known, [], slopes)
    return Reset(outputs, event, work, state, modes_after, lost, times)


def write_reset(w: MachineWriter, form: Form) -> None:
    """Write `reset(state, tau, y, event, after)`, which stores the state after an event that happens at the
    state `y`. Rows are as in `Form.rows_of_transition`.
    """
    reset = reset_program(form)
    with w.procedure("reset", "state tau:real y event:real after") as (state, tau, y, event, after):
        for i, x in written_in_turn(
            w, reset.graph, reset.found, _given(w, form, reset, state, tau, y, event)
        ):
            w.store(as_real(w, x), after, i)


def write_reset_back(w: MachineWriter, form: Form, asked: Sequence[int]) -> None:
    """Write `pull_reset(state, tau, y, event, g, to_y, to_known)`, which pulls cotangents back through a
    reset. `g`: cotangents of the state, then of the times. In `to_known`, the cotangent of time follows those
    of the requested numbers.
    """
    reset, each = reset_program(form), form.y
    graph, (fixed, t, y, inputs) = reset.graph, form.split(reset.own.variables)
    weights = [graph.input(f"cotangent {row}", True) for row in range(form.integrated + len(reset.times))]
    z = [n for k, part in enumerate([y, *reset.own.states]) for n in [*part, *reset.work[k : k + 1]]]
    varying = [
        *z,
        *([*fixed, *inputs][i] for i in asked),
        t,
        *(inputs[i] for i in form.sampled[: len(reset.own.slopes)]),
    ]
    pulled = cotangents(graph, [*reset.state, *reset.times], weights, varying)
    first = len(z) + len(asked)
    by_time = pulled[first]
    for n, slope in zip(pulled[first + 1 :], reset.own.slopes, strict=True):
        by_time = graph.add(by_time, graph.mul(n, slope))
    assert len(z) == each * (1 + len(form.moving))
    with w.procedure("pull_reset", "state tau:real y event:real g to_y to_known") as (
        state,
        tau,
        y,
        event,
        g,
        to_y,
        to_known,
    ):
        given = _given(w, form, reset, state, tau, y, event) | {
            n: w.load(g, row) for row, n in enumerate(weights)
        }
        for i, x in written_in_turn(w, graph, [*pulled[:first], by_time], given):
            if i < len(z):
                w.store(as_real(w, x), to_y, i)
            else:
                w.store(w.load(to_known, i - len(z)) + as_real(w, x), to_known, i - len(z))


def _given(
    w: MachineWriter, form: Form, reset: Reset, state: Value, tau: Value, y: Value, event: Value
) -> dict[int, Value]:
    given = given_values(w, form, reset.own, known_values(w, form, state, tau, y), state, tau, y)
    return (
        given
        | {reset.event: event}
        | {n: w.load(y, k * form.y + form.q_and_v) for k, n in enumerate(reset.work)}
    )


def goes_on(w: StepWriter, form: Form, event: Number) -> Number:
    """Return whether a motion continues after this event."""
    found = w.literal(0, w.truth) if form.stops[0] else w.literal(1, w.truth)
    for i, stops in enumerate(form.stops):
        found = w.where(w.equal(event, float(i)), w.literal(not stops, w.truth), found) if i else found
    return found


def is_side(w: StepWriter, form: Form, event: Number) -> Number:
    """Return whether an event belongs to a relation."""
    return event > form.stated - 0.5 if form.sides else w.literal(0, w.truth)


def is_noted(w: StepWriter, form: Form, left: Number) -> Number:
    """Return whether the transition `left` of a trial step is recorded. Transitions of relations are not
    recorded.
    """
    return w.differs(left, 0.0) & ~is_side(w, form, w.magnitude(left) - 1.0)


def slowest(w: StepWriter, p: Lanes) -> Number:
    """Return the largest change over the whole motion for which a number still counts as being at rest."""
    return w.larger(RESTS * p["atol"], w.eps)


def is_left(w: StepWriter, c: Number, rate: Number, noise: Number) -> Number:
    """Return whether a value is positive beyond round-off."""
    return c > noise * w.magnitude(rate)


class Happened(NamedTuple):
    """Event after which lanes continue."""

    event: Number  # index
    t: Number
    flat: Number  # whether its value has zero slope
    quiet: Number  # whether it has no effect, because it belongs to a relation whose number is at rest
    here: Number  # lanes in which it happened
    noise: Number  # time in which a value rises by its round-off


def pass_event(w: StepWriter, form: Form, p: Lanes, y1: Number, happened: Happened, stuck: Number) -> None:
    """Store the state after an event in `y1`, and record the event and the state before.

    If a motion cannot continue, its code is stored in `stuck`: a mode is negative (a code for failed
    contacts), or a relation would change back at once.
    """
    event, t, flat, quiet, switches, noise = happened
    side = is_side(w, form, event)
    rows, of, count = form.rows, form.rows_of_transition, form.integrated
    sizes = of["t"].stop, count, len(form.monitored), form.events, form.events, form.events
    after, k, pivots, before, values, slopes = (w.room(max(n, 1)) for n in sizes)
    w.run("events", p.pointer, t, y1, y1, before, slopes)
    w.run("reset", p.pointer, t, y1, event, after)
    left = w.at(p.pointer, rows["left"].start)
    w.store(
        w.where(switches & ~quiet, w.where(flat, w.number(-1.0) - event, event + 1.0), w.load(left)), left
    )
    w.store(w.where(switches, t, w.load(left, 1)), left, 1)
    copied(w, count, y1, w.at(left, 2), switches)
    modes = w.at(p.pointer, rows["mode"].start)
    copied(w, len(form.switched), modes, w.at(left, 2 + count), switches)
    copied(w, len(form.switched), w.at(after, of["mode"].start), modes, switches)
    copied(w, form.y, after, y1, switches)

    def tangent(i: Number) -> Number:
        return w.where(switches & ~quiet, w.where(flat, math.nan, w.load(after, i)), w.load(y1, i))

    each_row(w, range(form.y, count), y1, tangent)
    number, most = p["passed"], form.transitions
    noted = [(event, "log_event", 0)] + [(w.load(modes, i), "log_mode", i) for i in range(form.modes)]
    times = [t, *(w.load(after, row) for row in of["t"][1:])]
    noted += [(w.load(after, of["lost"].start), "log_lost", 0)]
    noted += [(times[0], "log_t", 0)] + [
        (w.where(flat, math.nan, dt), "log_t", i) for i, dt in enumerate(times[1:], 1)
    ]
    for value, name, part in noted if most else ():
        w.put_at(w.at(p.pointer, rows[name].start + part * most), most, number, value, switches & ~side)
    w.run("rates", p.pointer, t, y1, k, pivots)
    w.run("events", p.pointer, t, y1, k, values, slopes)
    disarmed = []
    for i, old in enumerate(p.every("disarmed")):
        c, rate = w.load(values, i), w.load(slopes, i) * p["direction"]
        rises = (rate > 0.0) & (w.magnitude(c) <= noise * rate)
        this = w.equal(event, float(i)) & switches
        # an event whose value does not jump, as in an impact, leaves it at zero: all else is round-off
        stays = this & ~side & w.equal(c, w.load(before, i))
        left_now = switches & ~stays & is_left(w, c, rate, noise)
        off = w.where(left_now | (this & rises), 0.0, w.where(this, 1.0, old))
        disarmed.append(w.where(stays & (rate > 0.0) & ~rises, SLOWLY, off))
    p.put("disarmed", disarmed)
    for i in range(form.modes):
        mode = w.load(modes, i)
        w.store(
            w.where(
                switches & (mode < 0.0), float(result_codes.IMPACT_GAINS_ENERGY - 1) - mode, w.load(stuck)
            ),
            stuck,
        )
    for i, whole in enumerate(form.sides):
        k, mode = form.stated + i, form.modes + i
        this, rate = switches & w.equal(event, float(k)), w.load(slopes, k) * p["direction"]
        rests = w.magnitude(rate * p["last_goal"]) <= slowest(w, p)
        w.store(w.where(this & rests, 0.0, w.load(modes, mode)), modes, mode) if not whole else None
        w.store(w.where(this & ~rests & (rate < 0.0), float(result_codes.STICKS), w.load(stuck)), stuck)


def reset_back(
    w: StepWriter,
    form: Form,
    asked: int,
    state: Number,
    left: Number,
    g_t: Number,
    g: Number,
    by_known: Number,
) -> None:
    """Pull cotangents back through a transition, and restore the modes before it, in lanes where `left`
    states a transition.

    `left`: pointer to the rows with this name; `g_t`: cotangents of the transition's time and of its
    tangents.
    """
    count, of = form.integrated, form.rows_of_transition
    mark, t, z, before = w.load(left), w.load(left, 1), w.at(left, 2), w.at(left, 2 + count)
    switched, event = w.differs(mark, 0.0), w.magnitude(mark) - 1.0
    sizes = of["t"].stop, count, count, count, len(form.monitored), count + len(of["t"]), count, asked + 1
    after, f, f_after, out, pivots, given, by_event, added = (w.room(max(n, 1)) for n in sizes)
    values, rates, weights = (w.room(form.events) for _ in range(3))
    modes = w.at(state, form.rows["mode"].start)
    copied(w, len(form.switched), before, modes, switched)
    w.run("reset", state, t, z, event, after)
    w.run("rates", state, t, z, f, pivots)
    w.run("events", state, t, z, f, values, rates)
    copied(w, len(form.switched), w.at(after, of["mode"].start), modes, switched)
    w.run("rates", state, t, after, f_after, pivots)
    copied(w, len(form.switched), before, modes, switched)
    copied(w, count, g, given)
    copied(w, len(of["t"]), g_t, w.at(given, count))
    each_row(w, asked + 1, added, lambda i: 0.0)
    w.run("pull_reset", state, t, z, event, given, out, added)
    total = w.load(added, asked)
    for i in range(count):
        total = total + w.load(out, i) * w.load(f, i) - w.load(g, i) * w.load(f_after, i)
    rate = chosen(w, event, [w.load(rates, i) for i in range(form.events)])
    by_value = w.where(
        (mark < 0.0) & w.differs(total, 0.0), math.nan, w.where(w.equal(total, 0.0), 0.0, -total / rate)
    )
    for i in range(form.events):
        w.store(w.where(switched & w.equal(event, float(i)), by_value, 0.0), weights, i)
    w.run("pull_events", state, t, z, weights, by_event, added)
    each_row(w, count, g, lambda i: w.where(switched, w.load(out, i) + w.load(by_event, i), w.load(g, i)))
    each_row(w, asked, by_known, lambda i: w.load(by_known, i) + w.where(switched, w.load(added, i), 0.0))
