"""Motions that are no answer end with a result code: rows that contradict each other, energy that is lost,
rates that become infinite.
"""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import result_codes as results
from numpy.testing import assert_allclose
from small_scenes import OnLine, OnPlane

import jourdain_jax as jj

# Velocity rows that depend on each other and follow inputs or time: motions on which they contradict each
# other have a result code, others do not.


class TwoBelts(OnPlane):
    """A block on two belts, which must run equally fast."""

    inputs = jj.inputs("first second")
    mass: float = jj.parameter(1.0, positive=True)

    def velocity_constraints(self, motion):
        return {
            "first": motion.u.x_rate - motion.inputs.first,
            "second": 10.0 * (motion.u.x_rate - motion.inputs.second),
        }


class Circling(OnPlane):
    """A point whose speed is held twice: at one, and at what an input says."""

    inputs = jj.inputs("speed")

    def velocity_constraints(self, motion):
        squared = motion.u.x_rate**2 + motion.u.y_rate**2
        return {"one": squared - 1.0, "said": squared - motion.inputs.speed**2}


def belts(off):
    return {"first": lambda t: jnp.sin(t), "second": lambda t: jnp.sin(t) + off * t}


def driven(off, speed=1.0, **way):
    return jj.simulate(TwoBelts(), {"y_rate": speed}, ts=[0.5, 1.0], inputs=belts(off), **way)


def test_rows_that_contradict_each_other_later_are_told():
    right, wrong = map(jax.jit(driven), (0.0, 0.5))
    assert (right.result, wrong.result) == (results.SUCCESS, results.CONTRADICTORY_ROWS)
    assert_allclose(right.q_end, [1.0 - np.cos(1.0), 1.0], rtol=1e-7)


def test_nonlinear_rows_are_told_as_well():
    run = lambda gain: jj.simulate(
        Circling(), {"x_rate": 1.0}, ts=[1.0], inputs={"speed": lambda t: 1.0 + gain * t}
    )
    assert run(0.0).result == results.SUCCESS
    assert int(run(1.0).result) != results.SUCCESS


def test_what_long_steps_violate_is_no_contradiction():
    formulation = jj.Formulation("full", stabilisation=None)
    long = {"solver": diffrax.Heun(), "rtol": 1e3, "atol": 1e3, "max_step": np.inf, "work": False}
    motion = jj.simulate(
        TwoBelts(), {"y_rate": 1.0}, ts=[1.0], inputs=belts(0.0), formulation=formulation, **long
    )
    assert jnp.max(jnp.abs(motion.residuals()[1])) > 0.3  # of 10 sin(1)
    assert motion.result == results.SUCCESS


# A motion whose energy changes by more than its steps explain has a result code, inside `jit` and in every
# lane; right motions never have it.


class Step(OnPlane):
    """A particle that flies over an edge of the potential, `height` (J) high and `width` (m) wide, at x = 1
    m.
    """

    height: float = jj.parameter(2.0)
    width: float = jj.parameter(1e-9)

    def potential(self, pose):
        return self.height * jax.nn.sigmoid((pose.q.x - 1.0) / self.width)


class Spring(OnLine):
    """An oscillator."""

    k: float = jj.parameter(4.0)
    level: float = jj.parameter(0.0)

    def potential(self, pose):
        return self.level + 0.5 * self.k * pose.q.x**2


class WrongPotential(Spring):
    """A load whose potential is not that of its force."""

    def potential(self, pose):
        return None

    def loads(self, motion):
        x = motion.q.x
        return jj.Load(generalized={"x_rate": -self.k * x}, potential=self.k * x**2)


WAYS = ({}, {"backend": "xla"}, {"backend": "dense"})
SPEEDS = np.array([0.5, 3.0, 4.0, -1.0])  # m/s; the first and the last never come to the edge


CODES = [results.SUCCESS, results.ENERGY_LOST, results.ENERGY_LOST, results.SUCCESS]


def passing(v, **way):
    return jj.simulate(Step(), {"x_rate": v, "y_rate": 1.0}, ts=[1.5], **way).result


@pytest.mark.parametrize("way", WAYS)
def test_a_feature_that_steps_pass_over_is_told_by_the_energy(way):
    assert jax.jit(jax.vmap(lambda v: passing(v, **way)))(SPEEDS).tolist() == CODES


def test_an_edge_that_steps_can_follow_is_passed():
    motion = jj.simulate(Step(width=0.05), {"x_rate": 3.0, "y_rate": 1.0}, ts=[1.5])
    assert motion.result == results.SUCCESS
    assert_allclose(motion.u_end[0], np.sqrt(9.0 - 4.0), rtol=1e-6)


def test_a_potential_that_is_not_that_of_its_force_is_told():
    motion = jj.simulate(WrongPotential(), {"x": 1.0}, ts=[0.7])
    assert motion.result == results.ENERGY_LOST
    with pytest.raises(jj.SimulationError, match="energy"):
        motion.raise_if_failed()


@pytest.mark.parametrize(
    ("amplitude", "level", "tolerance"),
    [(1.0, 0.0, 1e-2), (1e-9, 0.0, 1e-6), (1e-3, 1e12, 1e-6), (0.0, 0.0, 1e-3), (1e6, -1e3, 1e-4)],
)
@pytest.mark.parametrize("k", [4.0, 1e6])
def test_errors_that_the_tolerance_allows_are_not_told(amplitude, level, tolerance, k):
    scene, turns = Spring(k, level), 40 * np.pi / np.sqrt(k)
    for ts in ([turns], np.linspace(0.1, 1.0, 7) * turns):
        motion = jj.simulate(scene, {"x": amplitude}, ts=ts, rtol=tolerance, atol=tolerance)
        assert motion.result == results.SUCCESS


class Damped(Spring):
    """Overdamped: large powers, and little work in the end."""

    def potential(self, pose):
        return None

    def loads(self, motion):
        q, u = motion.q, motion.u
        return jj.generalized_force(motion, x_rate=-self.k * q.x - 5.0 * jnp.sqrt(self.k) * u.x_rate)


@pytest.mark.parametrize("k", [1e4, 1e7])
def test_where_work_is_integrated_nothing_is_told(k):
    assert jj.simulate(Damped(k), {"x": 0.7}, ts=[2.0, 6.0]).result == results.SUCCESS


def test_steps_without_control_are_taken_as_they_are():
    motion = jj.simulate(Spring(), {"x": 1.0}, ts=[40.0], solver=jj.ImplicitMidpoint(step=0.5))
    assert motion.result == results.SUCCESS


# Speeds of a scene's own in which rates of coordinates become infinite: motions that come there end with a
# code.


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
    "chosen": (
        lambda a, w: w * jnp.where(jnp.abs(a) < 1e-9, 1.0, a) / jnp.where(jnp.abs(a) < 1e-9, 1.0, jnp.sin(a)),
        False,
    ),
}


def _scene(rate):
    class Sliding(jj.Scene):
        """A mass on a way, its speed measured in a scale of its own."""

        coordinates = jj.coordinates("a x")
        speeds = jj.speeds("w v")

        def coordinate_rates(self, t, q, u):
            return jnp.stack([rate(q.a, u.w), u.v])

        def bodies(self, t, q):
            return {"mass": jj.Particle(1.0, [q.a, q.x, 0.0])}

    return Sliding()


def _codes(kind, backend, solver=None):
    """Of lanes that go through a = 0, and the other way."""
    rate, lost = RATES[kind]
    scene = _scene(rate)

    def one(a_rate):
        start = {"a": 1.0, "w": a_rate / rate(1.0, 1.0), "v": 0.3}
        return jj.simulate(scene, start, ts=[1.0], backend=backend, solver=solver).result

    *inward, away = jax.jit(jax.vmap(one))(
        np.append(np.linspace(-1.5, -1.3, 7 if backend == "dense" else 63), 0.1)
    ).tolist()
    return inward, away, lost


CASES = [(kind, "native", None) for kind in RATES]
CASES += [(kind, backend, None) for kind in ("shifted", "regular") for backend in ("xla", "dense")]
CASES += [(kind, "native", jj.Taylor()) for kind in ("sine", "regular")]


@pytest.mark.parametrize("case", CASES, ids=str)
def test_lanes_that_go_through_end_with_a_code_and_others_arrive(case):
    inward, away, lost = _codes(*case)
    assert set(inward) == {results.SINGULAR_PARTITION if lost else results.SUCCESS}
    assert away == results.SUCCESS


def test_a_single_motion_says_why_it_ended():
    motion = jj.simulate(_scene(RATES["sine"][0]), {"a": 1.0, "w": -1.0}, t1=3.0)
    assert motion.result == results.SINGULAR_PARTITION
    assert "infinite" in motion.message
    assert motion.t_end < np.sin(1.0)  # a = 0 is met before, as w falls no faster than sin(a)
