"""Inputs: what they are at the start counts in the start, their rates in the balance of energy, and steps end
at the knots of samples.
"""

from itertools import pairwise

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose
from refusals import refused
from scipy.integrate import solve_ivp
from small_scenes import OnLine, OnPlane

import jourdain_jax as jj
from jourdain_jax.models import ChaplyginSleigh

# Inputs: what they are at the start counts in the start, and their rates in the balance of energy.


class OnBelt(OnPlane):
    """A bead that slides across a belt; the belt, at the speed of an input, carries it along faster the
    farther out it is.
    """

    mass: float = jj.parameter(2.0, unit="kg", positive=True)
    inputs = jj.inputs("speed push")
    domain = {"y": (-0.4, 0.4)}

    def loads(self, motion):
        return jj.generalized_force(motion, y_rate=motion.inputs.push)

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
    assert_allclose(start["x_rate"], 1.5 * 3.0, rtol=1e-14)
    assert start.residual < 1e-14
    assert jj.start(OnBelt(), t0=2.0, y=0.5)["x_rate"] == 0.0


def test_given_values_are_compared_with_the_rows_at_the_inputs():
    kept = jj.start(OnBelt(), y=0.5, x_rate=4.5, inputs={"speed": 3.0})
    assert (kept["x_rate"], kept["y"]) == (4.5, 0.5)
    refused(
        r"violates constraint `belt`: residual 1.5 remains",
        jj.start,
        OnBelt(),
        y=0.5,
        x_rate=4.5,
        inputs={"speed": 2.0},
    )
    refused(r"violates constraint `belt`: residual 4.5 remains", jj.start, OnBelt(), y=0.5, x_rate=4.5)


def test_a_start_follows_its_inputs_smoothly_and_in_batches():
    def carried(speed):
        return jj.start(OnBelt(), y=0.5, inputs={"speed": speed})["x_rate"]

    assert_allclose(jax.jit(jax.vmap(jax.grad(carried)))(jnp.array([1.0, 3.0])), 1.5, rtol=1e-14)


def test_a_scene_without_inputs_takes_none_in_a_start():
    refused("`ChaplyginSleigh` has no input `force`", jj.start, ChaplyginSleigh(), inputs={"force": 1.0})


# Potentials that depend on inputs. --------------------------------------------------------------------------


class PulledBead(OnLine):
    """A bead between a spring to the origin and one, stiffening in time, to a hand at the place of an input;
    a damper besides.
    """

    mass: float = jj.parameter(2.0, unit="kg", positive=True)
    stiffness: float = jj.parameter(18.0, unit="N/m")
    stiffening: float = jj.parameter(5.0, unit="N/m/s")
    damping: float = jj.parameter(0.5, unit="N s/m")
    inputs = jj.inputs("push hand")
    example = {"x": 0.2}

    def loads(self, motion):
        bead, hand = motion["mass"].point(), jnp.stack([motion.inputs.hand, 0.0, 0.0])
        return (
            jj.spring(bead, jj.fixed_point((0.0, 0.0, 0.0)), self.stiffness),
            jj.spring(bead, jj.fixed_point(hand), self.stiffness + self.stiffening * motion.t),
            jj.generalized_force(motion, x_rate=motion.inputs.push - self.damping * motion.u.x_rate),
        )


KNOTS, PLACES = np.array([0.0, 0.3, 0.7, 1.5]), np.array([0.0, 0.4, -0.1, 0.2])
SPAN = np.linspace(0.0, 1.5, 6)


def work_by_quadrature():
    """The work on the bead by integrating the power of hand, clock, damper and push, from one knot of the
    hand's path or time of `SPAN` to the next.
    """
    m, k, s, c = 2.0, 18.0, 5.0, 0.5
    y, works = np.array([0.2, 0.0, 0.0]), [0.0]
    for start, end in pairwise(np.union1d(KNOTS, SPAN)):
        first, last = np.interp([start, end], KNOTS, PLACES)
        slope = (last - first) / (end - start)

        def rates(t, y, start=start, first=first, slope=slope):
            x, v, _ = y
            stretch = x - (first + slope * (t - start))
            force = 0.7 - c * v
            pull = (k + s * t) * stretch
            return [v, (force - k * x - pull) / m, force * v + 0.5 * s * stretch**2 - pull * slope]

        y = solve_ivp(rates, (start, end), y, "DOP853", rtol=1e-13, atol=1e-14).y[:, -1]
        works += [y[2]] if end in SPAN else []
    return np.array(works)


@pytest.mark.parametrize(
    "options",
    [{}, {"backend": "dense"}, {"formulation": jj.Formulation("full")}],
    ids=["lowered", "dense", "full state"],
)
def test_the_work_of_a_sampled_input_in_a_potential_is_that_of_a_quadrature(options):
    inputs = {"hand": jj.Sampled(KNOTS, PLACES), "push": 0.7}
    motion = jj.simulate(
        PulledBead(), ts=SPAN, rtol=1e-11, atol=1e-11, inputs=inputs, **options
    ).raise_if_failed()
    work = work_by_quadrature()
    # the solver's steps cross the kinks of the hand's path, where its order is lost
    assert_allclose(motion.work, work, atol=1e-8 * np.max(np.abs(work)))
    balance = np.asarray(motion.energies().balance)
    assert_allclose(balance, balance[0], atol=1e-8 * np.max(np.abs(work)))


def test_an_input_that_jumps_does_the_work_of_moving_the_spring_at_once():
    jumps = {"hand": lambda t: jnp.where(t < 0.5, 0.1, 0.3)}
    scene = PulledBead(damping=0.0, stiffening=0.0, stiffness=18.0)
    motion = jj.simulate(
        scene, ts=[0.0, 0.5 - 1e-9, 0.5, 1.0], rtol=1e-10, atol=1e-10, inputs=jumps
    ).raise_if_failed()
    before, after = (0.5 * 18.0 * (motion["x"][2] - hand) ** 2 for hand in (0.1, 0.3))
    assert_allclose(motion.work, [0.0, 0.0, after - before, after - before], atol=1e-7)
    balance = np.asarray(motion.energies().balance)
    assert_allclose(balance, balance[0], atol=1e-7)


def test_potentials_that_depend_on_inputs_are_found_and_named():
    assert jj.structure_of(PulledBead()).potentials_of_inputs == (1,)
    assert "potentials that depend on inputs" in jj.analysis.energy_balance(PulledBead()).changed_by
    assert jj.structure_of(OnBelt()).potentials_of_inputs == ()


# Rows that depend on inputs. --------------------------------------------------------------------------------


class Towed(OnPlane):
    """A particle on a belt at 45 degrees, which moves along y at the speed of an input."""

    inputs = jj.inputs("speed")

    def velocity_constraints(self, motion):
        return {"belt": motion.u.y_rate - motion.u.x_rate - motion.inputs.speed}


@pytest.mark.parametrize(
    "options", [{}, {"formulation": jj.Formulation("full")}], ids=["minimal", "full state"]
)
def test_rates_of_inputs_in_rows_accelerate_and_do_work(options):
    motion = jj.simulate(
        Towed(), {"x_rate": 1.0}, t1=2.0, rtol=1e-9, atol=1e-9, inputs={"speed": lambda t: t**2}, **options
    ).raise_if_failed()
    # x'' + y'' = 0, y'' - x'' = 2 t
    assert_allclose(motion.u_end, [-1.0, 3.0], atol=1e-8)
    assert_allclose(motion.q_end, [2.0 - 4.0 / 3.0, 2.0 + 4.0 / 3.0], atol=1e-7)
    assert_allclose(motion.work[-1], 4.0, atol=1e-7)
    assert_allclose(motion.accelerations().udot[-1], [-2.0, 2.0], atol=1e-8)


JUMPS = {
    "a branch": lambda t: jnp.where(t < 1.0, 0.0, 1.0),
    "steps": lambda t: 0.1 * jnp.floor(3.0 * t),
    "a pulse": lambda t: jnp.where(jnp.abs(t - 0.5) < 0.1, 1.0, 0.0),
    "a comparison": lambda t: t >= 1.0,
    "turns of a loop": lambda t: jax.lax.fori_loop(
        0, jnp.floor(3.0 * t).astype(int), lambda _, x: x + 0.1, 0.0
    ),
}


@pytest.mark.parametrize("way", JUMPS)
def test_an_input_of_a_row_that_jumps_is_refused(way):
    for motions, rates in ((jj.simulate, 1.0), (jj.rollout, np.array([1.0, 2.0]))):
        refused(
            r"input `speed` of `Towed` jumps at t = .* s, but velocity constraints depend on it",
            motions,
            Towed(),
            {"x_rate": rates},
            t1=2.0,
            inputs={"speed": JUMPS[way]},
        )


def test_an_input_of_a_row_that_has_no_derivative_is_refused():
    def measured(t):
        return jax.pure_callback(lambda t: np.asarray(t) ** 2, jax.ShapeDtypeStruct((), t.dtype), t)

    refused(
        "constraints depend on inputs and need their rates",
        jj.simulate,
        Towed(),
        {"x_rate": 1.0},
        t1=2.0,
        inputs={"speed": measured},
    )


# Inputs given by samples: steps end at their knots, so that no feature is passed over, however short it is
# and at whatever tolerance.


class Struck(OnLine):
    """A mass without other forces that an input strikes."""

    mass: object = jj.parameter(2.0, positive=True)
    inputs = jj.inputs("force push")

    def loads(self, motion):
        return jj.generalized_force(motion, x_rate=motion.inputs.force + motion.inputs.push)


BLOW = jj.Sampled([0.0, 2.0137, 2.0142, 2.0147, 10.0], [0.0, 0.0, 2000.0, 0.0, 0.0])  # 1 N s about 2.0142 s
LOOPS = {
    "lean": {},
    "diffrax": {"solver": diffrax.Bosh3(), "rtol": 1e-6, "atol": 1e-6},
    "implicit": {"solver": jj.RadauIIA()},
    "equal steps": {"solver": jj.ImplicitMidpoint(step=1.0)},
    "dense matrices": {"backend": "dense"},
}


@pytest.mark.parametrize("options", LOOPS.values(), ids=LOOPS)
def test_a_hammer_blow_of_a_millisecond_is_felt_in_every_loop(options):
    motion = jj.simulate(
        Struck(), t1=10.0, inputs={"force": BLOW}, work=False, **({"ts": [10.0]} | options)
    ).raise_if_failed()
    if not isinstance(options.get("solver"), jj.ImplicitMidpoint):
        assert_allclose(motion.q_end[0], 0.5 * (10 - 2.0142), rtol=1e-9)
    assert_allclose(motion.u_end[0], 0.5, rtol=1e-9)


CLOCK, FORCE, PUSH = (
    np.linspace(0.0, 2.0, 6),
    np.array([0.3, -1.0, 0.8, 0.5, -0.7, 0.2]),
    np.array([-0.4, 0.6, 0.1, -0.9, 0.7, 0.5]),
)
MODES = {
    "reverse": ({}, jax.grad),
    "forward": ({}, jax.jacfwd),
    "diffrax": ({"solver": diffrax.Tsit5()}, jax.grad),
}


def rate_of_late(values, t0, t1):
    """-int (t1 - t) dF/dt dt: what a delay of the force F on a mass of 1 kg does to its place at t1."""
    knots, slopes = CLOCK, np.diff(values) / np.diff(CLOCK)
    a, b = (np.clip(knots[:-1], *sorted((t0, t1))), np.clip(knots[1:], *sorted((t0, t1))))
    return -np.sign(t1 - t0) * np.sum(slopes * (b - a) * (t1 - (a + b) / 2))


@pytest.mark.parametrize(("options", "slope"), MODES.values(), ids=MODES)
@pytest.mark.parametrize(("t0", "t1"), [(0.0, 2.0), (1.6, 0.0)])
@pytest.mark.parametrize("times", [11, 2], ids=["saved at the knots", "two inputs by one clock"])
def test_a_delay_of_one_input_has_its_derivative_where_knots_meet_each_other_and_saved_times(
    options, slope, t0, t1, times
):
    def end(late):
        inputs = {"force": jj.Sampled(CLOCK + late, FORCE), "push": jj.Sampled(CLOCK, PUSH)}
        asked = {"inputs": inputs, "rtol": 1e-5, "atol": 1e-5, "work": False, "backend": "xla"} | options
        motion = jj.simulate(Struck(mass=1.0), {}, t0=t0, ts=np.linspace(t0, t1, times), **asked)
        return motion["x"][-1]

    assert_allclose(jax.jit(slope(end))(0.0), rate_of_late(FORCE, t0, t1), rtol=1e-9)
