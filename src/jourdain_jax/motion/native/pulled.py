"""Cotangents through rates, projection and stop events of a lowered scene, as functions of machine code.

G_y = (df/dy)' g,   G_p += (df/dp)' g          p: those of the numbers that the rates are given which are asked for
"""

from collections.abc import Sequence

from jourdain_jax.lowering.jacobian import on_its_own
from jourdain_jax.motion.native.functions import Form, known_values
from jourdain_jax.native.ir import Writer
from jourdain_jax.native.scalar_program import as_real, written_in_turn
from jourdain_jax.program.derivative import cotangents
from jourdain_jax.program.graph import Graph

_ARGUMENTS = ("state", "tau", "y", "g", "to_y", "to_known")


def rates_of(form: Form) -> list[int]:
    """The nodes whose values are the rates of the state; that of the work may be zero, and is left out then."""
    program = form.program
    return [*program.qdot, *program.ydot, *([program.power] if form.with_work and program.power is not None else [])]


def write_pulled(w: Writer, form: Form, asked: Sequence[int]) -> None:
    """`pull_rates`, `pull_q`, `pull_u` and `pull_events`, each `(state, tau, y, g, to_y, to_known)`; `asked`: which of the numbers known."""
    for name, nodes in steps_of(form).items():
        _write(w, form, f"pull_{name}", nodes, asked, work_stays=name in ("q", "u"))


def steps_of(form: Form) -> dict[str, list[int]]:
    """What a step consists of: rates, all of a state after either part of a projection, stop events."""
    program, count = form.program, form.layout.coordinates
    q, u = _state_nodes(form)[:count], _state_nodes(form)[count:]
    found = {"rates": rates_of(form)}
    if form.projects:
        found["q"] = [*program.projected_q, *u]
        found |= {"u": [*q, *program.projected_u]} if program.projected_u else {}
    return found | ({"events": list(program.events)} if form.has_events else {})


def pulled_program(form: Form, nodes: Sequence[int], asked: Sequence[int]) -> tuple[Graph, list[int], list[int], list[int]]:
    """A program on a graph of its own: the cotangents of the state and of what is asked for, the variables, and inputs for the cotangents of the nodes."""
    program, first = form.program, len(form.program.fixed) + 1
    graph, values, variables = on_its_own(program.graph, nodes, program.variables)
    weights = [graph.input(f"cotangent {i}", True) for i in range(len(nodes))]
    count = form.layout.coordinates + form.layout.speeds
    others = [*variables[: first - 1], *variables[first + count :]]
    return graph, cotangents(graph, values, weights, [*variables[first : first + count], *(others[i] for i in asked)]), variables, weights


def _state_nodes(form: Form) -> list[int]:
    first = len(form.program.fixed) + 1
    return form.program.variables[first : first + form.layout.coordinates + form.layout.speeds]


def _write(w: Writer, form: Form, name: str, nodes: Sequence[int], asked: Sequence[int], work_stays: bool = False) -> None:
    graph, found, variables, weights = pulled_program(form, nodes, asked)
    count, work = form.layout.coordinates + form.layout.speeds, form.layout.with_work
    with w.function(name, "void", dict.fromkeys(_ARGUMENTS, "ptr") | {"tau": w.real}, attributes="noinline") as (state, tau, y, g, to_y, to_known):
        given = dict(zip(variables, known_values(w, form, state, tau, y).values(), strict=True))
        given |= {n: w.load(w.real, g, i) for i, n in enumerate(weights)}
        for i, x in written_in_turn(w, graph, found, given):
            if i < count:
                w.store(as_real(w, x), to_y, i)
            else:
                w.store(w.load(w.real, to_known, i - count) + as_real(w, x), to_known, i - count)
        if work:
            w.store(w.load(w.real, g, count) if work_stays else w.number(0.0), to_y, count)
        w.give()
