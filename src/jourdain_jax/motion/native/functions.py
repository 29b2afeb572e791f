"""Rates, projection and stop events of a lowered scene as functions of machine code: of the rows of lanes, time since the start, and a state in memory."""

from dataclasses import dataclass
from typing import NamedTuple

from jourdain_jax.lowering.jacobian import on_its_own
from jourdain_jax.lowering.lowered import Lowered
from jourdain_jax.motion.native.layout import Lanes, Layout
from jourdain_jax.native.ir import Value, Writer
from jourdain_jax.native.scalar_program import as_real, written
from jourdain_jax.program.derivative import directional_derivative
from jourdain_jax.program.graph import Graph

INLINED = 120  # operations: so few are written anew at each stage


@dataclass(frozen=True)
class Form:
    """What is integrated: a lowered scene, with or without work, projection, events and pivots that are watched."""

    program: Lowered
    with_work: bool
    projects: bool
    affine: bool
    has_events: bool
    has_pivots: bool

    @property
    def layout(self) -> Layout:
        """The rows of a lane."""
        program = self.program
        known = len(program.fixed) + len(program.inputs)
        return Layout(len(program.qdot), len(program.ydot), self.with_work, known, len(program.events) if self.has_events else 0)

    @property
    def pivots(self) -> int:
        """How many are watched."""
        return len(self.program.pivots) if self.has_pivots else 0

    @property
    def nodes(self) -> list[int]:
        """All that is evaluated."""
        program = self.program
        projected = [*program.projected_q, *program.projected_u] if self.projects else []
        events = program.events if self.has_events else ()
        power = [program.power] if self.with_work and program.power is not None else []
        return [*program.qdot, *program.ydot, *power, *program.guards, *program.pivots, *projected, *events]


def _known(w: Writer, form: Form, state: Value, tau: Value, y: Value) -> dict[int, Value]:
    """Values of all nodes that are given from outside."""
    program, layout, lanes = form.program, form.layout, Lanes(w, form.layout, state)
    states = [w.load(w.real, y, k) for k in range(layout.coordinates + layout.speeds)]
    known, fixed = lanes.every("known"), len(program.fixed)
    return dict(zip(program.variables, [*known[:fixed], lanes["origin"] + tau, *states, *known[fixed:]], strict=True))


def write_rates(w: Writer, form: Form) -> None:
    """`rates(state, tau, y, k, pivots)`: the rates of the state `y` into `k`, and the pivots relative to their usual sizes."""
    program, layout = form.program, form.layout
    how = "alwaysinline" if program.operations <= INLINED else "noinline"
    arguments = {"state": "ptr", "tau": w.real, "y": "ptr", "k": "ptr", "pivots": "ptr"}
    with w.function("rates", "void", arguments, attributes=how) as (state, tau, y, k, pivots):
        power = [program.power] if form.with_work and program.power is not None else []
        outputs = [*program.qdot, *program.ydot, *power, *program.guards, *program.pivots[: form.pivots]]
        known = _known(w, form, state, tau, y)
        found = [as_real(w, x) for x in written(w, program.graph, outputs, known)]
        if form.with_work and not power:
            found.insert(layout.coordinates + layout.speeds, w.number(0.0))
        for guard in found[layout.y : layout.y + len(program.guards)]:
            found[0] = w.where(guard > 0.0, found[0], float("nan"))
        for i in range(layout.y):
            w.store(found[i], k, i)
        for i in range(form.pivots):
            w.store(found[layout.y + len(program.guards) + i] / known[program.sizes[i]], pivots, i)
        w.give()


def write_projection(w: Writer, form: Form) -> None:
    """`project(state, tau, y)`: puts the state `y` back onto the rows."""
    program, layout = form.program, form.layout
    with w.function("projected_once", "void", {"state": "ptr", "tau": w.real, "y": "ptr", "q_moves": "i1"}, attributes="noinline") as (state, tau, y, q_moves):
        known = _known(w, form, state, tau, y)
        with w.when(q_moves):
            for i, x in enumerate(written(w, program.graph, program.projected_q, known)):
                w.store(as_real(w, x), y, i)
        with w.when(~q_moves):
            for i, x in enumerate(written(w, program.graph, program.projected_u, known)):
                w.store(as_real(w, x), y, layout.coordinates + i)
        w.give()
    with w.function("project", "void", {"state": "ptr", "tau": w.real, "y": "ptr"}) as (state, tau, y):
        for moves in [1, 1] + [0] * (0 if not program.projected_u else 1 if form.affine else 2):
            w.call("projected_once", "void", state, tau, y, w.literal(moves, "i1"))
        w.give()


class EventProgram(NamedTuple):
    """Stop events with their rates, on a graph of its own."""

    graph: Graph
    values: list[int]
    rates: list[int]
    variables: list[int]  # for those of the scene's program
    slopes: list[int]  # inputs for the rates of the state


def event_program(form: Form) -> EventProgram:
    """dc/dt = sum dc/dx_i dx_i/dt; `Unsupported` where an operation has no derivative on the graph."""
    program, moving = form.program, form.layout.coordinates + form.layout.speeds
    graph, events, variables = on_its_own(program.graph, program.events, program.variables)
    slopes = [graph.input(f"rate {i}", True) for i in range(moving)]
    first = len(program.fixed)  # time, then the state
    direction = dict(zip(variables[first : first + 1 + moving], [graph.one, *slopes], strict=True))
    rates = [rate.get(0, graph.zero) for rate in directional_derivative(graph, events, {0: direction})]
    return EventProgram(graph, events, rates, variables, slopes)


def write_events(w: Writer, form: Form) -> None:
    """`events(state, tau, y, slope, c, rate)`: the values of all stop events of the state `y`, and their rates where `y` changes at the rate `slope`."""
    own, count = event_program(form), form.layout.events
    arguments = {"state": "ptr", "tau": w.real, "y": "ptr", "slope": "ptr", "c": "ptr", "rate": "ptr"}
    with w.function("events", "void", arguments, attributes="noinline") as (state, tau, y, slope, c, rate):
        known = dict(zip(own.variables, _known(w, form, state, tau, y).values(), strict=True))
        known |= {n: w.load(w.real, slope, i) for i, n in enumerate(own.slopes)}
        found = [as_real(w, x) for x in written(w, own.graph, [*own.values, *own.rates], known)]
        for i in range(count):
            w.store(found[i], c, i)
            w.store(found[count + i], rate, i)
        w.give()
