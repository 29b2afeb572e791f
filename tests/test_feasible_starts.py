"""Values that some state on the rows has are a start: what was not given is found, and has derivatives."""

from itertools import pairwise

import equinox as eqx
import jax
import jax.numpy as jnp
import linkages
import numpy as np
import pytest
import result_codes as results
import small_scenes
from jax.flatten_util import ravel_pytree
from linkages import Parallelogram, SliderCrank, Windows, bennett, bricard
from numpy.testing import assert_allclose, assert_array_equal
from refusals import refused
from small_scenes import DiscWithHeightRow, InSpace

import jourdain_jax as jj
from jourdain_jax import structure_of
from jourdain_jax.program.eager import eval_numpy

# Values that some state on the rows has are a start: what was not given is found, and where it was not found
# near the reference, the state says so


SCENES = {
    "disc with quaternion": jj.models.TiltingDiscQuaternion(),
    "disc in angles": DiscWithHeightRow(),
    "pendulum of rods": jj.models.DoublePendulumRods(),
    "parallelogram": Parallelogram(),
    "slider-crank": SliderCrank(rod=2.0),
    "Bennett": bennett(0.7, 1.2),
    "Bricard": bricard(1.0, 1.2, 0.8, 0.9, 1.1),
    "windows": Windows(2),
}


@pytest.mark.parametrize("name", SCENES)
def test_any_part_of_a_state_on_the_rows_is_a_start(name):
    scene, generator = SCENES[name], np.random.default_rng(0)
    _, states, _ = jj.sample_states(scene, 8, seed=5)
    names = scene.coordinate_names.entries
    for q in states:
        given = generator.choice(len(names), generator.integers(1, len(names)), replace=False)
        for first, _ in scene.coordinates.quaternions:  # whole or not at all
            attitude = np.arange(first, first + 4)
            given = np.setdiff1d(given, attitude) if first not in given else np.union1d(given, attitude)
        found = jj.start(scene, **{names[i]: q[i] for i in given})
        assert found.residual < 1e-9
        assert_array_equal(np.asarray(found.q)[given], q[given])


@pytest.mark.parametrize("given", [{"z": 0.4}, {"z": 0.1}])
def test_a_disc_leans_as_its_height_wants(given):
    found = jj.start(SCENES["disc with quaternion"], **given)
    assert found.residual < 1e-12
    assert jnp.max(jnp.abs(found.q)) <= 1.0
    w, x, y, z = found.q[3:]
    assert float(0.5 * jnp.sqrt(1 - (2 * (y * z + w * x)) ** 2)) == pytest.approx(float(found["z"]), abs=1e-9)
    assert (int(found.guess) > 0) == ("guess" in str(found))


@pytest.mark.parametrize(
    ("name", "given", "row"),
    [
        ("disc with quaternion", {"z": 0.6}, "rim height"),
        ("slider-crank", {"x": 3.4}, "along|across"),
        ("windows", {"x0": 0.9, "z0": 0.9}, "left 0"),
        ("disc with quaternion", {"attitude": (1.2, 0.0, 0.0, 0.0)}, "norm of quaternion"),
    ],
)
def test_values_that_no_state_has_are_refused_with_the_row(name, given, row):
    refused(f"violates constraint `({row})", jj.start, SCENES[name], **given)


class Hanging(InSpace):
    """A pendulum in Cartesian coordinates, of which the lower half is stated as the domain."""

    domain = {"x": (-0.9, 0.9), "y": (-0.9, 0.9), "z": (-1.0, -0.1)}

    def geometric_constraints(self, pose):
        return {"rod": pose.q.array @ pose.q.array - 1.0}


@pytest.mark.parametrize("given", [{}, {"x": 0.3}, {"x": 0.3, "y": -0.2}, {"x": 0.9, "y": 0.0}, {"y": 0.7}])
def test_a_start_is_put_together_in_the_domain_that_its_scene_states(given):
    found = jj.start(Hanging(), given)
    assert found.residual < 1e-12
    assert -1.05 <= float(found["z"]) <= -0.1
    assert_allclose(jj.simulate(Hanging(), given, ts=[0.0, 0.01]).q[0], found.q, atol=1e-9)


def test_what_is_found_outside_of_the_domain_is_refused_unless_it_is_looked_for_there():
    scene = Hanging()
    near = {"z": 0.4}
    assert jj.start(scene, x=0.3, near=near)["z"] == pytest.approx(np.sqrt(0.91), abs=1e-12)
    assert jj.start(scene, x=0.3, near={"y": 0.5})["z"] < -0.05
    for look in (jj.start, lambda scene, values: jj.simulate(scene, values, t1=0.1)):
        refused("near=", look, scene, {"x": 1.0})
    refused("`near` names `x_rate`, which is not a coordinate", jj.start, scene, near={"x_rate": 1.0})
    refused("expected a dictionary of coordinates", jj.start, scene, near=0.4)


def test_coordinates_of_which_the_rows_leave_no_choice_may_leave_the_domain():
    disc = jj.models.TiltingDiscQuaternion(radius=1.0)  # its domain has heights to 0.5 m
    assert jj.start(disc, attitude=(1.0, 0.0, 0.0, 0.0))["z"] == pytest.approx(1.0)


def test_lanes_are_put_together_in_the_domain_or_end_with_a_code():
    scene, places = Hanging(), np.array([0.1, 0.6, 1.0])
    lanes = jj.rollout(scene, {"x": places, "y": 0.0}, ts=[0.1])
    assert lanes.result.tolist() == [results.SUCCESS, results.SUCCESS, results.INCONSISTENT_START]
    height = lambda x: jj.start(scene, x=x, y=0.0).q[2]
    values, slopes = eval_numpy(jax.vmap(jax.value_and_grad(height)))(places[:2])
    assert_allclose(values, -np.sqrt(1 - places[:2] ** 2), rtol=1e-12)
    assert_allclose(slopes, -places[:2] / values, rtol=1e-9)
    assert_allclose(eval_numpy(jax.jacfwd(height))(0.6), 0.75, rtol=1e-9)
    assert np.isinf(jax.jit(lambda x: jj.start(scene, x=x, y=0.0).residual)(1.0))


@pytest.mark.parametrize(
    "given",
    [
        {"attitude_w": 0.0},
        {"attitude_x": 0.2},
        {"attitude_x": 0.2, "z": 0.4},
        {"attitude_x": 0.5, "attitude_z": 0.5},
    ],
)
def test_an_attitude_of_which_a_part_is_named_is_refused_where_many_have_it(given):
    disc = SCENES["disc with quaternion"]
    for look in (jj.start, lambda scene, values: jj.simulate(scene, values, t1=0.1)):
        refused(
            r"of the quaternion `attitude` is given, .*; give all four parts, attitude=\(w, x, y, z\)",
            look,
            disc,
            given,
        )
    if len(given) == 1:
        lanes = jj.rollout(disc, {"attitude_w": np.array([0.0, 0.3])}, ts=[0.1])
        assert set(np.asarray(lanes.result)) <= {results.INCONSISTENT_START, results.BAD_START}


def test_parts_of_an_attitude_that_no_other_has_leave_the_rest_zero():
    half, disc = 0.2, SCENES["disc with quaternion"]
    given = {"attitude_w": np.cos(half), "attitude_x": np.sin(half)}
    assert_allclose(jj.start(disc, given)["attitude"], [np.cos(half), np.sin(half), 0.0, 0.0], atol=1e-12)
    assert_allclose(jj.start(disc, attitude_z=1.0, z=0.5)["attitude"], [0.0, 0.0, 0.0, 1.0], atol=1e-12)

    def lean(half):
        return jj.start(disc, attitude_w=jnp.cos(half), attitude_x=jnp.sin(half))["z"]

    assert_allclose(eval_numpy(jax.grad(lean))(half), -np.sin(2 * half), rtol=1e-9)


class Hidden(InSpace):
    """A particle held by a row that is a number in a small disc of its domain only."""

    def geometric_constraints(self, pose):
        x, y = pose.q.x - 0.3, pose.q.y - 0.2
        return {"hidden": x * jnp.sqrt(4e-4 - x**2 - y**2)}


def test_states_near_the_example_serve_where_none_was_found_at_random():
    class Shown(Hidden):
        example = {"x": 0.3, "y": 0.2}

    refused(r"no admissible state .* or an `example` on the constraints", structure_of, Hidden())
    assert structure_of(Shown()).degrees_of_freedom == 2
    assert jj.start(Shown(), x=0.3, y=0.2, y_rate=1.0).residual < 1e-12


def test_a_state_that_newtons_method_does_not_bring_onto_the_rows_is_searched_for_and_then_named():
    """Both masses in the support: no row says where to go, and no search finds it."""
    scene = SCENES["pendulum of rods"]
    start = eqx.tree_at(lambda s: s.q, jj.start(scene, **scene.example), jnp.zeros(4))
    motion = jj.simulate(scene, start, t1=0.1)
    assert motion.result == results.INCONSISTENT_START
    sound = jj.simulate(
        scene, eqx.tree_at(lambda s: s.q, start, jnp.array([0.6, -0.8, 0.6, -1.7])), t1=0.1
    )  # the lower rod is too long
    assert sound.result == results.SUCCESS
    assert 0.01 < float(sound.moved_q) < 0.1


# Derivatives of what is put onto the rows, of a start off them by some finite amount, against differences of
# what is computed.


STEP = 2e-3


def _slope(function, s=0.0):
    """The derivative by Richardson's extrapolation of central differences, of order 6."""
    D = [
        (np.asarray(function(s + h)) - np.asarray(function(s - h))) / (2 * h)
        for h in (STEP, STEP / 2, STEP / 4)
    ]
    D = [(4 * b - a) / 3 for a, b in pairwise(D)]
    return (16 * D[1] - D[0]) / 15


def _along(scene, held, off):
    """What is put onto the rows as a function of one number, on which parameters, time, coordinates and
    speeds depend.
    """
    generator = np.random.default_rng(2)
    _, q, u = jj.sample_states(scene, 1)
    numbers, restored = ravel_pytree(
        (jax.tree.map(jnp.asarray, scene), jnp.asarray(0.2), jnp.asarray(q[0]), jnp.asarray(u[0]))
    )
    moved = jnp.asarray(off * generator.normal(size=len(q[0]) + len(u[0])))
    numbers = numbers.at[-moved.size :].add(moved)
    direction = jnp.asarray(generator.normal(size=numbers.size)) * (0.1 + 0.1 * jnp.abs(numbers))

    def put(s):
        here, t, q, u = restored(numbers + s * direction)
        state = jj.consistent(here, t, q, u, jnp.full(len(scene.inputs), 0.3), held=held)
        return jnp.concatenate([state.q, state.u])

    return put


@pytest.mark.parametrize(
    ("scene", "held", "off"),
    [
        (jj.models.DoublePendulumRods(), ("x1", "x2"), 0.02),
        (linkages.Parallelogram(), (), 1e-2),
        (small_scenes.BeadOnTurningWire(), (), 0.1),
    ],
    ids=["held", "redundant rows", "rows of time"],
)
def test_derivatives_are_those_of_what_is_computed(scene, held, off):
    put = _along(scene, held, off)
    weights = np.random.default_rng(3).normal(size=put(0.0).size)
    forward = eval_numpy(jax.jacfwd(put))(0.0)
    assert_allclose(forward, _slope(eval_numpy(put)), atol=1e-8 * np.max(np.abs(forward)))
    assert_allclose(eval_numpy(jax.grad(lambda s: weights @ put(s)))(0.0), weights @ forward, rtol=1e-10)


def test_second_derivatives_are_differences_of_first_ones():
    put = _along(small_scenes.BeadOnTurningWire(), (), 0.1)
    expected = _slope(jax.jit(jax.jacfwd(put)))
    for second in (jax.jacfwd(jax.jacfwd(put)), jax.jacfwd(jax.jacrev(put)), jax.jacrev(jax.jacrev(put))):
        assert_allclose(jax.jit(second)(0.0), expected, atol=1e-7 * np.max(np.abs(expected)))
