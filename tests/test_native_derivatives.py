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
from small_scenes import Cart

import jourdain_jax as jj
from jourdain_jax.program import emit
from jourdain_jax.program.derivative import cotangents
from jourdain_jax.program.graph import Graph

pytestmark = machine_code.needed


class Oscillator(Cart):
    """A particle on a spring with a constant push, and a wall at x = -wall."""

    damping: float = jj.parameter(0.0)
    wall: object = jj.parameter(0.8)

    def events(self, motion):
        return {"wall": self.wall + motion.q.x}


X = np.array([1.5, 6.0, 0.8, 1.1, 0.7, 0.3])  # mass, stiffness, wall, x, its rate, push


def _ends(x):
    """Two states on the way and at the wall, the time of the end."""
    scene, start = Oscillator(mass=x[0], stiffness=x[1], wall=x[2]), {"x": x[3], "x_rate": x[4]}
    options = {"ts": jnp.array([0.0, 0.3, 0.9]), "t1": 3.0, "rtol": 1e-11, "atol": 1e-11}
    motion = jj.simulate(scene, start, inputs={"push": x[5]}, backend="native", **options)
    return jnp.stack([motion.q[1, 0], motion.u[2, 0], motion.q_end[0], motion.u_end[0], motion.t_end])


def _exact(x, end=None):
    """x = c + A cos(w t - phase) about c = push/stiffness; at the wall the cosine is -(wall + c)/A."""
    w, centre = jnp.sqrt(x[1] / x[0]), x[5] / x[1]
    a, b = x[3] - centre, x[4] / w

    def at(t):
        return centre + a * jnp.cos(w * t) + b * jnp.sin(w * t), w * (b * jnp.cos(w * t) - a * jnp.sin(w * t))

    if end is None:
        end = (jnp.arctan2(b, a) + jnp.arccos(-(x[2] + centre) / jnp.hypot(a, b))) / w
    return jnp.stack([at(0.3)[0], at(0.9)[1], *at(end), end])


def test_cotangents_of_lanes_are_those_of_the_closed_form_and_do_not_depend_on_their_company():
    lanes = X * (1 + 0.05 * np.random.default_rng(0).normal(size=(11, 6)))
    every = jax.jit(jax.vmap(jax.grad(lambda x: jnp.sum(_ends(x)))))
    expected = np.asarray(every(lanes))
    assert_allclose(expected, jax.vmap(jax.grad(lambda x: jnp.sum(_exact(x))))(lanes), rtol=1e-9, atol=1e-9)
    for count in (3, 9):  # fewer than a register holds, and one more than the widest
        order = np.random.default_rng(count).permutation(11)[:count]
        assert_allclose(every(lanes[order]), expected[order], rtol=1e-13, atol=1e-14)


@pytest.mark.parametrize("derivative", [jax.jacrev, jax.jacfwd])
def test_derivatives_pass_through_motions_one_after_the_other(derivative):
    """One compiled step, called with numbers of which other ones vary each time."""
    options = {"inputs": {"push": X[5]}, "rtol": 1e-11, "atol": 1e-11}
    step = jax.jit(lambda scene, state, until: jj.simulate(scene, state, t1=until, **options).end)

    def late(stiffness):
        scene = Oscillator(mass=X[0], stiffness=stiffness, wall=10.0)
        state = jj.start(scene, x=X[3], x_rate=X[4])
        for until in (0.5, 0.9, 3.0):
            state = step(scene, state, jnp.asarray(until))
        return jnp.concatenate([state.q, state.u])

    exact = jax.jacfwd(lambda k: _exact(jnp.asarray(X).at[1].set(k), 3.0)[2:4])
    assert_allclose(derivative(late)(X[1]), exact(X[1]), rtol=1e-8)


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


def _largest_record(memory, lanes):
    """Gradients of motions of some hundred steps, and how many bytes their largest record takes."""
    model = jj.build(jj.models.TiltingDisc(), backend="native", memory=memory)

    def seen(lean, radius):
        start = {"lean": lean, "yaw_rate": 1.0, "spin_rate": 5.0}
        times = {"ts": jnp.linspace(0.1, 4.0, 40), "rtol": 1e-10, "atol": 1e-10}
        return jnp.sin(jj.simulate(model.replace(radius=radius), start, **times).q).sum()

    RECORDS.clear()
    each = jax.grad(seen, (0, 1))
    x = np.linspace([0.1, 0.3], [0.4, 0.6], lanes).T
    found = jax.jit(jax.vmap(each))(*x) if lanes > 1 else jax.jit(each)(*x[:, 0])
    return np.array(found), max(RECORDS)


@pytest.mark.parametrize("lanes", [1, 11])
def test_records_of_reverse_mode_keep_to_the_memory_of_the_model(monkeypatch, lanes):
    llvm = pytest.importorskip("llvmlite.binding")
    monkeypatch.setenv("JOURDAIN_JAX_THREADS", "1")
    llvm.add_symbol("aligned_alloc", ctypes.cast(_counted, ctypes.c_void_p).value)
    try:
        whole, needed = _largest_record(10**9 + lanes, lanes)
        for memory in (needed, needed // 20):  # half of it is there too where a record has grown
            found, most = _largest_record(memory, lanes)
            assert 0.2 * memory < 1.5 * most <= memory
            assert_array_equal(found, whole)
    finally:
        llvm.add_symbol("aligned_alloc", ctypes.cast(_taken, ctypes.c_void_p).value)
