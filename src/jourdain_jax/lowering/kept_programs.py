"""Scalar programs as text, and back: of the graph only the nodes that the program needs, so that it is the same whether it was kept or built just now."""

from dataclasses import fields

import numpy as np

from jourdain_jax.build.trace import Variables
from jourdain_jax.calculus.plain_text import as_text, from_text
from jourdain_jax.lowering.lowered import Lowered, Stage
from jourdain_jax.program.graph import Graph
from jourdain_jax.program.part import part

_NODES = ("qdot", "ydot", "z", "pivots", "sizes", "guards", "events", "energies", "projected_q", "projected_u", "fixed")  # fields that are tuples of nodes
_OTHERS = {"traced", "power", "stages", "usual", "states"}


def program_as_text(found: Lowered) -> bytes:
    """The program as text; nothing where it calls parts of JAX, which have none."""
    graph, of, power = found.graph, found.traced, [] if found.power is None else [found.power]
    variables = [of.t, *of.q.tolist(), *of.u.tolist(), *of.inputs.tolist(), *(n for x in of.parameters for n in x.ravel().tolist())]
    outputs = [n for name in _NODES for n in getattr(found, name)]
    needed = [*variables, *outputs, *power, *found.usual, *found.usual.values(), *found.states]
    if graph.calls(needed):
        return b""
    rows, nodes = part(graph, needed)
    place = nodes.tolist()
    told = {f.name: getattr(found, f.name) for f in fields(found) if f.name not in _OTHERS}
    told |= {name: tuple(place[n] for n in told[name]) for name in _NODES}
    told["power"] = None if found.power is None else place[found.power]
    told["stages"] = [(stage.name, stage.operations) for stage in found.stages]
    told["usual"] = {place[a]: place[b] for a, b in found.usual.items()}
    told["states"] = {place[n]: x for n, x in found.states.items()}
    return as_text([rows, place[of.t], nodes[of.q], nodes[of.u], nodes[of.inputs], [np.asarray(nodes[x]) for x in of.parameters], told])


def program_from_text(text: bytes) -> Lowered:
    """The program."""
    rows, t, q, u, inputs, parameters, told = from_text(text)
    variables = Variables(Graph.of_rows(rows), t, q, u, inputs, list(parameters))
    return Lowered(traced=variables, **told | {"stages": tuple(Stage(*stage) for stage in told["stages"])})
