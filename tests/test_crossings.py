"""What acts in a part of the way is not stepped over: relations are watched over each step, and no step is
longer than a part of the span.
"""

from collections.abc import Callable

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import result_codes as results
from machine_code import BACKENDS
from numpy.testing import assert_allclose
from refusals import refused
from small_scenes import OnLine, OnPlane

import jourdain_jax as jj

# Relations of loads, poses, inputs and rows are watched over each step: what acts in a part of the way is not
# stepped over.


class Sliding(jj.Scene):
    """A bead that slides freely but for what acts between `a` and `a + width` of its way, or of time:
    `law(scene, t, x, v)` is its force.
    """

    a: float = jj.parameter(0.7)
    width: float = jj.parameter(0.03)
    law: Callable = eqx.field(static=True, default=lambda s, t, x, v: 0 * x)
    coordinates = jj.coordinates("x")

    def bodies(self, t, q):
        return {"bead": jj.Particle(1.0, [q.x, 0.0, self.height(q.x)])}

    def height(self, x):
        return 0 * x

    def loads(self, motion):
        return (
            jj.generalized_force(motion, x_rate=self.law(self, motion.t, motion.q.x, motion.u.x_rate)),
            jj.gravity(motion, 9.81),
        )


class Bump(Sliding):
    """A speed bump in the way of the bead, with slopes of zero at its ends."""

    def height(self, x):
        s = (x - self.a) / self.width
        return jnp.where((s > 0) & (s < 1), 0.3 * self.width * (1 - jnp.cos(2 * jnp.pi * s)), 0.0)


def rises_and_falls(step):
    """A force between two places by a function that steps up."""
    return lambda s, t, x, v: -3.0 * (step(x - s.a) - step(x - s.a - s.width))


KINDS = {
    "Strip": lambda s, t, x, v: jnp.where((x > s.a) & (x < s.a + s.width), -3.0, 0.0),
    "StripByDistance": lambda s, t, x, v: jnp.where(
        jnp.abs(x - s.a - 0.5 * s.width) < 0.5 * s.width, -3.0 * v, 0.0
    ),
    "Pulse": lambda s, t, x, v: jnp.where((t > s.a) & (t < s.a + s.width), 20.0, 0.0),
    "Hat": lambda s, t, x, v: -40.0 * jnp.maximum(0.0, 1.0 - jnp.abs((x - s.a) / s.width - 0.5) * 2),
    "Signs": rises_and_falls(jnp.sign),
    "Floors": rises_and_falls(lambda x: jnp.floor(x + 7.0)),
}
# a step of usual length passes several whole numbers; and choices by other functions of JAX
OTHER = {
    "Whole": lambda s, t, x, v: jnp.where(jnp.floor((x - s.a) / s.width) == 0, -3.0, 0.0),
    "Ceil": lambda s, t, x, v: jnp.where(jnp.ceil((s.a - x) / s.width) == 0, -3.0, 0.0),
    "Rounded": lambda s, t, x, v: -3.0 * (jnp.round((x - s.a) / s.width) == 0),
    "Stripes": lambda s, t, x, v: -3.0 * (jnp.remainder(x - s.a, 0.9) < s.width),
    "FineStripes": lambda s, t, x, v: jnp.where(jnp.mod(x, s.width) < 0.3 * s.width, -0.3, 0.0),
    "Select": lambda s, t, x, v: jnp.select([x < s.a, x < s.a + s.width], [0 * x, -3.0 + 0 * x]),
    "Cond": lambda s, t, x, v: jax.lax.cond(
        (x > s.a) & (x < s.a + s.width), lambda x: -3.0 * x, lambda x: 0 * x, x
    ),
    "Relu": lambda s, t, x, v: -60 * jax.nn.relu(s.width - jax.nn.relu(x - s.a)) * (x > s.a),
}
KINDS, OTHER = ({kind: Sliding(law=law) for kind, law in laws.items()} for laws in (KINDS, OTHER))
KINDS["Bump"], STRIP = Bump(), KINDS["Strip"]
START, SPAN = {"x": 0.0, "x_rate": 1.0}, 2.0


def motion(scene, start=START, **options):
    return jj.simulate(scene, start, **{"ts": [SPAN], "rtol": 1e-9, "atol": 1e-9} | options)


ON_ARRAYS = ("FineStripes", "Select")


@pytest.mark.parametrize("kind", KINDS | OTHER)
def test_what_acts_in_a_part_of_the_way_is_met_by_the_same_steps_of_both_loops(kind):
    # at tight tolerances round-off alone sets the length of steps of a free bead
    scene, loose = (KINDS | OTHER)[kind], {"rtol": 1e-6, "atol": 1e-6}
    exact = motion(scene, max_step=SPAN / 2000, **loose)
    found = [
        motion(scene, backend=backend, **loose) for backend in BACKENDS[0 if kind in ON_ARRAYS else -1 :]
    ]
    assert abs(exact.q_end[0] - SPAN) > 5e-3, "nothing acted"
    for one in found:
        assert_allclose(one.q_end, exact.q_end, atol=1e-5)
        assert one.crossings == int(exact.crossings) >= 2
        assert (int(one.accepted), int(one.rejected)) == (int(found[0].accepted), int(found[0].rejected))


@pytest.mark.parametrize("kind", KINDS)
def test_neighbours_in_lanes_are_right(kind):
    generator = np.random.default_rng(5)
    a, width = generator.uniform(0.2, 1.4, 200), 10 ** generator.uniform(-4, -0.5, 200)
    options = {
        "parameters": {"a": a, "width": width},
        "ts": [SPAN],
        "rtol": 1e-8,
        "atol": 1e-8,
        "progress": False,
    }
    found = jj.rollout(KINDS[kind], START, **options)
    exact = jj.rollout(KINDS[kind], START, **options | {"max_step": 1e-4, "rtol": 1e-10, "atol": 1e-10})
    assert not exact.failed.size
    wrong = np.abs(found.lanes.q_end - exact.lanes.q_end)[:, 0] > 1e-5
    assert not np.any(wrong)


def test_crossings_are_counted_under_jit_back_in_time_and_by_both_modes_of_derivatives():
    assert jax.jit(lambda: motion(STRIP).crossings)() == 2
    assert motion(STRIP, {"x": 2.0, "x_rate": 1.0}, ts=[-SPAN]).crossings == 2
    assert motion(STRIP, {"x": 0.71, "x_rate": 1.0}).crossings == 1

    def end(x):
        found = motion(STRIP, {"x": x, "x_rate": 1.0})
        return found.q_end[0], found.crossings

    # v^2 = 1 - 6 w beyond the strip, t = a + (1 - v)/3 + s
    v = np.sqrt(1 - 6 * STRIP.width)
    for derivative in (jax.grad, jax.jacfwd):
        slope, count = jax.jit(derivative(end, has_aux=True))(0.0)
        assert count == 2
        assert_allclose(slope, v, atol=1e-12)


class Cart(Sliding):
    inputs = jj.inputs("push")

    def loads(self, motion):
        return (jj.generalized_force(motion, x_rate=motion.inputs.push),)


@pytest.mark.parametrize("backend", BACKENDS)
def test_inputs_that_are_functions_of_time_are_watched(backend):
    found = motion(
        Cart(), inputs={"push": lambda t: jnp.where((t > 0.9) & (t < 0.93), 20.0, 0.0)}, backend=backend
    )
    assert_allclose(found.q_end[0], 2.0 + 0.6 * (2.0 - 0.915), atol=1e-6)
    assert found.crossings == 2


def guarded(s, t, x, v):
    """Guards whose branches agree, and smooth functions of relations."""
    squared = x * x + v * v
    length = jnp.where(squared > 0, jnp.sqrt(jnp.where(squared > 0, squared, 1.0)), 0.0)
    return -length * v - v * jnp.abs(v) + jnp.maximum(x, 0.0) - jnp.maximum(-x, 0.0)


def test_guards_and_smooth_functions_do_not_count():
    scene = Sliding(law=guarded)
    assert jj.lower(scene).relations == ()
    found = motion(scene, {"x": -1.0, "x_rate": 1.5})
    assert found.crossings == 0
    assert not found.unwatched


def test_what_is_not_watched_is_said():
    many = Sliding(law=lambda s, t, x, v: sum(jnp.sign(x - 0.01 * k) for k in range(33)))
    assert jax.eval_shape(lambda: motion(many)).unwatched == "there are 33, more than 32"
    hidden = motion(Sliding(law=lambda s, t, x, v: jnp.interp(x, jnp.array([0.6, 0.7, 0.8]), jnp.eye(3)[1])))
    assert "not monitored: parts of the scene are JAX calls" in str(hidden)
    with pytest.warns(
        UserWarning, match="Heun may step over jumps and kinks in loads or events of `Sliding`; omit `solver`"
    ):
        by_diffrax = motion(STRIP, solver=diffrax.Heun(), rtol=1e-4, atol=1e-4, work=False)
    assert hidden.crossings == int(by_diffrax.crossings) == -1
    assert "the solver is a diffrax solver" in by_diffrax.unwatched


def test_a_motion_that_sticks_names_the_load_that_jumps():
    lanes = jj.rollout(
        Sliding(law=lambda s, t, x, v: -2.0 * jnp.sign(v)),
        {"x_rate": np.array([1.0, 50.0])},
        t1=1.0,
        max_steps=2000,
    )
    assert lanes.result.tolist() == [results.STICKS, results.SUCCESS]
    for text in (lanes.lane(0).message, str(lanes)):
        assert "pushes the motion back onto its jump from both sides" in text
        assert "(the force along `x_rate`)" in text


class Ring(OnPlane):
    def geometric_constraints(self, pose):
        return {"ring": pose.q.x**2 + pose.q.y**2 - 1.0}


@pytest.mark.parametrize("backend", [*BACKENDS, "dense"])
def test_a_tolerance_that_the_precision_does_not_hold_is_the_cause_that_is_told(backend):
    lost = jj.simulate(
        Ring(),
        {"x": 1.0, "y_rate": 1.0},
        ts=[1.0],
        rtol=1e-60,
        atol=1e-60,
        backend=backend,
        formulation=jj.Formulation("full"),
    )
    assert lost.result == results.UNRESOLVED
    assert "`rtol` is below the resolution of this precision" in lost.message


# No step is longer than a part of the span: in machine code, in XLA's loop, by Taylor series and by diffrax;
# the same steps in the first two.


FREE = OnLine()
BEGIN = {"x": 1.0, "x_rate": 0.5}
WAYS = {
    "native": {},
    "xla": {"backend": "xla"},
    "dense": {"backend": "dense"},
    "Taylor": {"solver": jj.Taylor()},
}
WAYS |= {"implicit": {"solver": jj.RadauIIA()}, "diffrax": {"solver": diffrax.Kvaerno3(), "work": False}}


def steps(**options):
    motion = jj.simulate(FREE, BEGIN, ts=[3.0], **options)
    assert np.isclose(float(motion.q_end[0]), 2.5, rtol=1e-9)
    return int(motion.accepted)


@pytest.mark.parametrize("way", WAYS)
def test_steps_are_no_longer_than_a_part_of_the_span(way):
    unbound, usual, short = (
        steps(**WAYS[way], **more) for more in ({"max_step": np.inf}, {}, {"max_step": 0.01})
    )
    assert unbound < 14 <= usual < 40
    assert 300 <= short < 330


def test_a_step_of_one_length_has_its_own_bound():
    refused(
        "`max_step`", jj.simulate, FREE, BEGIN, ts=[3.0], max_step=0.1, solver=jj.ImplicitMidpoint(step=0.1)
    )
