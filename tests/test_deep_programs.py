"""Programs with long chains of operations run in pieces: the same values and derivatives, and no work done many times over."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

from jourdain_jax.program import emit
from jourdain_jax.program.graph import Graph

LINKS = 30


def logistic(length: int):
    """x <- a x (1 - x) + sin x, some hundred operations deep; every value is used by several others."""
    graph = Graph()
    a, x = graph.input("a", False), graph.input("x", True)
    end = x
    for _ in range(length):
        end = graph.add(graph.mul(a, graph.mul(end, graph.sub(graph.one, end))), graph.mul(graph.const(0.1), graph.call("sin", end)))
    return graph, a, x, end


def by_hand(a, x, length):
    for _ in range(length):
        x = a * (x * (1 - x)) + 0.1 * jnp.sin(x)
    return x


def test_values_and_derivatives_of_a_deep_program_are_those_of_the_plain_one():
    length = emit.DEEP
    graph, a, x, end = logistic(length)
    assert emit._depth(graph, graph.needed([end], {a, x})) > emit.DEEP

    def program(a_value, x_value):
        return emit.run(graph, [end, x], {a: a_value, x: x_value})[0]

    lanes = jnp.linspace(0.1, 0.8, 5)
    for run in (program, lambda a, x: by_hand(a, x, length)):
        assert jax.eval_shape(run, 2.0, lanes).shape == (5,)
    expected = by_hand(2.0, lanes, length)
    assert_allclose(jax.jit(program)(2.0, lanes), expected, rtol=1e-12)
    assert_allclose(jax.jit(jax.vmap(program, (None, 0)))(2.0, lanes), expected, rtol=1e-12)
    slopes = [jax.jit(jax.vmap(jax.grad(f), (None, 0)))(2.0, lanes) for f in (program, lambda a, x: by_hand(a, x, length))]
    assert_allclose(*slopes, rtol=1e-11)
    forward = jax.jit(lambda a: jax.jvp(lambda a: program(a, lanes), (a,), (1.0,))[1])(2.0)
    assert_allclose(forward, slopes[1], rtol=1e-11)


def test_pieces_are_kept_apart_in_the_compiled_program():
    graph, a, x, end = logistic(emit.DEEP)
    compiled = jax.jit(lambda v: emit.run(graph, [end], {a: 2.0, x: v})[0]).lower(jnp.ones(4)).compile().as_text()
    assert compiled.count("reduce(") >= emit.DEEP // emit.PIECE


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


def recursed(values):
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


def test_batches_are_those_of_single_lanes(program, values):
    lanes = values * jnp.linspace(0.9, 1.1, 5)[:, None]
    expected = recursed(lanes.T)
    assert_allclose(jax.jit(program)(lanes.T), expected, rtol=1e-13)  # lanes last
    assert_allclose(jax.jit(jax.vmap(program))(lanes).T, expected, rtol=1e-13)


def test_numbers_may_be_given_for_arrays(values):
    graph, inputs, outputs = chain(LINKS)
    found = emit.run(graph, outputs, dict(zip(inputs, values.tolist(), strict=True)))
    assert_allclose(jnp.stack([jnp.asarray(x) for x in found]), recursed(values), rtol=1e-13)


def test_single_precision_stays_so(program, values):
    found = jax.jit(program)(values.astype(jnp.float32))
    assert found.dtype == jnp.float32
    assert_allclose(found, recursed(values), rtol=2e-4)
