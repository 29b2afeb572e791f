"""Programs with long chains of operations run in pieces: the same values and derivatives, and no work done many times over."""

import jax
import jax.numpy as jnp
import numpy as np

from jourdain_jax.program import emit
from jourdain_jax.program.graph import Graph


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
    np.testing.assert_allclose(jax.jit(program)(2.0, lanes), expected, rtol=1e-12)
    np.testing.assert_allclose(jax.jit(jax.vmap(program, (None, 0)))(2.0, lanes), expected, rtol=1e-12)
    slopes = [jax.jit(jax.vmap(jax.grad(f), (None, 0)))(2.0, lanes) for f in (program, lambda a, x: by_hand(a, x, length))]
    np.testing.assert_allclose(*slopes, rtol=1e-11)
    forward = jax.jit(lambda a: jax.jvp(lambda a: program(a, lanes), (a,), (1.0,))[1])(2.0)
    np.testing.assert_allclose(forward, slopes[1], rtol=1e-11)


def test_pieces_are_kept_apart_in_the_compiled_program():
    graph, a, x, end = logistic(emit.DEEP)
    compiled = jax.jit(lambda v: emit.run(graph, [end], {a: 2.0, x: v})[0]).lower(jnp.ones(4)).compile().as_text()
    assert compiled.count("reduce(") >= emit.DEEP // emit.PIECE
