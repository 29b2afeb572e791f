"""Numbers as people write them (plain, of NumPy, in lists and tuples) serve wherever the package takes a
number or a vector.

The run-time checks of `conftest.py` are on here: what an annotation forbids fails.
"""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from small_scenes import BeadOnTurningWire
from tolerances import ROUND_OFF

import jourdain_jax as jj
from jourdain_jax.equations import (
    constraint_rows,
    gibbs_equations,
    lagrange_equations,
    partial_velocities,
    unconstrained_equations,
)

TWO = {
    "int": 2,
    "float": 2.0,
    "float32": np.float32(2),
    "float64": np.float64(2),
    "int64": np.int64(2),
    "0-d array": np.array(2.0),
    "jax": jnp.asarray(2.0),
}
THREE = {
    "list": [1, 0.0, 2],
    "tuple": (1, 0, 2),
    "array of integers": np.array([1, 0, 2]),
    "jax": jnp.array([1.0, 0.0, 2.0]),
}


def _unit(v):
    """A unit vector of the kind that `v` is."""
    return type(v)((0, 0, 1)) if isinstance(v, list | tuple) else 0 * v + np.array([0, 0, 1])


class Slider(jj.Scene):
    """A turning body and a particle, both described by plain integers."""

    mass: object = jj.parameter(2)
    coordinates = jj.coordinates("x angle")
    inputs = jj.inputs("push")

    def bodies(self, t, q):
        return {
            "block": jj.RigidBody(3, [1, 1, 2], (q.x, 0, 0), jj.rot_z(q.angle)),
            "bead": jj.Particle(1, [0, q.x, 1]),
        }

    def loads(self, motion):
        return jj.generalized_force(motion, x_rate=motion.inputs.push, angle_rate=1)


@cache
def _motion():
    return jj.motion_at(Slider(), 0, [0.3, 0.2], [1, 0.5])


BUILT = [
    "jj.rot_x(n)",
    "jj.rot_y(n)",
    "jj.rot_z(n)",
    "jj.quaternion_to_matrix(jj.quaternion_from_axis_angle(v, n))",
    "Slider(mass=n).mass",
    "jj.Particle(n, v)",
    "jj.RigidBody(n, v, v, np.eye(3).tolist())",
    'jj.RigidBody.thin_disc(n, n, axis="y", position=v, orientation=jj.rot_x(n))',
    "jj.RigidBody.ball(n, n, position=v, orientation=jj.rot_x(n))",
    'jj.RigidBody.rod(n, n, axis="y", position=v, orientation=jj.rot_x(n))',
    "jj.RigidBody.box(n, v, position=v, orientation=jj.rot_x(n))",
    "jj.gravity(_motion(), n, _unit(v))",
    'jj.spring(_motion()["block"].point(v), jj.fixed_point(v), n, n)',
    'jj.damper(_motion()["block"].point(v), jj.fixed_point(v), n)',
    'jj.torque(_motion(), "block", v)',
    'jj.point_force(_motion()["block"].point(v), v)',
    "jj.generalized_force(_motion(), x_rate=n)",
    'jj.Load(forces={"block": v}, torques={"block": v}, generalized={"x_rate": n}, potential=n)',
    'jj.knife_edge(_motion()["block"], v, v)',
    "jj.rod((0, 0, 0), v, n)",
    "jj.pin((0, 0, 0), v)",
    'jj.weld(_motion().pose()["block"], _motion().pose()["bead"], at_first=v, turn=np.eye(3).tolist())',
    "jj.Plane(v, n, v, v).height_of(v) + jj.Plane().velocity_at(v)",
    'jj.disc_contact(_motion().pose()["block"], n)',
    'jj.ball_contact(_motion().pose()["block"], n)',
    '_motion()["block"].place(v) + _motion()["block"].velocity_at(v)',
    "[jj.bounds(0, n).low, jj.bounds(0, n).high]",
    "[jj.identification.unbounded(n).scale]",
    "jj.Baumgarte(n, n)",
    "jj.Sampled([0, 1, 2], v)(n)",
    'jj.Experiment([1, 2, 3], {"x": v}, n, start={"x": n}, t0=0)',
]


@cache
def right(name):
    """What is built of an array of JAX."""
    return _built(name, jnp.asarray(2.0), jnp.array([1.0, 0.0, 2.0]))


def _built(name, n, v):
    return jax.tree.leaves(eval(name, globals() | {"n": n, "v": v}))


@pytest.mark.parametrize(
    ("number", "vector"),
    [*((number, "list") for number in TWO), *(("int", vector) for vector in list(THREE)[1:])],
)
def test_every_builder_takes_plain_numbers_and_gives_the_same_floats(number, vector):
    for name in BUILT:
        for x, y in zip(_built(name, TWO[number], THREE[vector]), right(name), strict=True):
            assert jnp.issubdtype(jnp.asarray(x).dtype, jnp.floating), name
            assert_allclose(x, y, rtol=1e-6, atol=1e-6, err_msg=name)  # float32 stays float32


STATE_FUNCTIONS = [
    "jj.accelerations(s, 0, q, u, [1]).udot",
    "jj.equations.constraint_rows(s, 0, q, u, [1]).phi",
    "jj.equations.partial_velocities(s, 0, q, u).linear",
    "jj.equations.coordinate_rates(s, 0, q, u)",
    "jj.equations.generalized_forces(s, 0, q, u, [1])",
    "jj.equations.kinetic_energy(s, 0, q, u)",
    "jj.equations.unconstrained_equations(s, 0, q, u, [1]).h",
    "jj.equations.lagrange_equations(s, 0, q, u, [1]).h",
    "jj.equations.gibbs_equations(s, 0, q, u, [1]).h",
    "jj.equations.gibbs_function(s, 0, q, u, (1, 1))",
    "jj.newton_residual(s, 0, q, u, (1, 1), [1]).linear",
    "jj.virtual_power(s, 0, q, u, (1, 1), [1, 0], [1])",
    'jj.pose_at(s, 0, q)["block"].position',
    "jj.equations.velocity_residual(s, 0, q, u)",
    "jj.equations.position_residual(s, 0, q)",
    "jj.consistent(s, 0, q, u, [1]).q",
]


@pytest.mark.parametrize("call", STATE_FUNCTIONS)
def test_a_state_may_be_a_list(call):
    def f(q, u):
        return eval(call, {"jj": jj, "s": Slider(), "q": q, "u": u})

    expected = f(jnp.array([0.0, 0.3]), jnp.array([1.0, 2.0]))
    for q, u in (([0, 0.3], (1, 2)), (np.array([0.0, 0.3]), np.array([1, 2]))):
        assert_array_equal(f(q, u), expected)


EQUATIONS = (
    jj.accelerations,
    unconstrained_equations,
    constraint_rows,
    partial_velocities,
    lagrange_equations,
    gibbs_equations,
)


def test_equations_of_numbers_are_those_of_traced_values_and_hardly_anything_is_compiled(compilations):

    class Sleigh(jj.models.ChaplyginSleigh):
        """One that nothing has been compiled for."""

    sleigh = Sleigh()
    start = jj.start(sleigh, heading=0.3, x_rate=0.5, heading_rate=0.7)
    for equations in EQUATIONS:
        compilations.clear()
        found = jax.tree.leaves(equations(sleigh, 0.0, start.q, start.u))
        assert len(compilations) <= 20, equations.__name__  # not one for every operation
        assert all(isinstance(x, jax.Array) for x in found)
        traced = jax.jit(lambda q, u, equations=equations: jax.tree.leaves(equations(sleigh, 0.0, q, u)))(
            start.q, start.u
        )
        for value, expected in zip(found, traced, strict=True):
            np.testing.assert_allclose(value, expected, rtol=ROUND_OFF, atol=1e-13)


@pytest.mark.parametrize("backend", ["native", "xla", "dense"])
def test_a_state_in_single_precision_moves_in_double(backend):
    scene, options = Slider(), {"t1": 3.0, "backend": backend}
    q, u = jnp.zeros(2, jnp.float32), jnp.array([1.0, 2.0], jnp.float32)
    motion = jj.simulate(scene, jj.consistent(scene, 0.0, q, u), **options)
    assert motion.q.dtype == jnp.float64
    assert jnp.all(motion.q_end == jj.simulate(scene, {"x_rate": 1.0, "angle_rate": 2.0}, **options).q_end)


@pytest.mark.parametrize(("precision", "backend"), [(jnp.float32, "xla"), (jnp.bfloat16, "auto")])
def test_parameters_of_less_precision_move_and_are_differentiated_as_the_same_numbers_in_double_precision(
    precision, backend
):
    def end(rate):
        return jj.simulate(
            BeadOnTurningWire(rate=rate),
            {"r": 0.5},
            ts=[0.7],
            rtol=1e-11,
            atol=1e-11,
            work=False,
            backend=backend,
        ).q_end[0]

    given = precision(1.3)
    value, slope = jax.value_and_grad(end)(given)
    assert_allclose(float(value), 0.5 * np.cosh(0.7 * float(given)), rtol=1e-10)  # r'' = rate^2 r
    assert slope.dtype == precision
    assert_allclose(float(slope), 0.35 * np.sinh(0.7 * float(given)), rtol=float(jnp.finfo(precision).eps))
