"""Batches: every lane as if it were alone, one bad lane harms no other, differentiable as a whole."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import result_codes as results
from numpy.testing import assert_allclose
from refusals import refused

import jourdain_jax as jj
from jourdain_jax.models import ChaplyginSleigh

OPTIONS = {"t1": 2.0, "ts": np.linspace(0.0, 2.0, 5), "rtol": 1e-9, "atol": 1e-9}


@pytest.fixture(scope="module")
def sleighs():
    """Seven sleighs with different starts and offsets in chunks of three; lane 2 starts from NaN, lane 5 with
    a NaN offset.
    """
    turning = np.array([0.9, 0.5, np.nan, -0.3, 0.2, 0.7, 0.1])
    offset = np.array([0.25, 0.2, 0.25, 0.3, 0.1, np.nan, 0.2])
    starts = {"x_rate": -0.6, "heading_rate": turning}
    options = OPTIONS | {"parameters": {"offset": offset}, "chunk": 3}
    return turning, offset, jj.rollout(ChaplyginSleigh(), starts, **options)


def test_every_lane_is_the_motion_it_would_be_alone(sleighs):
    turning, offset, lanes = sleighs
    for i in (0, 3, 6):
        scene = ChaplyginSleigh(offset=offset[i])
        alone = jj.simulate(scene, {"x_rate": -0.6, "heading_rate": turning[i]}, **OPTIONS)
        assert_allclose(lanes.lane(i).q, alone.q, atol=1e-9)
        assert lanes.lane(i).scene.offset == offset[i]


def test_bad_lanes_are_counted_and_named_and_harm_no_other(sleighs):
    _, _, lanes = sleighs
    assert lanes.failed.tolist() == [2, 5]
    good = np.setdiff1d(np.arange(7), lanes.failed)
    assert np.all(lanes.result[good] == results.SUCCESS)
    assert np.isfinite(lanes["x"][good]).all()
    assert lanes.result[[2, 5]].tolist() == [results.BAD_START, results.BAD_PARAMETER]
    assert "1 the start is not finite; check where its values were computed: lanes 2" in str(lanes)
    assert "1 a parameter is not finite or has the wrong sign (`offset`): lanes 5" in str(lanes)
    assert lanes.quantiles("heading", (0.5,)).shape == (1, 5)
    assert_allclose(lanes.quantiles("heading", (0.5,))[0], np.median(lanes["heading"][good], axis=0))


def test_lanes_with_times_of_their_own_have_no_quantiles_in_common():
    """The first saved time of the one is not that of the other."""
    starts = [jj.start(ChaplyginSleigh(), t0=t0, x_rate=1.0) for t0 in (0.0, 1.0)]
    lanes = jj.rollout(ChaplyginSleigh(), jax.tree.map(lambda *x: jnp.stack(x), *starts), t1=2.0)
    refused("lanes have different saved times", lanes.quantiles, "x")
    assert "<img" not in lanes._repr_html_()


def test_another_tolerance_longest_step_or_end_is_no_other_program(compilations):
    starts = {"x_rate": 0.5, "heading_rate": np.linspace(0.4, 0.8, 3)}

    def ends(t1, **options):
        options = {"max_step": np.inf} | options
        return jj.rollout(ChaplyginSleigh(), starts, t1=t1, ts=t1 * jnp.array([0.5, 1.0]), **options).lanes

    loose = ends(1.0, rtol=1e-7, atol=1e-7)
    same = ends(1.0)
    compilations.clear()
    tight, longer = ends(1.0, rtol=1e-10, atol=1e-10), ends(1.5, rtol=1e-7)
    short = ends(1.0, max_step=0.01)
    assert_allclose(tight.q_end, loose.q_end, rtol=1e-5)
    assert not compilations
    assert np.all(short.accepted >= 100)
    assert np.all(tight.accepted > same.accepted)
    assert np.sum(same.accepted) > np.sum(loose.accepted)
    assert_allclose(tight.q_end, loose.q_end, rtol=1e-5)
    assert_allclose(longer.t_end, 1.5)


def test_states_made_by_hand_are_starts_of_lanes():
    sleigh = ChaplyginSleigh()
    made = [jj.start(sleigh, x_rate=speed, heading_rate=0.3) for speed in (0.4, 0.6)]
    stacked = jax.tree.map(lambda *x: jnp.stack(x), *made)
    starts = eqx.tree_at(lambda s: s.guess, stacked, jnp.zeros(()))  # what `jj.State` has by default
    options = {"ts": jnp.array([0.2]), "formulation": jj.Formulation(stabilisation=None)}
    lanes = jj.rollout(sleigh, starts, **options)
    alone = [jj.simulate(sleigh, state, **options).q_end for state in made]
    assert_allclose(lanes.lanes.q_end, alone, rtol=1e-9, atol=1e-12)


def test_lanes_that_are_given_to_devices_move_as_those_of_vmap():
    def end(speed):
        return jj.simulate(ChaplyginSleigh(), {"x_rate": speed, "heading_rate": 0.3}, ts=[0.2]).q_end

    speeds, lanes = jnp.array([0.4, 0.6]), jax.sharding.PartitionSpec("lanes")
    mesh = jax.sharding.Mesh(np.array(jax.devices()[:1]), ("lanes",))
    on_devices = jax.shard_map(jax.vmap(end), mesh=mesh, in_specs=lanes, out_specs=lanes, check_vma=False)
    assert_allclose(jax.jit(on_devices)(speeds), [end(speed) for speed in speeds], rtol=1e-12, atol=1e-15)
