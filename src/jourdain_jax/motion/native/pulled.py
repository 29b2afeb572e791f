"""Cotangents through rates, projection and stop events of a lowered scene, as functions of machine code.

G_y = (df/dy)' g,   G_p += (df/dp)' g          p: those of the numbers that the rates are given which are asked for

A tangent that is pushed along belongs to the state: cotangents of a motion with its tangent are what second derivatives consist of.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from typing import NamedTuple

from jourdain_jax.calculus.derivatives import DifferentiationModeError
from jourdain_jax.motion.native.functions import Form, Outputs, given_values, known_values, outputs_of
from jourdain_jax.native.ir import Writer
from jourdain_jax.native.scalar_program import as_real, unsupported, written_in_turn
from jourdain_jax.program.derivative import cotangents, directional_derivative, on_its_own
from jourdain_jax.program.graph import Graph

# Operations of a derivative of the first order, of which reverse mode keeps some on the stack, and of the second.
LARGEST_DERIVATIVE = 10_000, 40_000


class Pulled(NamedTuple):
    """Cotangents of the state and of what is asked for, on a graph of their own."""

    own: Outputs
    found: list[int]
    weights: dict[int, int]  # row of what is pulled -> input for its cotangent

    @property
    def graph(self) -> Graph:
        """Where the nodes are."""
        return self.own.graph


def check_derivatives(form: Form, order: int) -> None:
    """Raise a DifferentiationModeError where machine code that integrates a form has no derivatives of an order."""
    if reason := reason_against_derivatives(form, order):
        raise DifferentiationModeError(f'{reason}; `jj.simulate(..., backend="xla")` has them')


@lru_cache(maxsize=64)
def reason_against_derivatives(form: Form, order: int) -> str:
    """Return why machine code that integrates a form cannot differentiate it so many times, in words; empty where it can."""
    if order > len(LARGEST_DERIVATIVE):
        return "`simulate` was differentiated three times, and machine code has derivatives of the first two orders"
    for nodes in steps_of(form).values():
        along = outputs_of(replace(form, moving=((),) * (2**order - 1)), nodes, len(nodes))
        back = pulled_program(replace(form, moving=((),) * (order - 1)), nodes, (), len(nodes))
        for graph, of_it in ((along.graph, [*along.values, *(n for part in along.tangents for n in part)]), (back.graph, back.found)):
            if reason := unsupported(graph, of_it):
                return f"machine code cannot differentiate the motion: {reason}"
            if (operations := graph.operations(of_it)) > (most := LARGEST_DERIVATIVE[order - 1]):
                return f"a derivative of a part of the motion takes {operations} operations, more than the {most} that machine code is made for"
    return ""


def write_pulled(w: Writer, form: Form, asked: Sequence[int]) -> None:
    """`pull_rates`, `pull_q`, `pull_u` and `pull_events`, each `(state, tau, y, g, to_y, to_known)`; `asked`: which of the numbers known.

    Of a state with a tangent also `pull_moved`; events are then those of the state alone.
    """
    for name, nodes in steps_of(form).items():
        _write(w, form, f"pull_{name}", pulled_program(form, nodes, asked, 0 if name == "events" else len(nodes)), work_stays=name in ("q", "u"))
    if form.moving and form.has_events:
        _write(w, form, "pull_moved", _moved(form, asked))


def steps_of(form: Form) -> dict[str, list[int]]:
    """What a step consists of: rates, all of a state after either part of a projection, stop events."""
    program, count = form.program, form.layout.coordinates
    q, u = _state_nodes(form)[:count], _state_nodes(form)[count:]
    found = {"rates": form.rates}
    if form.projects:
        found["q"] = [*program.projected_q, *u]
        found |= {"u": [*q, *program.projected_u]} if program.projected_u else {}
    return found | ({"events": list(program.events)} if form.has_events else {})


def pulled_program(form: Form, nodes: Sequence[int], asked: Sequence[int], pushed: int) -> Pulled:
    """Through nodes, the first `pushed` of them with their tangents."""
    own = outputs_of(form, nodes, pushed)
    if not form.moving:
        graph, values, variables = on_its_own(own.graph, own.values, own.variables)
        own = own._replace(graph=graph, values=values, variables=variables)
    pulled = {part * form.layout.y + i: n for part, each in enumerate([own.values, *own.tangents]) for i, n in enumerate(each)}
    weights = {row: own.graph.input(f"cotangent {row}", True) for row in pulled}
    return Pulled(own, cotangents(own.graph, pulled.values(), weights.values(), _varying(form, own, asked)), weights)


def _varying(form: Form, own: Outputs, asked: Sequence[int]) -> list[int]:
    """The nodes of the state, with its tangent, and of what is asked for."""
    first, count = len(form.program.fixed), form.layout.coordinates + form.layout.speeds
    others = [*own.variables[:first], *own.variables[first + 1 + count :]]
    return [*own.variables[first + 1 : first + 1 + count], *(n for part in own.states for n in part), *(others[i] for i in asked)]


def _moved(form: Form, asked: Sequence[int]) -> Pulled:
    """Through what a stop event adds to the tangent of a state at a number for a time, and through the tangent of its time,

        dt = -dc/cdot,   dy <- dy + f dt,   dc = dc/dy dy + dc/dp dp,   cdot = dc/dt + dc/dy f

    The row after the state is that of dt; after what is asked for comes the derivative of all along time.
    """
    nodes, layout, program = form.rates, form.layout, form.program
    own = outputs_of(form, [*nodes, *program.events], len(nodes) + layout.events)
    graph, first, count = own.graph, len(program.fixed), layout.coordinates + layout.speeds
    f, c, dc = own.values[: len(nodes)], own.values[len(nodes) :], own.tangents[0][len(nodes) :]
    along = dict(zip(own.variables[first : first + 1 + count], [graph.one, *f[:count]], strict=True))
    slopes = [rate.get(0, graph.zero) for rate in directional_derivative(graph, c, {0: along})]
    rows = [layout.integrated, *(layout.y + i for i in range(len(nodes))), layout.integrated + 1]
    to_dt, *to_dy, which = weights = [graph.input(f"cotangent {row}", True) for row in rows]
    total, rate, slope = to_dt, dc[0], slopes[0]
    for g, x in zip(to_dy, f, strict=True):
        total = graph.add(total, graph.mul(g, x))
    for i in range(1, layout.events):
        happens = graph.call("eq", which, graph.const(float(i)))
        rate, slope = graph.call("select", happens, rate, dc[i]), graph.call("select", happens, slope, slopes[i])
    by_dt = graph.neg(graph.div(graph.mul(total, rate), slope))
    times = [own.variables[first], *(own.variables[len(own.variables) - len(program.inputs) + i] for i in form.sampled)]
    found = cotangents(graph, [by_dt], [graph.one], [*_varying(form, own, asked), *times])
    by_time, *by_inputs = found[len(found) - len(times) :]
    for n, rate in zip(by_inputs, own.slopes, strict=True):
        by_time = graph.add(by_time, graph.mul(n, rate))
    return Pulled(own, [*found[: len(found) - len(times)], by_time], dict(zip(rows, weights, strict=True)))


def _state_nodes(form: Form) -> list[int]:
    first = len(form.program.fixed) + 1
    return form.program.variables[first : first + form.layout.coordinates + form.layout.speeds]


def _write(w: Writer, form: Form, name: str, pulled: Pulled, work_stays: bool = False) -> None:
    layout, each = form.layout, form.layout.coordinates + form.layout.speeds
    end = each * (1 + len(form.moving))
    with w.procedure(name, "state tau:real y g to_y to_known") as (state, tau, y, g, to_y, to_known):
        given = given_values(w, form, pulled.own, known_values(w, form, state, tau, y), state, tau, y)
        given |= {n: w.load(g, row) for row, n in pulled.weights.items()}
        for i, x in written_in_turn(w, pulled.graph, pulled.found, given):
            if i < end:
                w.store(as_real(w, x), to_y, i // each * layout.y + i % each)
            else:
                w.store(w.load(to_known, i - end) + as_real(w, x), to_known, i - end)
        for row in range(each, layout.integrated, layout.y) if layout.with_work else ():
            w.store(w.load(g, row) if work_stays else w.number(0.0), to_y, row)
