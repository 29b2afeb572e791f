"""Stop events whose values are negative in a short part of the way are met: the relations in them are watched over each step."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import result_codes as results
from machine_code import BACKENDS
from small_scenes import OnLine

import jourdain_jax as jj

A, W = 0.9, 0.006  # where a bead of 1 m/s that begins at 0 meets them; 0.3 % of the span

# value of (x, t, a, w), and where it stops
KINDS = {
    "distance": (lambda x, t, a, w: jnp.abs(x - a) - w, A - W),
    "window": (lambda x, t, a, w: jnp.where((x > a) & (x < a + w), -1.0, 1.0), A),
    "window by distance": (lambda x, t, a, w: jnp.where(jnp.abs(x - a) < w, -1.0, 1.0), A - W),
    "larger of two": (lambda x, t, a, w: jnp.maximum(x - a, a - x) - w, A - W),
    "before or behind": (lambda x, t, a, w: jnp.maximum(a - x, x - a - w), A),
    "sign": (lambda x, t, a, w: jnp.sign(jnp.abs(x - a) - w) + 0.5, A - W),
    "floor": (lambda x, t, a, w: jnp.abs(jnp.floor((x - a) / w)), A),
    "clock": (lambda x, t, a, w: jnp.abs(t - a) - w, A - W),
    "window of time": (lambda x, t, a, w: jnp.where((t > a) & (t < a + w), -1.0, 1.0), A),
    "smaller of two": (lambda x, t, a, w: jnp.minimum(1.0, jnp.abs(x - a) - w), A - W),
    "root of a square": (lambda x, t, a, w: jnp.sqrt((x - a) ** 2) - w, A - W),
    "fresh start": (lambda x, t, a, w: jnp.where(x > a, x - a - w, 1.0), A),
    "scaled": (lambda x, t, a, w: (jnp.abs(x - a) - w) * (2.0 + x), A - W),
    "either of two": (lambda x, t, a, w: jnp.minimum(jnp.abs(x - a), jnp.abs(x - 1.5)) - w, A - W),
}
USUAL = ("distance", "window", "clock")


def scene_of(kind: str):
    value, _ = KINDS[kind]

    class Passing(OnLine):
        a: float = jj.parameter(A)
        w: float = jj.parameter(W)

        def events(self, motion):
            return {"met": value(motion.q.x, motion.t, self.a, self.w), "far": 30.0 - jnp.abs(motion.q.x)}

    return Passing


@pytest.mark.parametrize("kind", [kind if kind in USUAL else pytest.param(kind, marks=pytest.mark.slow) for kind in KINDS])
def test_a_short_window_is_met(kind):
    scene, start = scene_of(kind)(), {"x": 0.0, "x_rate": 1.0}
    assert jj.lower(scene).event_relations
    for backend in BACKENDS:
        motion = jj.simulate(scene, start, ts=[2.0], backend=backend)
        assert motion.event_names[int(motion.event)] == "met"
        assert abs(float(motion.t_end) - KINDS[kind][1]) < 1e-9
    lanes = jj.rollout(scene, {"x": 0.0, "x_rate": jnp.linspace(0.5, 1.5, 7)}, ts=[4.0], progress=False).lanes
    np.testing.assert_array_equal(lanes.result, results.EVENT)


@pytest.mark.parametrize("derivative", [jax.grad, jax.jacfwd])
def test_the_time_of_a_short_window_has_derivatives(derivative):
    def time(a):
        return jj.simulate(scene_of("distance")(a=a), {"x": 0.0, "x_rate": 1.0}, ts=[2.0]).t_end

    assert abs(derivative(time)(A) - 1.0) < 1e-8


def test_values_with_a_peak_where_a_relation_changes_are_not_watched():
    """As of a disc that falls to either side, or of a rod between two walls."""

    class Leaning(scene_of("distance")):
        def events(self, motion):
            return {"low": 1.5 - jnp.abs(motion.q.x), "walls": jnp.minimum(2.0 - motion.q.x, motion.q.x + 2.0)}

    assert jj.lower(Leaning()).event_relations == ()
    assert jj.lower(jj.models.TiltingDisc()).event_relations == jj.lower(jj.models.WhippleBicycle()).event_relations == ()
