"""Derivatives by machine code of our own: against closed forms, against those of XLA, of lanes that end in
all ways, and when they are left to XLA.
"""

import ctypes

import jax
import jax.numpy as jnp
import machine_code
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import jourdain_jax as jj
from jourdain_jax.program import emit
from jourdain_jax.program.derivative import cotangents
from jourdain_jax.program.graph import Graph

pytestmark = machine_code.needed


@pytest.mark.parametrize("seed", range(6))
def test_cotangents_of_a_program_are_those_of_jax(seed):
    random, graph = np.random.default_rng(seed), Graph()
    inputs = [graph.input(f"x{i}", True) for i in range(4)]
    nodes = list(inputs)
    for _ in range(40):
        a, b = (int(nodes[i]) for i in random.integers(len(nodes), size=2))
        op = str(
            random.choice(
                ["add", "sub", "mul", "div", "sin", "cos", "tanh", "sqrt", "neg", "atan2", "max", "select"]
            )
        )
        more = graph.add(graph.const(2.0), graph.mul(b, b))
        given = {"select": (graph.call("lt", a, b), a, b), "div": (a, more), "sqrt": (more,)}
        two = (a, b) if op in ("add", "sub", "mul", "atan2", "max") else (a,)
        nodes.append(graph.call(op, *given.get(op, two)))
    outputs, weights = nodes[-5:], [graph.input(f"w{i}", True) for i in range(5)]
    at, g = jnp.split(jnp.asarray(random.normal(size=9)), [4])
    run = lambda outputs, x: jnp.stack(
        emit.run(graph, outputs, dict(zip([*inputs, *weights], x, strict=False)))
    )
    _, back = jax.vjp(lambda x: run(outputs, x), at)
    found = run(cotangents(graph, outputs, weights, inputs), [*at, *g])
    assert_allclose(found, back(g)[0], rtol=1e-11, atol=1e-13)


def test_a_branch_that_is_not_taken_has_no_cotangent_however_steep_it_is():
    graph = Graph()
    x, w = graph.input("x", True), graph.input("w", True)
    root = graph.call("select", graph.call("gt", x, graph.zero), graph.zero, graph.call("sqrt", x))
    (found,) = emit.run(graph, cotangents(graph, [root], [w], [x]), {x: jnp.zeros(()), w: jnp.ones(())})
    assert found == 0.0


RECORDS: list[int] = []  # bytes of each that was taken
SIGNATURE = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.c_size_t, ctypes.c_size_t)


@SIGNATURE
def _counted(alignment, size):
    RECORDS.append(size)
    return _taken(alignment, size)


_taken = SIGNATURE(("aligned_alloc", ctypes.CDLL(None)))


def _largest_record(memory):
    """Gradients of motions of some hundred steps, and how many bytes their largest record takes."""
    model = jj.build(jj.models.TiltingDisc(), backend="native", memory=memory)

    def seen(lean, radius):
        start = {"lean": lean, "yaw_rate": 1.0, "spin_rate": 5.0}
        times = {"ts": jnp.linspace(0.1, 4.0, 40), "rtol": 1e-10, "atol": 1e-10}
        return jnp.sin(jj.simulate(model.replace(radius=radius), start, **times).q).sum()

    RECORDS.clear()
    each = jax.grad(seen, (0, 1))
    found = jax.jit(jax.vmap(each))(*np.linspace([0.1, 0.3], [0.4, 0.6], 11).T)
    return np.array(found), max(RECORDS)


def test_records_of_reverse_mode_keep_to_the_memory_of_the_model(monkeypatch):
    from llvmlite import binding as llvm

    monkeypatch.setenv("JOURDAIN_JAX_THREADS", "1")
    llvm.add_symbol("aligned_alloc", ctypes.cast(_counted, ctypes.c_void_p).value)
    try:
        whole, needed = _largest_record(10**9 + 11)
        for memory in (needed, needed // 20):  # half of it is there too where a record has grown
            found, most = _largest_record(memory)
            assert 0.2 * memory < 1.5 * most <= memory
            assert_array_equal(found, whole)
    finally:
        llvm.add_symbol("aligned_alloc", ctypes.cast(_taken, ctypes.c_void_p).value)
