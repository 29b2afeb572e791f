"""Rates, projection and events of a lowered scene in machine code: functions of the rows of the lanes, the
time since the start, and a state in memory.

If the state has tangents, each function also computes the tangents of its results. Further functions compute
cotangents:

    d f(t, y, p) = df/dy dy + df/dp dp          p: known numbers; those of `Form.moving` have tangents
    G_y = (df/dy)' g,   G_p += (df/dp)' g       g: cotangents of f; for the requested p

Second derivatives have tangents of all these numbers along a second direction. In reverse mode, they are
cotangents of a motion with its tangents.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from typing import NamedTuple

from jourdain_jax.calculus.derivative_errors import DifferentiationModeError
from jourdain_jax.integrate.loop.form import Form
from jourdain_jax.integrate.loop.lanes import Lanes, MachineWriter, stated
from jourdain_jax.integrate.loop.samples import looked_up
from jourdain_jax.kernels.ir import Value
from jourdain_jax.kernels.scalar_program import as_real, unsupported, written, written_in_turn
from jourdain_jax.program.derivative import cotangents, derivatives, on_its_own
from jourdain_jax.program.graph import Graph, NodeList


class Outputs(NamedTuple):
    """Nodes and their tangents, on a separate graph if there are tangents."""

    graph: Graph
    values: NodeList
    tangents: list[NodeList]  # one list per tangent
    variables: NodeList  # variables of the scene's program
    # input nodes:
    states: list[NodeList]  # tangents of the state
    known: NodeList  # tangents of known numbers, ordered by direction
    times: NodeList  # tangents of time
    slopes: NodeList  # time derivatives of sampled inputs


def tangents_of(graph: Graph, form: Form) -> tuple[list[NodeList], list[dict[int, int]]]:
    """Return new input nodes for each tangent: those of coordinates and speeds, and those of known numbers by
    index.
    """
    tangent = lambda k, of: graph.input(f"tangent {k} of {of}", True)
    every = range(len(form.moving))
    states = [[tangent(k, f"state {i}") for i in range(form.q_and_v)] for k in every]
    return states, [{i: tangent(k, f"number {i}") for i in form.moving[k]} for k in every]


def outputs_of(form: Form, nodes: Sequence[int], pushed: int) -> Outputs:
    """Return nodes, with tangents of the first `pushed` of them."""
    program, count = form.program, len(form.moving)
    if not count:
        return Outputs(program.graph, list(nodes), [], program.variables, [], [], [], [])
    graph, values, variables = on_its_own(program.graph, nodes, program.variables)
    fixed, t, y, inputs = form.split(variables)
    states, known = tangents_of(graph, form)
    times = [graph.input(f"tangent {k} of time", True) for k in range(count if form.time_moves else 0)]
    slopes = [graph.input(f"slope of input {i}", True) for i in (form.sampled if form.time_moves else ())]
    sampled = {len(y) + len(fixed) + i: n for i, n in zip(form.sampled, slopes, strict=False)}
    # the varying quantities, then the tangents of each direction, by index in this order
    given = [dict(enumerate([*y, *fixed, *inputs, t]))]
    for k in range(count):
        of_time = (
            {len(variables) - 1: times[k]} | {i: graph.mul(n, times[k]) for i, n in sampled.items()}
            if times
            else {}
        )
        given.append(dict(enumerate(states[k])) | {len(y) + i: n for i, n in known[k].items()} | of_time)
    found = [values[:pushed]]
    while len(found) <= count:
        direction = {given[k][i]: n for k in range(len(found)) for i, n in given[k + len(found)].items()}
        rates = derivatives(graph, [n for part in found for n in part], direction)
        found += [rates[k * pushed : (k + 1) * pushed] for k in range(len(found))]
    of_known = [n for part in known for n in part.values()]
    return Outputs(graph, values, found[1:], variables, states, of_known, times, slopes)


def _found(
    w: MachineWriter, form: Form, own: Outputs, known: dict[int, Value], state: Value, tau: Value, y: Value
) -> tuple[list[Value], list[list[Value]]]:
    """Return the values of outputs and of their tangents. `known`: result of `known_values`."""
    given = given_values(w, form, own, known, state, tau, y)
    found = [
        as_real(w, x)
        for x in written(w, own.graph, [*own.values, *(n for part in own.tangents for n in part)], given)
    ]
    tangents = iter(found[len(own.values) :])
    return found[: len(own.values)], [[next(tangents) for _ in part] for part in own.tangents]


def given_values(
    w: MachineWriter, form: Form, own: Outputs, known: dict[int, Value], state: Value, tau: Value, y: Value
) -> dict[int, Value]:
    """Return the values of the input nodes of outputs. `known`: result of `known_values`."""
    given, lanes = dict(zip(own.variables, known.values(), strict=True)), Lanes(w, form, state)
    for k, states in enumerate(own.states):
        given |= {n: w.load(y, (k + 1) * form.y + i) for i, n in enumerate(states)}
    given |= dict(zip(own.known, stated(w, lanes, "dknown"), strict=True)) if own.known else {}
    given |= dict(zip(own.times, lanes.every("dt"), strict=True)) if own.times else {}
    given |= (
        dict(zip(own.slopes, looked_up(w, form, state, tau, True)[len(form.sampled) :], strict=True))
        if own.slopes
        else {}
    )
    return given


def known_values(w: MachineWriter, form: Form, state: Value, tau: Value, y: Value) -> dict[int, Value]:
    """Return the values of all input nodes of the program."""
    program, lanes = form.program, Lanes(w, form, state)
    states = [w.load(y, k) for k in range(form.q_and_v)]
    known, fixed, t = stated(w, lanes, "known"), len(program.fixed), lanes["origin"] + tau
    found = (
        dict(zip(form.sampled, looked_up(w, form, state, tau, form.time_moves), strict=False))
        if form.sampled
        else {}
    )
    found |= dict(zip(form.switched, lanes.every("mode"), strict=True))
    inputs = [found.get(i, x) for i, x in enumerate(known[fixed:])]
    return dict(zip(program.variables, [*known[:fixed], t, *states, *inputs], strict=True))


def write_rates(w: MachineWriter, form: Form) -> None:
    """Write `rates(state, tau, y, k, pivots)`, which stores the rates of the state `y` in `k`, and the
    monitored quantities, pivots first, in `pivots`.
    """
    program = form.program
    # small programs are inlined at each stage
    how = "alwaysinline" if program.operations <= 120 else "noinline"
    arguments = {"state": "ptr", "tau": w.real, "y": "ptr", "k": "ptr", "pivots": "ptr"}
    with w.function("rates", "void", arguments, attributes=how) as (state, tau, y, k, pivots):
        known = known_values(w, form, state, tau, y)
        outputs = outputs_of(form, [*form.rates, *program.guards, *form.monitored], form.y)
        found, tangents = _found(w, form, outputs, known, state, tau, y)
        for guard in found[form.y : form.y + len(program.guards)]:
            found[0] = w.where(guard > 0.0, found[0], float("nan"))
        for i, x in enumerate([*found[: form.y], *(x for part in tangents for x in part)]):
            w.store(x, k, i)
        for i, x in enumerate(found[form.y + len(program.guards) :]):
            w.store(x, pivots, i)
        w.give()


def write_projection(w: MachineWriter, form: Form) -> None:
    """Write `project(state, tau, y)`, which projects the state `y` onto the constraints."""
    program = form.program
    with w.procedure("projected_once", "state tau:real y q_moves:i1") as (state, tau, y, q_moves):
        known = known_values(w, form, state, tau, y)
        for condition, nodes, first in (
            (q_moves, program.projected_q, 0),
            (~q_moves, program.projected_u, form.coordinates),
        ):
            with w.when(condition):
                found, tangents = _found(w, form, outputs_of(form, nodes, len(nodes)), known, state, tau, y)
                for k, part in enumerate([found, *tangents]):
                    for i, x in enumerate(part):
                        w.store(x, y, k * form.y + first + i)
    with w.function("project", "void", {"state": "ptr", "tau": w.real, "y": "ptr"}) as (state, tau, y):
        for q_moves in form.moves:
            w.run("projected_once", state, tau, y, w.literal(q_moves, "i1"))
        w.give()
    if form.squares:
        _write_along(w, form)


def _write_along(w: MachineWriter, form: Form) -> None:
    """Write `along(state, tau, y)`, which projects the error of a state, stored after it, onto the directions
    that the constraints allow, because the projection of the state removes the rest.
    """
    program, moved = form.program, replace(form, moving=((),), time_moves=False)
    with w.procedure("along", "state tau:real y") as (state, tau, y):
        for nodes, first in ((program.projected_q, 0), (program.projected_u, form.coordinates)):
            known = known_values(w, form, state, tau, y)
            _, (tangent,) = _found(w, form, outputs_of(moved, nodes, len(nodes)), known, state, tau, y)
            for i, x in enumerate(tangent):
                w.store(x, y, form.y + first + i)


@lru_cache(maxsize=64)
def event_program(form: Form) -> Outputs:
    """Return events and their rates, as functions of a state and its rates. Raises `Unsupported` for
    operations that have no derivative on the graph.

        dc/dt = sum dc/dx_i dx_i/dt
    """
    graph, events, variables = on_its_own(form.program.graph, form.program.events, form.program.variables)
    _, t, y, _ = form.split(variables)
    slopes = [graph.input(f"rate {i}", True) for i in range(len(y))]
    rates = derivatives(graph, events, dict(zip([t, *y], [graph.one, *slopes], strict=True)))
    return Outputs(graph, events, [rates], variables, [slopes], [], [], [])


def write_events(w: MachineWriter, form: Form) -> None:
    """Write `events(state, tau, y, slope, c, rate)`, which stores the values c of all events for the state
    `y`, and their rates if `y` changes at the rate `slope`.
    """
    program, own, count = form.program, event_program(form), form.events
    with w.procedure("events", "state tau:real y slope c rate") as (state, tau, y, slope, c, rate):
        known = dict(zip(own.variables, known_values(w, form, state, tau, y).values(), strict=True))
        known |= {n: w.load(slope, i) for i, n in enumerate(own.states[0])}
        found = [as_real(w, x) for x in written(w, own.graph, [*own.values, *own.tangents[0]], known)]
        for i in range(count):
            w.store(found[i], c, i)
            w.store(found[count + i], rate, i)
    if form.moving:
        with w.procedure("event_tangents", "state tau:real y dc") as (state, tau, y, dc):
            _, tangents = _found(
                w,
                form,
                outputs_of(form, program.events, count),
                known_values(w, form, state, tau, y),
                state,
                tau,
                y,
            )
            for i, x in enumerate(x for part in tangents for x in part):
                w.store(x, dc, i)


# limits on operations of first and second derivatives: reverse mode keeps some values on the stack
LARGEST_DERIVATIVE = 10_000, 40_000  # tuning


class Pulled(NamedTuple):
    """Cotangents of the state and of the requested numbers, on a separate graph."""

    own: Outputs
    found: NodeList
    weights: dict[int, int]  # input node for the cotangent of a result, by row of the result

    @property
    def graph(self) -> Graph:
        """Return the graph."""
        return self.own.graph


def check_derivatives(form: Form, order: int) -> None:
    """Raise DifferentiationModeError if machine code cannot compute derivatives of this order for a form."""
    if reason := reason_against_derivatives(form, order):
        raise DifferentiationModeError(f'{reason}; use `jj.simulate(..., backend="xla")`')


@lru_cache(maxsize=64)
def reason_against_derivatives(form: Form, order: int) -> str:
    """Return why machine code cannot compute derivatives of this order for a form; empty if it can."""
    if order > len(LARGEST_DERIVATIVE):
        return (
            "`simulate` was differentiated three times, but machine code has only first and second"
            " derivatives"
        )
    for nodes in steps_of(form).values():
        along = outputs_of(replace(form, moving=((),) * (2**order - 1)), nodes, len(nodes))
        back = pulled_program(replace(form, moving=((),) * (order - 1)), nodes, (), len(nodes))
        for graph, of_it in (
            (along.graph, [*along.values, *(n for part in along.tangents for n in part)]),
            (back.graph, back.found),
        ):
            if reason := unsupported(graph, of_it):
                return f"machine code cannot differentiate the motion: {reason}"
            if (operations := graph.operations(of_it)) > (most := LARGEST_DERIVATIVE[order - 1]):
                return (
                    f"a derivative of a part of the motion takes {operations} operations, more than the"
                    f" {most} of machine code"
                )
    return ""


def write_pulled(w: MachineWriter, form: Form, asked: Sequence[int]) -> None:
    """Write `pull_rates`, `pull_q`, `pull_u` and `pull_events`, each with the arguments `(state, tau, y, g,
    to_y, to_known)`, which pull cotangents back. `asked`: indices of the requested known numbers.

    If the state has a tangent, also write `pull_moved`; `pull_events` then treats events as functions of the
    state without tangents.
    """
    for name, nodes in steps_of(form).items():
        _write_one_pulled(
            w,
            form,
            f"pull_{name}",
            pulled_program(form, nodes, asked, 0 if name == "events" else len(nodes)),
            work_stays=name in ("q", "u"),
        )
    if form.moving and form.has_events:
        _write_one_pulled(w, form, "pull_moved", _moved(form, asked))


def steps_of(form: Form) -> dict[str, NodeList]:
    """Return the nodes of the parts of a step: rates, the whole state after each part of a projection, and
    events.
    """
    program, (_, _, y, _) = form.program, form.split(form.program.variables)
    q, u = y[: form.coordinates], y[form.coordinates :]
    found = {"rates": form.rates}
    if form.projects:
        found["q"] = [*program.projected_q, *u]
        found |= {"u": [*q, *program.projected_u]} if program.projected_u else {}
    return found | ({"events": list(program.events)} if form.has_events else {})


def pulled_program(form: Form, nodes: Sequence[int], asked: Sequence[int], pushed: int) -> Pulled:
    """Return the cotangents pulled back through nodes; the first `pushed` nodes have tangents."""
    own = outputs_of(form, nodes, pushed)
    if not form.moving:
        graph, values, variables = on_its_own(own.graph, own.values, own.variables)
        own = own._replace(graph=graph, values=values, variables=variables)
    pulled = {
        part * form.y + i: n
        for part, each in enumerate([own.values, *own.tangents])
        for i, n in enumerate(each)
    }
    weights = {row: own.graph.input(f"cotangent {row}", True) for row in pulled}
    return Pulled(
        own, cotangents(own.graph, pulled.values(), weights.values(), _varying(form, own, asked)), weights
    )


def _varying(form: Form, own: Outputs, asked: Sequence[int]) -> NodeList:
    """Return the nodes of the state, of its tangents, and of the requested known numbers."""
    fixed, _, y, inputs = form.split(own.variables)
    return [*y, *(n for part in own.states for n in part), *([*fixed, *inputs][i] for i in asked)]


def _moved(form: Form, asked: Sequence[int]) -> Pulled:
    """Return the cotangents pulled back through the effect of an event on the tangents of its time and of the
    state at a fixed time:

        dt = -dc/cdot,   dy <- dy + f dt,   dc = dc/dy dy + dc/dp dp,   cdot = dc/dt + dc/dy f

    The row after the state contains the cotangent of dt. The last result is the derivative with respect to
    time.
    """
    nodes = form.rates
    own = outputs_of(form, [*nodes, *form.program.events], len(nodes) + form.events)
    graph, (_, t, y, inputs) = own.graph, form.split(own.variables)
    f, c, dc = own.values[: len(nodes)], own.values[len(nodes) :], own.tangents[0][len(nodes) :]
    slopes = derivatives(graph, c, dict(zip([t, *y], [graph.one, *f[: len(y)]], strict=True)))
    rows = [form.integrated, *(form.y + i for i in range(len(nodes))), form.integrated + 1]
    to_dt, *to_dy, which = weights = [graph.input(f"cotangent {row}", True) for row in rows]
    total, rate, slope = to_dt, dc[0], slopes[0]
    for g, x in zip(to_dy, f, strict=True):
        total = graph.add(total, graph.mul(g, x))
    for i in range(1, form.events):
        happens = graph.call("eq", which, graph.const(float(i)))
        rate = graph.call("select", happens, rate, dc[i])
        slope = graph.call("select", happens, slope, slopes[i])
    by_dt = graph.neg(graph.div(graph.mul(total, rate), slope))
    times = [t, *(inputs[i] for i in form.sampled)]
    found = cotangents(graph, [by_dt], [graph.one], [*_varying(form, own, asked), *times])
    by_time, *by_inputs = found[len(found) - len(times) :]
    for n, rate in zip(by_inputs, own.slopes, strict=True):
        by_time = graph.add(by_time, graph.mul(n, rate))
    return Pulled(own, [*found[: len(found) - len(times)], by_time], dict(zip(rows, weights, strict=True)))


def _write_one_pulled(
    w: MachineWriter, form: Form, name: str, pulled: Pulled, work_stays: bool = False
) -> None:
    each = form.q_and_v
    end = each * (1 + len(form.moving))
    with w.procedure(name, "state tau:real y g to_y to_known") as (state, tau, y, g, to_y, to_known):
        given = given_values(w, form, pulled.own, known_values(w, form, state, tau, y), state, tau, y)
        given |= {n: w.load(g, row) for row, n in pulled.weights.items()}
        for i, x in written_in_turn(w, pulled.graph, pulled.found, given):
            if i < end:
                w.store(as_real(w, x), to_y, i // each * form.y + i % each)
            else:
                w.store(w.load(to_known, i - end) + as_real(w, x), to_known, i - end)
        for row in range(each, form.integrated, form.y) if form.with_work else ():
            w.store(w.load(g, row) if work_stays else w.number(0.0), to_y, row)
