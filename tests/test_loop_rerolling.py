"""Repeated blocks of deep programs become loops: the same values and derivatives, and a program whose length does not grow with the chain."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jourdain_jax.program import emit, loop_rerolling
from jourdain_jax.program.graph import Graph
from jourdain_jax.program.loop_rerolling import Before, Given, Loop, deepest_first, with_loops

LINKS = 120


def chain(links: int):
    """A recursion outwards, one back inwards over its results, and a sum over both; every link has its own length and angle.

    v_i = v_{i-1} cos(a_i - a_{i-1}) + l_i sin(v_{i-1}),   w_i = (v_i - w_{i+1})/(2 + w_{i+1}^2),   s = sum v_i w_i
    """
    graph = Graph()
    lengths = [graph.input(f"l{i}", False) for i in range(links)]
    angles = [graph.input(f"a{i}", True) for i in range(links)]
    v = [graph.one]
    for i in range(links):
        turned = graph.call("cos", graph.sub(angles[i], angles[i - 1] if i else graph.zero))
        v.append(graph.add(graph.mul(v[-1], turned), graph.mul(lengths[i], graph.call("sin", v[-1]))))
    w = [graph.one]
    for x in reversed(v[1:]):
        w.append(graph.div(graph.sub(x, w[-1]), graph.add(graph.const(2.0), graph.mul(w[-1], w[-1]))))
    total = graph.total(graph.mul(x, y) for x, y in zip(v[1:], reversed(w[1:]), strict=True))
    return graph, [*lengths, *angles], [*v[1:], *w[1:], total]


def by_hand(values):
    lengths, angles = jnp.split(values, 2)
    turns = jnp.diff(angles, axis=0, prepend=jnp.zeros_like(angles[:1]))
    one = jnp.ones(values.shape[1:], values.dtype)
    outwards = jax.lax.scan(lambda v, x: ((new := v * jnp.cos(x[1]) + x[0] * jnp.sin(v)), new), one, (lengths, turns))[1]
    inwards = jax.lax.scan(lambda w, v: ((new := (v - w) / (2 + w**2)), new), one, outwards[::-1])[1]
    return jnp.concatenate([outwards, inwards, jnp.sum(outwards * inwards[::-1], axis=0)[None]])


@pytest.fixture(scope="module")
def program():
    graph, inputs, outputs = chain(LINKS)
    return lambda values: jnp.stack(emit.run(graph, outputs, dict(zip(inputs, values, strict=True))))


@pytest.fixture(scope="module")
def values():
    return jnp.asarray(np.random.default_rng(0).uniform(0.1, 0.5, 2 * LINKS))


def loops_of(links: int) -> list[Loop]:
    graph, inputs, outputs = chain(links)
    order = [n for n in deepest_first(graph, outputs, inputs) if not graph.is_const(n)]
    parts = with_loops(graph, order)
    assert sorted(n for part in parts for n in (part.nodes.ravel().tolist() if isinstance(part, Loop) else part)) == sorted(order)
    return [part for part in parts if isinstance(part, Loop)]


def test_recursions_and_sums_are_found():
    loops = loops_of(LINKS)
    assert len(loops) == 3
    assert all(len(loop.nodes) >= LINKS - 3 for loop in loops)
    assert sum(len(loop.ops) for loop in loops) < 20
    slots = [slot for arguments in loops[0].arguments for slot in arguments]
    assert any(isinstance(s, Before) for s in slots)
    assert any(isinstance(s, Given) and len(set(s.nodes)) == len(loops[0].nodes) for s in slots)


def test_a_short_program_stays_in_a_row():
    assert loops_of(30) == []


def test_values_are_those_of_the_recursion(program, values):
    np.testing.assert_allclose(jax.jit(program)(values), by_hand(values), rtol=1e-13)


def test_batches_are_those_of_single_lanes(program, values):
    lanes = values * jnp.linspace(0.9, 1.1, 5)[:, None]
    expected = by_hand(lanes.T)
    np.testing.assert_allclose(jax.jit(program)(lanes.T), expected, rtol=1e-13)  # lanes last
    np.testing.assert_allclose(jax.jit(jax.vmap(program))(lanes).T, expected, rtol=1e-13)


def test_derivatives_are_those_of_the_recursion(program, values):
    along = jnp.cos(jnp.arange(2.0 * LINKS))
    forward = [jax.jit(lambda x, f=f: jax.jvp(f, (x,), (along,))[1])(values) for f in (program, by_hand)]
    np.testing.assert_allclose(*forward, rtol=1e-11, atol=1e-11)
    reverse = [jax.jit(jax.grad(lambda x, f=f: jnp.sum(jnp.sin(f(x)))))(values) for f in (program, by_hand)]
    np.testing.assert_allclose(*reverse, rtol=1e-11, atol=1e-11)


def test_numbers_may_be_given_for_arrays(values):
    graph, inputs, outputs = chain(LINKS)
    found = emit.run(graph, outputs, dict(zip(inputs, values.tolist(), strict=True)))
    np.testing.assert_allclose(jnp.stack([jnp.asarray(x) for x in found]), by_hand(values), rtol=1e-13)


def test_single_precision_stays_so(program, values):
    found = jax.jit(program)(values.astype(jnp.float32))
    assert found.dtype == jnp.float32
    np.testing.assert_allclose(found, by_hand(values), rtol=2e-4)


def test_the_program_does_not_grow_with_the_chain_but_for_what_enters_and_leaves():
    def arithmetic(links):
        graph, inputs, outputs = chain(links)
        run = jax.make_jaxpr(lambda values: emit.run(graph, outputs[-1:], dict(zip(inputs, values, strict=True))))(jnp.ones(2 * links))
        return sum(str(run).count(f" {name} ") for name in ("mul", "add", "sub", "div", "cos", "sin"))

    assert arithmetic(240) <= 1.1 * arithmetic(120)


def test_what_does_not_repeat_makes_no_loop(monkeypatch):
    monkeypatch.setattr(loop_rerolling, "WORTHWHILE", 0)
    graph = Graph()
    x = end = graph.input("x", True)
    for op in np.random.default_rng(1).choice(["add", "mul", "sin", "cos", "sub"], 600):
        end = graph.call(op, end) if op in ("sin", "cos") else graph.call(op, end, x)
    order = [n for n in deepest_first(graph, [end], [x]) if not graph.is_const(n)]
    assert with_loops(graph, order) == [order]
