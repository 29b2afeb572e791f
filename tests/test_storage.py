"""Rollouts in files: every lane comes back as it was, failed ones with their codes; wrong files are refused
with the reason.
"""

import json

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import result_codes as results
from numpy.testing import assert_allclose, assert_array_equal
from refusals import refused
from test_inputs import OnBelt

import jourdain_jax as jj
from jourdain_jax.models import ChaplyginSleigh, PendulumChain, TiltingDisc

TS = np.linspace(0.0, 0.5, 3)


@pytest.fixture(scope="module")
def discs():
    """Three discs: one rolls, one has a wrong radius, one falls."""
    starts = {"lean": np.array([0.3, 0.3, 1.4]), "spin_rate": np.array([-6.0, -6.0, -0.1])}
    return jj.rollout(TiltingDisc(), starts, parameters={"radius": np.array([0.5, -0.5, 0.4])}, ts=TS)


def kept(result, kind, folder):
    """A motion, or several, read back from a file."""
    jj.save(result, folder / "kept.npz")
    read = jj.load_rollout if isinstance(result, jj.Rollout) else jj.load_trajectory
    return read(folder / "kept.npz", kind)


def assert_equal_to_the_bit(a, b):
    assert jax.tree.structure(a) == jax.tree.structure(b)
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        assert (x.dtype, x.shape) == (y.dtype, y.shape)
        assert np.asarray(x).tobytes() == np.asarray(y).tobytes()


def test_a_saved_rollout_comes_back_to_the_bit_with_one_code_per_lane(discs, tmp_path):
    loaded = kept(discs, TiltingDisc, tmp_path)
    assert discs.result.tolist() == [results.SUCCESS, results.BAD_PARAMETER, results.EVENT]
    assert_equal_to_the_bit(loaded, discs)
    assert str(loaded) == str(discs)
    assert str(loaded.lane(2)) == str(discs.lane(2))
    with np.load(tmp_path / "kept.npz") as file:
        header = json.loads(str(file["header"]))
        assert (header["format"], header["kind"], file["result"].tolist()) == (1, "rollout", [0, 7, 1])


def test_a_lane_with_wrong_parameters_comes_back_from_a_file_of_its_own(discs, tmp_path):
    loaded = kept(discs.lane(1), TiltingDisc, tmp_path)
    assert_equal_to_the_bit(loaded, discs.lane(1))
    assert loaded.message.endswith("(`radius`); check where it was computed")


class SmallDisc(TiltingDisc):
    """A disc whose class looks at its radius when one is made."""

    def __check_init__(self):
        if self.radius > 0.6:
            raise ValueError("too large")


def test_a_class_that_looks_at_its_numbers_is_made_with_those_of_the_file(tmp_path):
    lanes = jj.rollout(SmallDisc(radius=0.4), {"lean": np.array([0.2, 0.3])}, ts=TS)
    for result in (lanes, lanes.lane(1)):
        assert_equal_to_the_bit(kept(result, SmallDisc, tmp_path), result)


def test_lanes_that_were_continued_and_fields_that_are_counts_are_kept(tmp_path):
    lanes = jj.rollout(PendulumChain(links=1), parameters={"mass": np.array([[0.2], [0.3]])}, ts=TS)
    again = eqx.tree_at(
        lambda motions: motions.fallback, lanes.lanes, jnp.array([0, results.FULL_STATE], jnp.int32)
    )
    lanes = jj.Rollout(again, reruns=((results.FULL_STATE, ("full", "multipliers", "Dopri8", True, "")),))
    loaded = kept(lanes, PendulumChain, tmp_path)
    assert_equal_to_the_bit(loaded, lanes)
    assert (loaded.lane(0).reduction, loaded.lane(1).reduction) == (lanes.lanes.reduction, "multipliers")


def test_inputs_come_back_as_samples_at_the_saved_times(tmp_path):
    inputs = {"speed": lambda t: 1.0 + t, "push": jj.Sampled([0.0, 1.0], [0.0, 2.0])}
    lanes = jj.rollout(
        OnBelt(), {"y": np.array([0.1, 0.2])}, ts=TS[::-1], t0=0.5, inputs=inputs
    )  # in reversed time
    loaded = kept(lanes, OnBelt, tmp_path)
    assert_array_equal(loaded["x"], lanes["x"])
    for i in range(2):
        assert_allclose(jax.vmap(loaded.lane(i).inputs)(TS), jax.vmap(lanes.lane(i).inputs)(TS), rtol=1e-15)
    assert_allclose(loaded.lane(0).inputs(0.125), [1.125, 0.25], rtol=1e-15)


def test_a_motion_of_equal_steps_comes_back_with_its_inputs(tmp_path):
    steps = jj.simulate(
        OnBelt(),
        {"y": 0.1},
        t1=0.5,
        ts=[0.0, 0.2],
        inputs={"speed": 1.0},
        solver=jj.ImplicitMidpoint(step=0.1),
    )
    loaded = kept(steps, OnBelt, tmp_path)
    assert_array_equal(loaded.q, steps.q)
    assert_array_equal(loaded.inputs(0.3), [1.0, 0.0])


def test_a_field_that_cannot_be_stored_is_named(tmp_path):
    class Labelled(ChaplyginSleigh):
        labels: tuple = eqx.field(static=True, default=("a",))

    motion = jj.simulate(ChaplyginSleigh(), ts=TS)
    labelled = lambda labels: eqx.tree_at(lambda motion: motion.scene, motion, Labelled(labels=labels))
    assert kept(labelled(Labelled().labels), Labelled, tmp_path).scene.labels == ("a",)
    said = "field `labels` of `Labelled` is .*, which `save` cannot store"
    refused(said, jj.save, labelled(("b",)), tmp_path / "labels.npz")
