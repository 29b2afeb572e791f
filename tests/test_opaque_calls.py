"""Loads and stop events with a part that has no scalar form: that part stays a call of JAX, everything else
is lowered.
"""

from collections.abc import Callable
from itertools import pairwise

import equinox as eqx
import jax
import jax.flatten_util
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose
from refusals import refused
from small_scenes import OnLine

import jourdain_jax as jj
from jourdain_jax.equations.gibbs_appell import accelerations_of, minimal_kinematics
from jourdain_jax.models import ChaplyginSleigh
from jourdain_jax.program.calls import interpret_with_calls
from jourdain_jax.program.evaluate import Probes
from jourdain_jax.program.graph import Graph
from jourdain_jax.program.interpret import Nodes, as_nodes


def by_table(force, numbers):
    """A force over speed, in a table."""
    return jnp.interp(force, jnp.linspace(-2.0, 2.0, 9), numbers)


def by_iteration(x, numbers):
    """The root of v^3 + v = x, by Newton's method."""
    newton = lambda v: v - (v**3 + v - x) / (3 * v * v + 1)
    return numbers[0] * jax.lax.while_loop(
        lambda v: jnp.abs(newton(v) - v) > 8 * jnp.finfo(v.dtype).eps * (1 + jnp.abs(v)),
        newton,
        jnp.zeros_like(x),
    )


def by_recursion(x, numbers):
    """A filter of a few stages."""
    return jax.lax.scan(lambda y, c: (jnp.tanh(y + c * x), y), 0.1 * x, numbers)[0]


def by_branches(x, numbers):
    """Another law on either side, and in every range."""
    side = jax.lax.cond(x > 0, lambda x: numbers[0] * x, lambda x: numbers[1] * x**2, x)
    return jax.lax.switch(
        jnp.int32(2 + jnp.floor(side)), [lambda x: x, jnp.sin, lambda x: 2.0 * x, jnp.cos], side
    )


def by_network(x, numbers):
    """Two hidden layers of 32."""
    y = jnp.stack([x, x**2])
    for k, (weights, biases) in enumerate(numbers):
        y = weights @ (jax.nn.softplus(y) if k else y) + biases
    return (y * jnp.array([1.0, 0.5])).sum()


def layers(*sizes):
    random = np.random.default_rng(0)
    return [
        (random.uniform(-1, 1, (m, n)) / np.sqrt(n), random.uniform(-0.5, 0.5, m)) for n, m in pairwise(sizes)
    ]


def by_matrix(x, numbers):
    """A table of 40,000 numbers, one of them zero."""
    return numbers[0] * jnp.mean(jnp.sin(jnp.arange(40_000.0)).reshape(200, 200) @ jnp.sin(x * jnp.ones(200)))


def by_asking(x, numbers):
    """A function in Python, of which no derivative is known."""
    return jax.pure_callback(
        lambda x: -np.sin(x), jax.ShapeDtypeStruct(x.shape, x.dtype), x, vmap_method="expand_dims"
    )


@jax.custom_jvp
def _asked(x):
    return by_asking(x, None)


_asked.defjvp(lambda x, dx: (_asked(*x), -jnp.cos(x[0]) * dx[0]))


def by_asking_with_rule(x, numbers):
    """A function in Python with its derivative, to any order."""
    return numbers[0] * _asked(x)


class Acted(ChaplyginSleigh):
    """A sleigh under a force along the blade that is some law of its forward speed."""

    law: Callable = eqx.field(static=True, default=by_table)
    numbers: object = eqx.field(default_factory=lambda: 0.1 * np.arange(9.0) ** 2)

    def loads(self, motion):
        sleigh = motion["sleigh"]
        along = sleigh.orientation[:, 0]
        return jj.point_force(
            sleigh.point(jnp.zeros(3)), self.law(sleigh.velocity @ along, self.numbers) * along
        )


LAWS = {
    "table": (Acted(), "the operation `scan`"),
    "iteration": (Acted(law=by_iteration, numbers=np.array([0.3])), "the operation `while`"),
    "recursion": (Acted(law=by_recursion, numbers=np.linspace(0.2, 0.5, 4)), "the operation `scan`"),
    "branches": (
        Acted(law=by_branches, numbers=np.array([0.3, -0.2])),
        "an integer that depends on the state",
    ),
    "network": (
        Acted(law=by_network, numbers=layers(2, 32, 32, 2)),
        "a matrix product with 1024 multiplications",
    ),
    "matrix": (Acted(law=by_matrix, numbers=np.array([2.0])), "a matrix product with 39999 multiplications"),
    "callback": (Acted(law=by_asking, numbers=np.array([2.0])), "the operation `pure_callback`"),
    "callback with a rule": (
        Acted(law=by_asking_with_rule, numbers=np.array([2.0])),
        "`_asked`, which has a custom derivative",
    ),
}
SMOOTH_ENOUGH = ["table", "callback with a rule", "network", "recursion", "branches"]


def rates_of(scene):
    """The rates of a state (q, y) by the program and by the dense path, for scenes of this class."""
    program, rows = jj.lower(scene), jj.structure_of(scene).kept_rows

    def by_program(scene, q, y):
        qdot, ydot, _ = program.rates(
            program.fixed_values(scene), jnp.zeros(()), tuple(q), tuple(y), jnp.zeros(0)
        )
        return jnp.stack([*qdot, *ydot])

    def dense(scene, q, y):
        known = minimal_kinematics(scene, program.independent, rows, jnp.zeros(()), q, y)
        motion, found = accelerations_of(scene, known, jnp.zeros(()), q)
        return jnp.concatenate([motion.qdot.array, found.udot[np.array(program.independent)]])

    return by_program, dense


def states_of(scene, count):
    _, q, u = jj.sample_states(scene, count)
    return jnp.asarray(q), jnp.asarray(u[:, np.array(jj.lower(scene).independent)])


@pytest.mark.parametrize("name", LAWS)
def test_only_the_part_without_a_scalar_form_is_kept_and_the_rates_are_those_of_the_dense_path(name):
    scene, reason = LAWS[name]
    program = jj.lower(scene)
    assert len(program.calls) == len(program.graph.calls([*program.ydot, program.power])) == 1
    assert all(reason in call for call in program.calls)
    assert program.operations <= 60
    assert f"kept as a JAX call, without scalar form: {program.calls[0]}" in str(program)
    (by_program, dense), (q, y) = rates_of(scene), states_of(scene, 5)
    expected = jax.jit(jax.vmap(lambda q, y: dense(scene, q, y)))(q, y)
    assert_allclose(
        jax.jit(jax.vmap(lambda q, y: by_program(scene, q, y)))(q, y), expected, rtol=1e-12, atol=1e-12
    )
    lanes_last = jax.jit(lambda q, y: by_program(scene, q, y))(q.T, y.T)
    assert_allclose(lanes_last.T, expected, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("name", SMOOTH_ENOUGH)
def test_derivatives_through_a_call_are_those_of_the_dense_path(name):
    scene = LAWS[name][0]
    functions, (q, y) = rates_of(scene), states_of(scene, 1)
    flat, rebuilt = jax.flatten_util.ravel_pytree((scene, q[0], y[0]))
    v = jnp.cos(jnp.arange(len(flat)))

    def derivatives(f):
        of = lambda x: f(*rebuilt(x))
        total = lambda x: jnp.sum(jnp.sin(of(x)))
        return jax.jit(
            lambda x: (
                jax.jvp(of, (x,), (v,))[1],
                jax.grad(total)(x),
                jax.jvp(jax.grad(total), (x,), (v,))[1],
            )
        )(flat)

    (along, gradient, second), expected = map(derivatives, functions)
    assert_allclose(along, expected[0], rtol=1e-10, atol=1e-10)
    assert_allclose(gradient, expected[1], rtol=1e-10, atol=1e-10)
    assert_allclose(second, expected[2], rtol=1e-9, atol=1e-9)
    assert np.any(gradient[: len(flat) - len(q[0]) - len(y[0])][3:] != 0)  # by the numbers of the law


def test_an_iteration_has_derivatives_in_forward_mode_and_the_same_error_as_densely_in_reverse():
    scene = LAWS["iteration"][0]
    (by_program, dense), (q, y) = rates_of(scene), states_of(scene, 1)
    assert_allclose(
        *(jax.jit(jax.jacfwd(lambda y, f=f: f(scene, q[0], y)))(y[0]) for f in (by_program, dense)),
        rtol=1e-10,
        atol=1e-10,
    )
    for f in (by_program, dense):
        refused(
            "Reverse-mode differentiation does not work",
            jax.make_jaxpr(jax.jacrev(lambda y, f=f: f(scene, q[0], y))),
            y[0],
        )


class Effective(OnLine):
    """A load that prints."""

    def loads(self, motion):
        jax.debug.callback(lambda x: None, motion.q.x)
        return jj.generalized_force(motion, x_rate=-motion.q.x)


def test_a_load_with_effects_is_not_taken_out_of_its_place():
    with pytest.raises(jj.NotLowered, match="the operation `debug_callback`"):
        jj.lower(Effective())


class FarWall(Effective):
    """A spring by a table that is flat in the whole domain, and not beyond."""

    def loads(self, motion):
        return jj.generalized_force(
            motion,
            x_rate=jnp.interp(
                motion.q.x, jnp.array([-20.0, -10.0, 10.0, 20.0]), jnp.array([50.0, 0.0, 0.0, -50.0])
            ),
        )


def test_what_a_call_depends_on_is_not_left_out_though_no_probe_shows_it():
    scene = FarWall()
    program = jj.lower(scene)
    assert program.held == ()
    fixed = program.fixed_values(scene)
    _, ydot, _ = jax.jit(lambda x: program.rates(fixed, 0.0, (x,), (0.0 * x,), jnp.zeros(0)))(15.0)
    assert_allclose(ydot, [-25.0])


def test_the_report_and_the_summary_say_what_is_kept_and_why_and_printed_sources_refuse_it():
    scene = LAWS["iteration"][0]
    program = jj.lower(scene)
    said = jj.report(scene).lowering
    why = (
        "the operation `while` has no scalar form: kept as a call; not to machine code: a part of it is kept"
        " as a JAX call"
    )
    assert said == f"a scalar program of {program.operations} operations; {why}"
    for printed in (program.python_source, program.c_source):
        refused(r"calls of JAX \(the operation `while`\) cannot be written as source", printed)


# On the graph.


def in_parts(f, *like):
    graph = Graph()
    inputs = [
        Nodes(np.array([graph.input(f"{k}_{i}", True) for i in range(np.size(x))]).reshape(np.shape(x)))
        for k, x in enumerate(like)
    ]
    return graph, [as_nodes(graph, x) for x in interpret_with_calls(graph, jax.make_jaxpr(f)(*like), inputs)]


def test_parts_that_are_apart_are_calls_of_their_own_in_the_right_order():
    def f(x):
        first = by_iteration(x[0], jnp.ones(1))
        between = jnp.sin(first) * x[1] + jnp.sort(x)[1]  # a scalar between two iterations
        return by_iteration(between, jnp.ones(1)) + first, by_iteration(x[0], jnp.ones(1))

    graph, nodes = in_parts(f, np.zeros(3))
    flat = [int(n) for n in nodes]
    assert len(graph.calls(flat)) == 3  # sorting, and two iterations: the third is the first again
    x = np.random.default_rng(0).normal(size=(7, 3))
    values = Probes(graph, {f"0_{i}": x[:, i] for i in range(3)})(flat)
    assert_allclose(values, np.stack(jax.vmap(f)(x)), rtol=1e-12)


def test_functions_that_differ_in_a_constant_are_not_one_call():
    def f(x):
        table = lambda values: jnp.asarray(values)[jnp.int32(x)]
        return table([1.0, 2.0, 3.0]) + 10 * table([1.0, 2.0, 4.0])

    graph, (node,) = in_parts(f, 0.0)
    assert_allclose(Probes(graph, {"0_0": np.array([0.0, 1.0, 2.0])})([int(node)])[0], [11.0, 22.0, 43.0])
