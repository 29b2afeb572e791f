"""Nodes with few products of what varies: equal to those before, and how many products they take."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

import jourdain_jax as jj
from jourdain_jax.program.emit import run
from jourdain_jax.program.graph import Graph
from jourdain_jax.program.products import with_few_products


def products(graph: Graph, nodes) -> int:
    """Products, quotients and functions of what varies."""
    varying = [n for n in graph.reachable(nodes) if graph.varies[n]]
    free = ("input", "add", "sub", "neg")
    return sum(graph.op[n] not in free and not (graph.op[n] == "mul" and not all(graph.varies[a] for a in graph.args[n])) for n in varying)


@pytest.mark.parametrize(("name", "before", "after"), [("tilting-disc", 18, 13), ("chaplygin-sleigh", 10, 9), ("double-pendulum-angles", 20, 16)])
def test_models_take_fewer_products(name, before, after):
    program = jj.lower(jj.models.MODELS[name]())
    graph, first = Graph(), len(program.fixed)
    inputs = [graph.input(str(k), k >= first) for k in range(len(program.variables))]
    copied = graph.copied([*program.qdot, *program.ydot], program.graph, dict(zip(program.variables, inputs, strict=True)))
    rates = [copied[n] for n in (*program.qdot, *program.ydot)]
    assert products(graph, rates) == before
    few = with_few_products(graph, rates)
    assert products(graph, few) <= after
    values = dict(zip(inputs, np.random.default_rng(0).uniform(0.2, 0.9, len(inputs)), strict=True))
    old, new = (np.array([float(x) for x in run(graph, nodes, values)]) for nodes in (rates, few))
    assert_allclose(new, old, rtol=1e-13)


@pytest.mark.parametrize("seed", range(12))
def test_random_programs_keep_their_values(seed):
    random, graph = np.random.default_rng(seed), Graph()
    inputs = [graph.input(f"x{k}", True) for k in range(4)] + [graph.input(f"p{k}", False) for k in range(2)]
    nodes = [*inputs, graph.const(-1.7), graph.zero]
    for _ in range(60):
        op = str(random.choice(["add", "sub", "mul", "mul", "mul", "div", "neg", "sin", "cos", "sqrt"]))
        a, b = (nodes[i] for i in random.integers(len(nodes), size=2))
        if op == "sqrt":
            a = graph.add(graph.const(2.0), graph.mul(a, a))
        if op == "div":
            b = graph.add(graph.const(3.0), graph.call("sin", b))
        nodes.append(graph.call(op, *((a, b) if op in ("add", "sub", "mul", "div") else (a,))))
        if graph.operations([nodes[-1]]) > 25:  # numbers stay of usual size
            nodes[-1] = graph.call("sin", nodes[-1])
    outputs = [*nodes[-12:], *nodes[:10], *nodes[-5:]]
    few = with_few_products(graph, outputs)
    assert products(graph, few) <= products(graph, outputs)
    values = dict(zip(inputs, random.uniform(0.5, 1.5, len(inputs)), strict=True))
    old, new = (np.array([float(x) for x in run(graph, nodes, values)]) for nodes in (outputs, few))
    assert_allclose(new, old, rtol=1e-11, atol=1e-11)


def test_what_cancels_or_does_not_vary_is_left():
    graph = Graph()
    x, y, p = graph.input("x", True), graph.input("y", True), graph.input("p", False)
    square = graph.mul(graph.add(x, y), graph.add(x, y))
    difference = graph.sub(square, graph.mul(graph.add(x, y), graph.add(y, x)))
    expanded = graph.sub(graph.mul(x, graph.add(y, p)), graph.mul(x, y))  # p x
    found = with_few_products(graph, [graph.one, p, x, difference, expanded])
    assert found == [graph.one, p, x, graph.zero, graph.mul(p, x)]
