"""Starts put onto the rows by machine code against the same by XLA, and where machine code is not taken."""

import jax
import jax.numpy as jnp
import linkages
import machine_code
import numpy as np
import pytest
import rolling_scenes
import small_scenes
from numpy.testing import assert_allclose, assert_array_equal

import jourdain_jax as jj
from jourdain_jax.models import MODELS
from jourdain_jax.motion.model import modelled
from jourdain_jax.program.eager import eval_numpy

pytestmark = machine_code.needed

BICYCLE = jj.models.WhippleBicycle()
BACKENDS = "xla", "auto"


def _near_rows(scene, count):
    """Coordinates and speeds a little off the rows."""
    _, q, u = jj.sample_states(scene, count)
    generator = np.random.default_rng(1)
    q, u = (jnp.asarray(np.resize(x, (count, x.shape[1]))) for x in (q, u))
    return q + 1e-2 * generator.standard_normal(q.shape), u + 0.3 * generator.standard_normal(u.shape)


def _put(native, held=()):
    """`(scene, q, u)` -> the nearest state on the rows."""
    return lambda scene, q, u: jj.consistent(
        modelled(scene, None, BACKENDS[native]), 0.2, q, u, jnp.full(len(scene.inputs), 0.3), held=held
    )


def _by_both(scene, q, u, **options):
    """States put onto the rows by machine code and by XLA, all lanes at once."""
    return (
        eval_numpy(jax.vmap(lambda q, u, native=native: _put(native, **options)(scene, q, u)))(q, u)
        for native in (True, False)
    )


def _same(found, expected, tolerance=1e-11):
    """What Newton's method finds either way, relative to its size."""
    for x, y in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        assert_allclose(x, y, rtol=0, atol=tolerance * (1.0 + np.max(np.abs(y), initial=0.0)))


@pytest.mark.parametrize("name", MODELS)
def test_named_starts_of_all_models_are_alike(name):
    scene = MODELS[name]()
    theirs, ours = (jj.start(jj.build(scene, backend=backend), scene.example) for backend in BACKENDS)
    _same(ours, theirs)
    assert ours.residual < 1e-12 * (1 + float(jnp.max(jnp.abs(ours.u))))


@pytest.mark.parametrize("trailers", [3, 16])
def test_states_on_the_rows_stay_and_those_beside_them_move(trailers):
    """The rows of 16 trailers are too many for machine code."""
    scene = jj.models.TrailerChain(trailers=trailers)
    at = jj.start(scene, scene.example)
    off = 1e-3 * np.random.default_rng(0).standard_normal(at.u.shape)
    put = jax.jit(lambda q, u: _put(True)(scene, q, u))
    alone, moved = put(at.q, at.u), put(at.q, at.u + off)
    assert_array_equal(alone.q, at.q)
    assert_array_equal(alone.u, at.u)
    assert moved.moved_u > 1e-4
    assert moved.residual < 1e-14
    lanes = jax.vmap(put)(jnp.stack([at.q, at.q]), jnp.stack([at.u, at.u + off]))
    assert_array_equal(lanes.u[0], at.u)
    assert_allclose(lanes.u[1], moved.u, atol=1e-14)
    if trailers > 3:
        return
    # with the derivatives of the projection, whose square is itself and whose trace is the rank
    slopes = jax.jacfwd(lambda u: put(at.q, u).u)(at.u)
    assert_allclose(slopes @ slopes, slopes, atol=1e-13)
    assert_allclose(np.trace(slopes), 2, atol=1e-13)


@pytest.mark.parametrize(
    ("scene", "tolerance"),
    [
        (
            linkages.Parallelogram(),
            1e-9,
        ),  # positions on dependent rows are met to the root of the round-off of either
        (small_scenes.BeadOnTurningWire(), 1e-11),
        (small_scenes.AffineRows(), 1e-11),
        (rolling_scenes.RouthSphere(), 1e-11),
    ],
    ids=small_scenes.name_of,
)
def test_rows_that_depend_on_each_other_on_time_and_redundant_coordinates(scene, tolerance):
    ours, theirs = _by_both(scene, *_near_rows(scene, 7))
    _same((ours.q, ours.u), (theirs.q, theirs.u), tolerance)


def test_what_is_held_does_not_move():
    q, u = _near_rows(BICYCLE, 1)
    held = ("lean", "steer", "lean_rate", "rear_spin_rate")
    ours, theirs = _by_both(BICYCLE, q, u, held=held)
    _same((ours.q, ours.u), (theirs.q, theirs.u))
    for names, given, found in ((BICYCLE.coordinate_names, q, ours.q), (BICYCLE.speed_names, u, ours.u)):
        places = [k for k, name in enumerate(names.entries) if name in held]
        assert_array_equal(np.asarray(found)[:, places], np.asarray(given)[:, places])


def test_where_machine_code_is_not_taken():
    scene = jj.models.TiltingDisc()
    started = jax.jit(lambda lean: jj.start(scene, lean=lean, spin_rate=-3.0).u)
    model = jj.build(scene, backend="xla")
    exported = jax.export.export(jax.jit(lambda lean: jj.start(model, lean=lean, spin_rate=-3.0).u))(
        jax.ShapeDtypeStruct((), jnp.float64)
    )
    with pytest.raises(RuntimeError, match=r'to be exported.*backend="xla"'):
        jax.export.export(started)(jax.ShapeDtypeStruct((), jnp.float64))
    assert "jourdain_jax_" in started.lower(0.3).as_text()
    assert "jourdain_jax_" not in exported.mlir_module()
    assert_allclose(exported.call(0.3), jj.start(scene, lean=0.3, spin_rate=-3.0).u, atol=1e-14)
