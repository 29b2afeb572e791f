"""A motion that starts at a stop event goes on where the value of the event rises there, as after a bounce; it stops where that falls through zero."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import result_codes as results
from machine_code import BACKENDS
from small_scenes import Upright

import jourdain_jax as jj

G = 9.81


class Ball(Upright):
    """A ball above a floor at `level`, between walls."""

    level: float = jj.parameter(0.0)
    mass = 0.5

    def loads(self, motion):
        return (jj.gravity(motion, G),)

    def events(self, motion):
        return {"floor": motion.q.z - self.level, "walls": 5.0 - jnp.abs(motion.q.x)}


def thrown_back(scene, motion, restitution):
    end = motion.end
    return jj.start(scene, t0=end.t, x=end["x"], z=end["z"], x_rate=end["x_rate"], z_rate=-restitution * end["z_rate"])


@pytest.mark.parametrize(("backend", "level"), [(BACKENDS[-1], 0.0), (BACKENDS[-1], 1e3), ("xla", 0.3)])
def test_bounces_go_on_from_the_end(backend, level):
    scene, restitution = Ball(level), 0.8
    motion = jj.simulate(scene, {"z": level + 1.0, "x_rate": 0.5}, ts=[10.0], backend=backend)
    fall = np.sqrt(2 / G)
    expected = fall
    for k in range(1, 7):
        motion = jj.simulate(scene, thrown_back(scene, motion, restitution), ts=[10.0], backend=backend)
        expected += 2 * fall * restitution**k
        assert motion.event_names[int(motion.event)] == "floor"
        assert abs(float(motion.t_end) - expected) < 1e-9 * max(1.0, level)


def test_lanes_and_jit_start_at_an_event():
    starts = {"x": 0.0, "z": 0.0, "z_rate": jnp.array([3.0, 1e-3, 0.0, -1.0]), "x_rate": 0.1}
    for backend in BACKENDS:
        lanes = jj.rollout(Ball(), starts, ts=[2.0], backend=backend, progress=False).lanes
        np.testing.assert_array_equal(lanes.result, results.EVENT)
        np.testing.assert_allclose(lanes.t_end, [6 / G, 2e-3 / G, 0.0, 0.0], atol=1e-9)
        assert int(jnp.sum(lanes.accepted[2:])) == 0
    one = jax.jit(lambda rate: jj.simulate(Ball(), {"z": 0.0, "z_rate": rate}, ts=[2.0]).t_end)(2.0)
    assert abs(float(one) - 4 / G) < 1e-9


def test_back_in_time_a_value_rises_where_its_rate_is_negative():
    motion = jj.simulate(Ball(), {"z": 0.0, "z_rate": -2.0}, ts=[-2.0])
    assert abs(float(motion.t_end) + 4 / G) < 1e-9
    assert float(jj.simulate(Ball(), {"z": 0.0, "z_rate": 2.0}, ts=[-2.0]).t_end) == 0.0


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("derivative", [jax.grad, jax.jacfwd])
def test_derivatives_go_through_bounces(backend, derivative):
    options = {"ts": [10.0], "backend": backend}

    def second(height):
        first = jj.simulate(Ball(), {"z": height}, **options)
        return jj.simulate(Ball(), thrown_back(Ball(), first, 0.8), **options).t_end

    found = derivative(second)(1.0)
    assert abs(found - 2.6 * np.sqrt(1 / (2 * G))) < 1e-7


@pytest.mark.parametrize("height", [0.0, -1e-13, 1e-13])
def test_a_bounce_that_is_over_has_happened(height):
    """Whatever round-off is left of the height, and of the speed."""
    for backend in BACKENDS:
        for rate in (0.0, 1e-14, 1e-12):
            motion = jj.simulate(Ball(), {"z": height, "z_rate": rate}, ts=[1.0], backend=backend)
            assert motion.event_names[int(motion.event)] == "floor"
            assert float(motion.t_end) < 1e-6
    below = jj.simulate(Ball(), {"z": -1e-3, "z_rate": 5.0}, ts=[1.0])
    assert float(below.t_end) == 0.0


def test_solvers_of_diffrax_start_at_an_event_too():
    for solver in (diffrax.Tsit5(), diffrax.Bosh3()):
        motion = jj.simulate(Ball(), {"z": 0.0, "z_rate": 3.0}, ts=[2.0], solver=solver)
        assert abs(float(motion.t_end) - 6 / G) < 1e-6
        assert float(jj.simulate(Ball(), {"z": 0.0, "z_rate": -3.0}, ts=[2.0], solver=solver).t_end) == 0.0
