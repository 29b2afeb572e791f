"""Rows by machine code as functions that JAX differentiates, and named starts that they are put onto."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import result_codes as results
from jax.flatten_util import ravel_pytree
from numpy.testing import assert_allclose

import jourdain_jax as jj
from jourdain_jax import structure_of
from jourdain_jax.build.held_values import may_contradict
from jourdain_jax.build.row_program import row_program
from jourdain_jax.eager.eager import eval_numpy
from jourdain_jax.equations.projection import BY_AUTODIFF
from jourdain_jax.motion.row_functions import row_functions
from jourdain_jax.native import ffi
from jourdain_jax.program import interpret

needs_llvmlite = pytest.mark.skipif(bool(ffi.reason_against()), reason=ffi.reason_against() or "-")


class Driven(jj.Scene):
    """A rod on a floor that moves, with a row that an input turns: rows of time and inputs, a quaternion, and a mass matrix that is full."""

    length: jnp.ndarray = jj.parameter(0.7, positive=True)
    moments: jnp.ndarray = jj.parameter(jnp.array([0.3, 0.5, 0.4]), unit="kg m^2")

    coordinates = jj.coordinates("x y", jj.quaternion("attitude"))
    inputs = jj.inputs("turn")

    def bodies(self, t, q):
        R = jj.quaternion_to_matrix(q.attitude)
        return {"rod": jj.RigidBody(1.5, self.moments, jnp.stack([q.x, q.y, 0.3 * jnp.sin(t) * q.x]) + self.length * R[:, 2], R)}

    def geometric_constraints(self, pose):
        return {"height": pose["rod"].position[2] - 0.5 * jnp.cos(pose.t)}

    def velocity_constraints(self, motion):
        rod = motion["rod"]
        return {"edge": rod.velocity @ rod.orientation[:, 1] - motion.inputs.turn * self.length}


@needs_llvmlite
@pytest.mark.parametrize(
    ("scene", "order"),
    [(Driven(), 1), (jj.models.DoublePendulumRods(), 2), pytest.param(Driven(), 2, marks=pytest.mark.slow)],
    ids=["driven", "pendulum of rods", "driven, second order"],
)
def test_rows_by_machine_code_have_the_derivatives_of_the_scenes_own(scene, order):
    program, generator = row_program(scene), np.random.default_rng(0)
    numbers, restored = ravel_pytree(jax.tree.map(jnp.asarray, scene))
    sizes = [1, len(scene.coordinate_names), len(scene.speed_names), len(scene.inputs)]
    x = jnp.concatenate([numbers, generator.normal(size=sum(sizes))])

    def all_of(by, x):
        given, (t, q, u, inputs) = restored(x[: numbers.size]), jnp.split(x[numbers.size :], np.cumsum(sizes)[:-1])
        parts = *by.closures(given, t[0], q), *by.rows(given, t[0], q, u, inputs), by.masses(given, t[0], q)
        return jnp.concatenate([jnp.ravel(part) for part in parts])

    weights, dx = (jnp.asarray(generator.normal(size=n)) for n in (jax.eval_shape(lambda x: all_of(BY_AUTODIFF, x), x).size, x.size))

    def derivatives(by):
        def of(x):
            slope = jax.grad(lambda x: weights @ all_of(by, x))
            return (*jax.jvp(lambda x: all_of(by, x), (x,), (dx,)), *((slope(x),) if order == 1 else jax.jvp(slope, (x,), (dx,))))

        return of

    found = derivatives(row_functions(program))
    for one, expected in zip(jax.jit(found)(x), eval_numpy(derivatives(BY_AUTODIFF))(x), strict=True):
        assert_allclose(one, expected, rtol=1e-11, atol=1e-11)
    for many, one in zip(jax.jit(jax.vmap(found))(jnp.stack([1.1 * x, x])), jax.jit(found)(x), strict=True):
        assert_allclose(many[1], one, rtol=1e-12, atol=1e-12)


@needs_llvmlite
@pytest.mark.parametrize("derivative", [jax.grad, jax.jacfwd])
def test_a_derivative_of_a_named_start_has_no_second_projection_and_no_scene_in_it(derivative):
    skate = jj.models.Skate()

    def reached(mass, **given):
        return jj.simulate(skate.replace(mass=mass), {"x_rate": 1.0, "heading_rate": 0.1, **given}, ts=[0.1])["x"][-1]

    def operations(**given):
        return len(jax.jit(derivative(lambda mass: reached(mass, **given))).lower(1.0).as_text().splitlines())

    assert operations() < 1800  # 4,200 where the scene is differentiated, and the start projected once more in case its values contradict each other
    assert operations(y_rate=0.0) > 1.3 * operations()


@needs_llvmlite
def test_rows_of_a_large_scene_have_the_derivatives_of_the_scenes_own():
    """Machine code returns the entries that are not zero: a whole Jacobian goes beyond the end of its stack."""
    scene, generator = jj.models.TrailerChain(trailers=16), np.random.default_rng(0)
    q, u, dq = (jnp.asarray(generator.normal(size=len(scene.coordinate_names))) for _ in range(3))
    inputs = jnp.zeros(len(scene.inputs))

    def along(by):
        def all_of(length, q):
            at = scene.replace(length=length)
            return by.rows(at, 0.3, q, u, inputs), by.masses(at, 0.3, q), by.closures(at, 0.3, q)

        return lambda q: jax.jvp(all_of, (scene.length, q), (jnp.ones_like(scene.length), dq))

    found, expected = jax.jit(along(row_functions(row_program(scene))))(q), eval_numpy(along(BY_AUTODIFF))(q)
    for one, other in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        assert_allclose(one, other, rtol=1e-12, atol=1e-12)


def of_skate(y_rate):
    return jj.simulate(jj.models.Skate(), {"heading": 0.0, "x_rate": 1.0, "y_rate": y_rate, "heading_rate": 0.1}, t1=0.5)


def test_values_that_contradict_each_other_get_a_result_code_where_they_are_traced():
    seen = jax.jit(lambda y_rate: (lambda motion: (motion.result, motion.u[0], motion.moved_u))(of_skate(y_rate)))
    assert int(seen(0.5)[0]) == results.INCONSISTENT_START
    with pytest.raises(ValueError, match="contradicts row `edge`"):
        of_skate(0.5)
    for result, u, moved in (seen(1e-7), (lambda motion: (motion.result, motion.u[0], motion.moved_u))(of_skate(1e-7))):
        assert int(result) == results.SUCCESS
        assert_allclose(u, [1.0, 0.0, 0.1], atol=1e-15)  # what passes for round-off moves
        assert_allclose(moved, 1e-7, rtol=1e-6)
    lanes = jj.rollout(jj.models.Skate(), {"heading": 0.0, "x_rate": 1.0, "y_rate": jnp.array([0.0, 0.5, 1e-7]), "heading_rate": 0.1}, t1=0.5)
    assert np.asarray(lanes.result).tolist() == [results.SUCCESS, results.INCONSISTENT_START, results.SUCCESS]


RODS = jj.models.DoublePendulumRods()


@pytest.mark.parametrize(
    ("scene", "held", "may"),
    [
        (jj.models.Skate(), ("x_rate", "heading_rate"), False),
        (jj.models.Skate(), ("x_rate", "y_rate"), True),
        (RODS, ("x1", "x2"), False),
        (RODS, ("x1", "z1"), True),
        (Driven(), ("attitude_w", "attitude_x", "attitude_y", "attitude_z"), True),
        (Driven(), ("x",), False),
    ],
)
def test_which_values_may_contradict_each_other(scene, held, may):
    free_q, free_u = (np.array([name not in held for name in names.entries]) for names in (scene.coordinate_names, scene.speed_names))
    assert may_contradict(scene, structure_of(scene), free_q, free_u) == may


def test_a_scene_whose_parameters_are_judged_by_an_unknown_operation_moves_without_a_program_of_rows(monkeypatch):
    def moved():
        class Hanging(jj.Scene):
            length: float = jj.parameter(0.7, positive=True)
            coordinates = jj.coordinates("x z")

            def bodies(self, t, q):
                return {"bob": jj.Particle(1.0, [q.x, 0.0, q.z])}

            def geometric_constraints(self, pose):
                return {"rod": pose.q.x**2 + pose.q.z**2 - self.length**2}

            def loads(self, motion):
                return (jj.gravity(motion, 9.81),)

        scene = Hanging()
        return row_program(scene), jj.simulate(scene, {"x": 0.42, "z": -0.56}, t1=0.2).q_end

    program, known = moved()
    monkeypatch.setattr(interpret, "REDUCTIONS", interpret.REDUCTIONS - {"reduce_or"})  # as where a newer version of JAX brings an operation
    none, found = moved()
    assert program is not None
    assert none is None
    assert_allclose(found, known, rtol=0, atol=1e-8)
