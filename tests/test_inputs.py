"""Inputs: what they are at the start counts in the start, and their rates in the balance of energy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jourdain_jax as jj
from jourdain_jax.models import ChaplyginSleigh


class OnBelt(jj.Scene):
    """A bead that slides across a belt; the belt, at the speed of an input, carries it along faster the farther out it is."""

    mass: jnp.ndarray = jj.parameter(2.0, unit="kg", positive=True)
    coordinates = jj.coordinates("x y")
    inputs = jj.inputs("speed push")
    domain = {"y": (-0.4, 0.4)}

    def bodies(self, t, q):
        return {"bead": jj.Particle(self.mass, jnp.stack([q.x, q.y, 0.0 * q.x]))}

    def loads(self, motion):
        return (jj.generalized_force(motion, y_rate=motion.inputs.push),)

    def velocity_constraints(self, motion):
        return {"belt": motion.u.x_rate - (1.0 + motion.q.y) * motion.inputs.speed}


SPEEDS = {
    "number": 3.0,
    "function": lambda t: 1.0 + t**2 / 2.0,
    "samples": jj.Sampled([0.0, 4.0], [1.0, 5.0]),
}


@pytest.mark.parametrize("speed", SPEEDS.values(), ids=SPEEDS)
def test_a_start_meets_rows_that_depend_on_inputs_at_its_time(speed):
    start = jj.start(OnBelt(), t0=2.0, y=0.5, inputs={"speed": speed})
    np.testing.assert_allclose(start["x_rate"], 1.5 * 3.0, rtol=1e-14)
    assert start.residual < 1e-14
    assert jj.start(OnBelt(), t0=2.0, y=0.5)["x_rate"] == 0.0


def test_given_values_are_compared_with_the_rows_at_the_inputs():
    kept = jj.start(OnBelt(), y=0.5, x_rate=4.5, inputs={"speed": 3.0})
    assert (kept["x_rate"], kept["y"]) == (4.5, 0.5)
    with pytest.raises(ValueError, match=r"contradicts row `belt`: residual 1.5 is left"):
        jj.start(OnBelt(), y=0.5, x_rate=4.5, inputs={"speed": 2.0})
    with pytest.raises(ValueError, match=r"contradicts row `belt`: residual 4.5 is left"):
        jj.start(OnBelt(), y=0.5, x_rate=4.5)


def test_a_start_follows_its_inputs_smoothly_and_in_batches():
    def carried(speed):
        return jj.start(OnBelt(), y=0.5, inputs={"speed": speed})["x_rate"]

    np.testing.assert_allclose(jax.jit(jax.vmap(jax.grad(carried)))(jnp.array([1.0, 3.0])), 1.5, rtol=1e-14)


def test_named_starts_of_simulate_rollout_and_linearize_meet_rows_that_depend_on_inputs():
    scene, values, inputs = OnBelt(), {"y": 0.5, "x_rate": 4.5}, {"speed": 3.0}
    alone = jj.simulate(scene, values, ts=[0.0, 0.5], inputs=inputs).raise_if_failed()
    assert alone.moved_u == 0.0
    np.testing.assert_allclose(alone.q_end, [4.5 * 0.5, 0.5], rtol=1e-12)
    starts = {"y": np.array([0.5, 0.2]), "x_rate": np.array([4.5, 3.6])}
    lanes = jj.rollout(scene, starts, ts=[0.0, 0.5], inputs=inputs, progress=False)
    assert lanes.failed.size == 0
    np.testing.assert_allclose(lanes["x"][:, -1], [4.5 * 0.5, 3.6 * 0.5], rtol=1e-12)
    assert jj.linearize(scene, values, (), inputs=inputs).A.shape[0] > 0
    assert jj.verify(scene, values, inputs=inputs).passed


@pytest.mark.parametrize("inputs", [{"spede": 1.0}, {"speed": "fast"}, {"speed": [1.0, 2.0]}, [1.0, 2.0], 3.0], ids=str)
def test_a_start_refuses_inputs_in_the_words_of_simulate(inputs):
    said = []
    for f in (lambda: jj.start(OnBelt(), inputs=inputs), lambda: jj.simulate(OnBelt(), {}, t1=1.0, inputs=inputs)):
        with pytest.raises(ValueError) as error:
            f()
        said.append(str(error.value))
    assert said[0] == said[1]


def test_a_scene_without_inputs_takes_none_in_a_start():
    with pytest.raises(ValueError, match="`ChaplyginSleigh` has no input `force`"):
        jj.start(ChaplyginSleigh(), inputs={"force": 1.0})
