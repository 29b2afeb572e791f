"""Programs with long chains of operations run in pieces: the same values and derivatives, and no work done
many times over.
"""

import jax
import jax.numpy as jnp
import numpy as np
from numpy.testing import assert_allclose

from jourdain_jax.program import emit
from jourdain_jax.program.graph import Graph

LINKS = 30


def chain(links):
    """A recursion outwards, one back inwards over its results, and a sum over both; every link has its own
    length and angle.

    v_i = v_{i-1} cos(a_i - a_{i-1}) + l_i sin(v_{i-1}), w_i = (v_i - w_{i+1})/(2 + w_{i+1}^2), s = sum v_i
    w_i
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


@jax.jit
def recursed(values):
    lengths, angles = jnp.split(values, 2)
    turns = jnp.diff(angles, axis=0, prepend=jnp.zeros_like(angles[:1]))
    one = jnp.ones(values.shape[1:], values.dtype)
    outwards = jax.lax.scan(
        lambda v, x: ((new := v * jnp.cos(x[1]) + x[0] * jnp.sin(v)), new), one, (lengths, turns)
    )[1]
    inwards = jax.lax.scan(lambda w, v: ((new := (v - w) / (2 + w**2)), new), one, outwards[::-1])[1]
    return jnp.concatenate([outwards, inwards, jnp.sum(outwards * inwards[::-1], axis=0)[None]])


GRAPH, INPUTS, OUTPUTS = chain(LINKS)
VALUES = np.random.default_rng(0).uniform(0.1, 0.5, 2 * LINKS)
LANES = VALUES * np.linspace(0.9, 1.1, 5)[:, None]


def program(values):
    return jnp.stack(emit.run(GRAPH, OUTPUTS, dict(zip(INPUTS, values, strict=True))))


def test_batches_are_those_of_single_lanes():
    assert len(GRAPH.needed(OUTPUTS, set(INPUTS))) > emit.DEEP
    assert jax.eval_shape(program, LANES.T).shape == (len(OUTPUTS), 5)
    expected = recursed(LANES.T)
    assert_allclose(jax.jit(program)(LANES.T), expected, rtol=1e-13)  # lanes last
    assert_allclose(jax.jit(jax.vmap(program))(LANES).T, expected, rtol=1e-13)


def test_derivatives_of_a_deep_program_are_those_of_the_plain_one():
    weights = jnp.sin(jnp.arange(len(OUTPUTS)))
    found, expected = (
        jax.jit(jax.vmap(jax.grad(lambda values, f=f: weights @ f(values))))(LANES)
        for f in (program, recursed)
    )
    assert_allclose(found, expected, rtol=1e-10, atol=1e-12)
    forward = jax.jit(lambda x: jax.jvp(program, (x,), (x,))[1])(VALUES)
    assert_allclose(weights @ forward, jax.grad(lambda x: weights @ recursed(x))(VALUES) @ VALUES, rtol=1e-10)


def test_pieces_are_kept_apart_in_the_compiled_program():
    compiled = jax.jit(program).lower(VALUES).compile().as_text()
    assert compiled.count("reduce(") >= emit.DEEP // emit.PIECE


def test_numbers_may_be_given_for_arrays():
    found = emit.run(GRAPH, OUTPUTS, dict(zip(INPUTS, VALUES.tolist(), strict=True)))
    assert_allclose(found, recursed(VALUES), rtol=1e-13)


def test_single_precision_stays_so():
    found = jax.jit(program)(VALUES.astype(jnp.float32))
    assert found.dtype == jnp.float32
    assert_allclose(found, recursed(VALUES), rtol=2e-4)
