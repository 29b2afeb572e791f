"""Starts put onto the rows by machine code against the same by XLA, and where machine code is not taken."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import linkages
import numpy as np
import pytest
import rolling_scenes
import small_scenes
from numpy.testing import assert_allclose, assert_array_equal

import jourdain_jax as jj
from jourdain_jax.eager.eager import eval_numpy
from jourdain_jax.models import MODELS
from jourdain_jax.motion import start as starts
from jourdain_jax.motion.put_on_rows import put_positions, put_speeds, usual_sizes
from jourdain_jax.native import ffi

pytestmark = pytest.mark.skipif(bool(ffi.reason_against()), reason=ffi.reason_against())

TOLERANCE = 1e-11  # of what was moved by Newton's method either way, relative to its size


def _near_rows(scene: jj.Scene, count: int) -> tuple[jax.Array, jax.Array]:
    """Coordinates and speeds a little off the rows."""
    _, q, u = jj.sample_states(scene, count)
    generator = np.random.default_rng(1)
    q, u = (jnp.asarray(np.resize(x, (count, x.shape[1]))) for x in (q, u))
    return q + 1e-2 * generator.standard_normal(q.shape), u + 0.3 * generator.standard_normal(u.shape)


def _both(scene: jj.Scene) -> tuple:
    """Sizes of rows by which machine code and XLA put states onto them."""
    by_machine_code = usual_sizes(scene, False, True)
    assert by_machine_code.program is not None
    return by_machine_code, replace(by_machine_code, program=None)


def _put(scene: jj.Scene, usual, held_q=(), held_u=()):
    free_q = jnp.array([name not in held_q for name in scene.coordinate_names.entries], bool)
    free_u = jnp.array([name not in held_u for name in scene.speed_names.entries], bool)
    inputs = jnp.full(len(scene.inputs), 0.3)

    def put(q, u, scene=scene, t=0.2):
        near_q, g = put_positions(scene, jnp.asarray(t), q, free_q, usual)
        return near_q, *put_speeds(scene, jnp.asarray(t), near_q, u, inputs, free_u, usual), g

    return put


def _same(found, expected, tolerance=TOLERANCE):
    for x, y in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        assert_allclose(x, y, rtol=0, atol=tolerance * (1.0 + np.max(np.abs(y), initial=0.0)))


@pytest.mark.parametrize("name", MODELS)
def test_all_models_come_onto_the_rows_alike(name):
    scene = MODELS[name]()
    q, u = _near_rows(scene, 9)
    ours, theirs = (jax.jit(jax.vmap(_put(scene, usual)))(q, u) for usual in _both(scene))
    _same(ours, theirs)
    for lane in (0, 7):  # by itself, in narrow registers
        alone = jax.jit(_put(scene, _both(scene)[0]))(q[lane], u[lane])
        for x, y in zip(alone, ours, strict=True):
            assert_array_equal(x, y[lane])


@pytest.mark.parametrize("name", MODELS)
def test_named_starts_of_all_models_are_alike(name):
    scene = MODELS[name]()
    ours, theirs = (starts.named_start(scene, scene.example, 0.0, None, native=native) for native in (True, False))
    _same((ours.q, ours.u, ours.moved_q, ours.moved_u), (theirs.q, theirs.u, theirs.moved_q, theirs.moved_u))
    assert float(ours.residual) < 1e-12 * (1 + float(jnp.max(jnp.abs(ours.u))))
    assert int(ours.guess) == int(theirs.guess)


@pytest.mark.parametrize("count", [0, 1, 7, 9])
def test_lanes_of_a_batch_do_not_see_each_other(count):
    scene = jj.models.WhippleBicycle()
    put = jax.jit(jax.vmap(_put(scene, _both(scene)[0])))
    q, u = _near_rows(scene, 9)
    every = put(q, u)
    for some, of_all in zip(put(q[9 - count :], u[9 - count :]), every, strict=True):
        assert_array_equal(some, of_all[9 - count :])


def test_lanes_that_are_no_numbers_and_those_that_run_away():
    scene = jj.models.WhippleBicycle()
    q, u = _near_rows(scene, 5)
    q = q.at[1].set(jnp.nan).at[2, 0].set(jnp.inf).at[4, 3].set(1e3)
    u = u.at[3].set(jnp.nan)
    ours, theirs = (eval_numpy(jax.vmap(_put(scene, usual)))(q, u) for usual in _both(scene))
    finite, expected = (np.all([np.all(np.isfinite(x), axis=1) for x in found], axis=0) for found in (ours, theirs))
    assert_array_equal(finite, expected)
    assert_array_equal(finite, [True, False, False, False, True])
    _same([x[0] for x in ours], [y[0] for y in theirs])


def test_rows_that_depend_on_each_other():
    scene = linkages.Parallelogram()
    q, u = _near_rows(scene, 7)
    ours, theirs = (eval_numpy(jax.vmap(_put(scene, usual)))(q, u) for usual in _both(scene))
    _same(ours, theirs, 1e-9)  # positions on dependent rows are met to the root of the round-off of either


@pytest.mark.parametrize("scene", [small_scenes.BeadOnTurningWire(), small_scenes.AffineRows(), rolling_scenes.RouthSphere()], ids=lambda s: type(s).__name__)
def test_rows_that_depend_on_time_and_coordinates_that_are_redundant(scene):
    q, u = _near_rows(scene, 7)
    ours, theirs = (eval_numpy(jax.vmap(_put(scene, usual)))(q, u) for usual in _both(scene))
    _same(ours, theirs)


def test_what_is_held_does_not_move():
    scene = jj.models.WhippleBicycle()
    q, u = (x[0] for x in _near_rows(scene, 1))
    held = ("lean", "steer"), ("lean_rate", "rear_spin_rate")
    ours, theirs = (eval_numpy(_put(scene, usual, *held))(q, u) for usual in _both(scene))
    _same(ours, theirs)
    for names, given, found in zip((scene.coordinate_names, scene.speed_names), (q, u), ours[:2], strict=False):
        for name in (name for of in held for name in of if name in names):
            assert given[names.entries.index(name)] == found[names.entries.index(name)]


@pytest.mark.parametrize("name", ["tilting-disc", "whipple-bicycle"])
def test_derivatives_of_starts_are_those_by_xla(name):
    scene = MODELS[name]()
    q, u = (x[0] for x in _near_rows(scene, 1))
    leaves, treedef = jax.tree.flatten(scene)
    flat = jnp.stack([jnp.asarray(x, float) for x in leaves])

    def end(by, x):
        flat, q, u = x
        scene_here = jax.tree.unflatten(treedef, list(flat))
        near_q, near_u, *_ = _put(scene, by)(q, u, scene_here)
        return jnp.sum(jnp.sin(near_q)) + jnp.sum(near_u**2)

    point = flat, q, u
    ours, theirs = (eval_numpy(jax.grad(lambda x, by=by: end(by, x)))(point) for by in _both(scene))
    _same(ours, theirs, 1e-10)
    ours, theirs = (eval_numpy(lambda x, by=by: jax.jvp(lambda x: end(by, x), (x,), (jax.tree.map(jnp.ones_like, x),)))(point) for by in _both(scene))
    _same(ours, theirs, 1e-10)


def test_where_machine_code_is_not_taken():
    scene = jj.models.TiltingDisc()
    started = jax.jit(lambda lean: jj.start(scene, lean=lean, spin_rate=-3.0).u)
    model = jj.build(scene, backend="xla")
    exported = jax.export.export(jax.jit(lambda lean: jj.start(model, lean=lean, spin_rate=-3.0).u))(jax.ShapeDtypeStruct((), jnp.float64))
    with pytest.raises(RuntimeError, match=r'to be exported.*backend="xla"'):
        jax.export.export(started)(jax.ShapeDtypeStruct((), jnp.float64))
    assert "jourdain_jax_" in started.lower(0.3).as_text()
    assert "jourdain_jax_" not in exported.mlir_module()
    assert_allclose(exported.call(0.3), jj.start(scene, lean=0.3, spin_rate=-3.0).u, atol=1e-14)
    assert usual_sizes(scene, False, False).program is None


def test_failures_are_the_same():
    scene = jj.models.TiltingDisc()
    with pytest.raises(ValueError, match="contradicts row"):
        jj.start(scene, lean=0.3, spin_rate=-3.0, x_rate=7.0, yaw_rate=0.1)
    started = jj.consistent(scene, 0.0, jnp.zeros(5), jnp.zeros(5))
    lanes = jax.tree.map(lambda x: jnp.stack([x, x + jnp.nan]), started)  # named starts that are no numbers are in a test of `rollout` by machine code
    ours, theirs = (jj.rollout(scene, lanes, t1=0.1, backend=backend) for backend in ("native", "xla"))
    assert_array_equal(ours.result, theirs.result)
    assert len(set(np.asarray(ours.result).tolist())) > 1
