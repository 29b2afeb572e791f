"""Formal probes: what is equal at them is equal everywhere."""

import jax
import jax.numpy as jnp
import numpy as np

from jourdain_jax.program.calls import interpret_with_calls
from jourdain_jax.program.evaluate import Probes
from jourdain_jax.program.graph import Graph
from jourdain_jax.program.identity_test import equal, identity_probes, on_rows, unaffected
from jourdain_jax.program.interpret import Nodes, as_nodes

COUNT = 40


def traced(f):
    """Nodes of f(x, y, p), and generic probes that know nothing but numbers below one."""
    graph = Graph(most_multiplications=512)
    inputs = [graph.input(name, varies) for name, varies in (("q_0", True), ("q_1", True), ("p0_0", False))]
    found = interpret_with_calls(graph, jax.make_jaxpr(f)(1.0, 1.0, 1.0), [Nodes(n) for n in inputs])
    values = {graph.value[n]: np.linspace(0.1, 0.9, COUNT) for n in inputs}
    return [int(as_nodes(graph, x)[()]) for x in found], inputs, identity_probes(Probes(graph, values), ())


def test_what_is_nowhere_a_number_is_equal_to_nothing():
    (a,), _, probes = traced(lambda x, y, p: (jnp.sqrt(-1.0 - x * x),))
    assert not equal(probes([a]), probes([a]))[0]


def test_replacements_that_change_nothing_are_found_one_by_one():
    (node,), (x, y, _), probes = traced(
        lambda x, y, p: ((x + y) ** 2 - x * x - 2 * x * y + p * jnp.tanh(x - x * 1.0),)
    )
    zero = probes.graph.zero
    assert unaffected(probes, [node], {x: zero, y: zero}) == {x: zero}


def test_coordinates_are_put_onto_rows_at_generic_parameters():
    (row,), (x, y, _), probes = traced(lambda x, y, p: (x * x + y * y - p * p,))
    near = Probes(
        probes.graph, {"q_0": np.full(COUNT, 0.6), "q_1": np.full(COUNT, 0.8), "p0_0": np.ones(COUNT)}
    )
    on_circle = on_rows(probes, near, [row], {"q_0": x, "q_1": y})
    np.testing.assert_allclose(on_circle([row]), 0.0, atol=1e-11)
    assert np.ptp(on_circle.inputs["p0_0"]) > 0.5
