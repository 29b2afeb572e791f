"""Speeds of a scene's own in which rates of coordinates become infinite: motions that come there end with a code."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import result_codes as results

import jourdain_jax as jj

# the rate of the coordinate a for the speed w, and whether it becomes infinite between 1 and -1
RATES = {
    "sine": (lambda a, w: w / jnp.sin(a), True),
    "coordinate": (lambda a, w: w / a, True),
    "shifted": (lambda a, w: w / (a - 0.2), True),
    "tangent": (lambda a, w: w * jnp.tan(0.5 * jnp.pi + a), True),
    "power": (lambda a, w: 2.0 * w * a**-3, True),
    "squared": (lambda a, w: w / (1.0 - jnp.cos(a)), True),
    "regular": (lambda a, w: w / (1.0 + a**2), False),
    "cosine": (lambda a, w: w / jnp.cos(a), False),
    "chosen": (lambda a, w: w * jnp.where(jnp.abs(a) < 1e-9, 1.0, a) / jnp.where(jnp.abs(a) < 1e-9, 1.0, jnp.sin(a)), False),
}


def _scene(rate):
    class Sliding(jj.Scene):
        """A mass on a way, its speed measured in a scale of its own."""

        coordinates = jj.coordinates("a x")
        speeds = jj.speeds("w v")

        def coordinate_rates(self, t, q, u):
            return jnp.stack([rate(q.a, u.w), u.v])

        def bodies(self, t, q):
            return {"mass": jj.Particle(1.0, jnp.stack([q.a, q.x, 0.0 * q.x]))}

    return Sliding()


def _codes(kind, backend, solver=None):
    """Of lanes that go through a = 0, and the other way."""
    rate, lost = RATES[kind]
    scene = _scene(rate)

    def one(a_rate):
        start = {"a": 1.0, "w": a_rate / rate(1.0, 1.0), "v": 0.3}
        return jj.simulate(scene, start, ts=[1.0], backend=backend, solver=solver).result

    inward = np.asarray(jax.jit(jax.vmap(one))(jnp.linspace(-1.5, -1.3, 8 if backend == "dense" else 64)))
    return inward, int(one(0.1)), lost


SLOW = [(kind, "xla", None) for kind in RATES] + [(kind, "native", jj.Taylor()) for kind in ("sine", "regular")]
CASES = [(kind, "native", None) for kind in RATES] + [(kind, "dense", None) for kind in ("shifted", "power", "squared", "regular")]


@pytest.mark.parametrize("case", [*CASES, *(pytest.param(c, marks=pytest.mark.slow) for c in SLOW)], ids=str)
def test_lanes_that_go_through_end_with_a_code_and_others_arrive(case):
    inward, away, lost = _codes(*case)
    assert set(inward.tolist()) == {results.SINGULAR_PARTITION if lost else results.SUCCESS}
    assert away == results.SUCCESS


def test_a_single_motion_says_why_it_ended():
    motion = jj.simulate(_scene(RATES["sine"][0]), {"a": 1.0, "w": -1.0}, t1=3.0)
    assert int(motion.result) == results.SINGULAR_PARTITION
    assert "infinite" in motion.message
    assert float(motion.t_end) < np.sin(1.0)  # a = 0 is met before, as w falls no faster than sin(a)
