"""Events after which a motion goes on: states that jump, modes that switch, and derivatives through both, in
both modes and to the second order.
"""

import functools

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from derivatives import with_value
from numpy.testing import assert_allclose, assert_array_equal, assert_array_less
from result_codes import ZENO
from small_scenes import OnLine

import jourdain_jax as jj

TIGHT = {"rtol": 1e-12, "atol": 1e-12}


class Ball(jj.Scene):
    """A ball that falls on a floor and bounces: v+ = -e v-."""

    bounce: float = jj.parameter(0.7, non_negative=True)
    gravity: float = jj.parameter(9.81)
    coordinates = jj.coordinates("z")

    def bodies(self, t, q):
        return {"ball": jj.Particle(1.0, [0.0, 0.0, q.z])}

    def loads(self, motion):
        return jj.gravity(motion, self.gravity)

    def events(self, motion):
        return {"floor": jj.Event(motion.q.z, jump={"z_rate": -self.bounce * motion.u.z_rate})}


class Switching(jj.Scene):
    """A block on springs of two stiffnesses: events depend on time, state and parameters, and move
    coordinates, speeds and modes.
    """

    mass: float = jj.parameter(1.3, positive=True)
    stiff: float = jj.parameter(4.0)
    soft: float = jj.parameter(1.5)
    limit: float = jj.parameter(0.3)
    kept: float = jj.parameter(0.8)
    kick: float = jj.parameter(0.05)
    drag: float = jj.parameter(0.2)
    coordinates = jj.coordinates("x y")
    inputs = jj.inputs("push")
    modes = jj.modes(spring=("stiff", "soft"), side=("in", "out"))

    def bodies(self, t, q):
        return {"block": jj.Particle(self.mass, [q.x, q.y, 0.0])}

    def loads(self, motion):
        q, u, spring, side = motion.q, motion.u, motion.modes.spring, motion.modes.side
        along_x = -(self.stiff * (1 - spring) + self.soft * spring) * q.x - self.drag * u.x_rate * (
            1 + spring
        )
        along_x = along_x + motion.inputs.push + 0.3 * jnp.cos(2 * motion.t)
        return jj.Load(forces={"block": jnp.stack([along_x, 0.5 * side * q.x - 2.0 * q.y, 0.0 * q.x])})

    def events(self, motion):
        q, u, t, spring = motion.q, motion.u, motion.t, motion.modes.spring
        over = {"x_rate": self.kept * u.x_rate + self.kick * t * q.y}
        back = {"y_rate": -self.kept * u.y_rate, "y": q.y + 0.01 * (1 + u.x_rate**2)}
        return {
            "over": jj.Event(jnp.where(spring == 0, self.limit - q.x, 1.0), to={"spring": "soft"}, jump=over),
            "under": jj.Event(
                jnp.where(spring == 1, q.x - 0.1 * self.limit * (1 + 0.1 * t), 1.0),
                to={"spring": "stiff", "side": "out"},
            ),
            "y": jj.Event(q.y + 0.3, jump=back),
        }


NUMBERS = np.array([1.3, 4.0, 1.5, 0.3, 0.8, 0.05, 0.2, 0.1, 1.0, 0.4])


def switching(numbers, **options):
    scene = Switching(*(numbers[i] for i in range(7)))
    start = dict(zip(("x", "x_rate", "y"), numbers[7:], strict=True))
    inputs = {"push": lambda t: 0.1 * numbers[0] * jnp.sin(3 * t)}
    return jj.simulate(scene, start, ts=[2.0, 6.0], inputs=inputs, **(TIGHT | options))


def seen(numbers, **options):
    motion = switching(numbers, **options)
    return jnp.concatenate(
        [motion.q.ravel(), motion.u.ravel(), motion.work, motion.phases.ts[:3], motion.phases.count[None]]
    )


def bounces(e, h, **options):
    return jj.simulate(
        Ball(e), {"z": h}, ts=[1.3, 5.5], **(TIGHT | {"max_transitions": 15} | options)
    ).phases.ts[9]


@pytest.mark.parametrize("backend", ["native", "xla", "dense"])
def test_ten_bounces(backend):
    """t_10 = sqrt(2 h/g) (1 + 2 (e + ... + e^9)), and its derivatives along e and h together."""
    time = lambda s: bounces(0.7 + s, 1.0 + s, backend=backend)
    along = lambda f: lambda s: jax.jvp(f, (s,), (1.0,))
    value, by_e, by_e_twice = 2.47360446364125, 8.53571984478680, 41.2871353427762
    exact, close = (
        np.array([value, by_e + value / 2, by_e_twice + by_e - value / 4]),
        np.array([1e-14, 1e-13, 1e-12]),
    )

    def right(found, *orders):
        assert_array_less(np.abs(np.array(jax.tree.leaves(found)) / exact[[*orders]] - 1), close[[*orders]])

    if backend == "dense":
        right(jax.jit(along(time))(0.0), 0, 1)
        return
    right(with_value(jax.grad, time)(0.0), 1, 0)
    right(jax.jit(along(along(time)))(0.0), 0, 1, 1, 2)
    if backend == "native":
        right(jax.jit(jax.jacrev(jax.jacfwd(time)))(0.0), 2)


def test_a_bounce_without_gravity_turns_the_derivative_round():
    """z(1) = -e (z_0 + v), so that dz(1)/dz_0 = -e: simulators of soft contact give another sign
    (google/brax#317).
    """

    def end(z, e):
        return jj.simulate(Ball(e, 0.0), {"z": z, "z_rate": -2.0}, ts=[1.0], **TIGHT)["z"][-1]

    for derivative in (jax.grad, jax.jacfwd):
        slope = jax.jit(derivative(end))
        assert_allclose([slope(0.5, e) for e in (1.0, 0.8)], [-1.0, -0.8], rtol=1e-12)


def test_derivatives_through_modes_and_jumps():
    """Against differences; both modes of differentiation, and the second order, against each other."""
    motion = switching(NUMBERS)
    events = motion.phases.events[: int(motion.phases.count)]
    assert [motion.event_names[i] for i in events] == ["over", "y", "under"]
    assert_array_equal([motion.phase("spring"), motion.phase("side")], [[1, 0], [0, 1]])
    beside = NUMBERS + 1e-5 * np.concatenate([np.zeros((1, 10)), np.eye(10), -np.eye(10)])
    weights = np.linspace(0.3, 1.0, 14)

    def total(numbers):
        found = seen(numbers)
        return weights @ found, found

    def gradient(numbers):
        slopes, values = jax.grad(total, has_aux=True)(numbers)
        return slopes, (slopes, values)

    def differences(values):
        return np.subtract(*np.split(values[1:], 2)) / 2e-5

    hessians, (gradients, values) = jax.jit(jax.vmap(jax.jacfwd(gradient, has_aux=True)))(beside)
    along = lambda numbers: jax.jvp(jax.jacfwd(seen), (numbers,), (numbers,))
    forward, twice = jax.jit(along)(NUMBERS)
    assert_allclose(forward.T, differences(values), rtol=1e-7, atol=1e-8)
    assert_allclose(hessians[0], differences(gradients), rtol=1e-6, atol=1e-6)
    assert_allclose(weights @ twice, hessians[0] @ NUMBERS, rtol=1e-11, atol=1e-11)
    assert_allclose(gradients[0], weights @ forward, rtol=1e-11, atol=1e-12)


def test_the_loops_agree_and_lanes_are_in_modes_of_their_own():
    numbers = NUMBERS * (1 + 0.2 * np.random.default_rng(2).normal(size=(19, 10)))
    together = jax.jit(jax.vmap(seen))(numbers)
    alone = jax.jit(seen)
    assert_array_equal(together[:4], [alone(x) for x in numbers[:4]])
    by_arrays = jax.jit(jax.vmap(lambda x: seen(x, backend="xla")))(numbers)
    assert_allclose(together, by_arrays, rtol=1e-11, atol=1e-11)
    assert_allclose(
        together, jax.jit(jax.vmap(lambda x: seen(x, solver=jj.Taylor())))(numbers), rtol=1e-10, atol=1e-10
    )
    assert len(np.unique(together[:, -1])) > 2


def test_energy_falls_by_what_events_take():
    motion = jj.simulate(Ball(), {"z": 1.0}, t1=2.0, **TIGHT)
    assert_allclose(motion.phases.lost[:3], [9.81 * (1 - 0.49) * 0.49**k for k in range(3)], rtol=1e-11)
    assert_allclose(motion.energies().balance, 9.81, rtol=1e-12)
    assert not motion.warnings
    assert "floor" in str(motion)
    assert "took" in str(motion.phases)


class Rimless(jj.Scene):
    """A wheel of eight spokes without a rim, its mass in the hub, that rolls down a slope; each spoke sticks
    where it strikes (McGeer, 1990).
    """

    slope: float = jj.parameter(0.08)
    coordinates = jj.coordinates("angle")  # of the spoke on the ground, from the vertical, downhill

    def bodies(self, t, q):
        return {"hub": jj.Particle(1.0, [jnp.sin(q.angle), 0.0, jnp.cos(q.angle)])}

    def loads(self, motion):
        return jj.gravity(motion, 9.81)

    def events(self, motion):
        half = jnp.pi / 8
        after = {"angle": motion.q.angle - 2 * half, "angle_rate": jnp.cos(2 * half) * motion.u.angle_rate}
        return {"spoke": jj.Event(self.slope + half - motion.q.angle, jump=after), "upright": -motion.q.angle}


def test_rimless_wheel():
    """Its gait, an orbit through jumps, and single periods; the multiplier of its rate is cos^2 45 deg."""

    @jax.jit
    @functools.partial(jax.value_and_grad, has_aux=True)
    def gait(slope):
        orbit = jj.periodic(Rimless(slope), {"angle_rate": 0.5}, period=1.03, until="upright", **TIGHT)
        return orbit.period, orbit.multipliers

    (time, multipliers), by_slope = gait(0.08)
    assert_allclose(time, 1.03454981142327, rtol=1e-10)
    assert_allclose(by_slope, -25.1071124092, rtol=1e-8)
    assert_allclose(multipliers, [0.5], rtol=1e-9)

    def periods(rate):
        start = {"angle": 0.08 - jnp.pi / 8, "angle_rate": rate}
        motion = jj.simulate(Rimless(), start, ts=[4.2], events=False, **TIGHT)
        return jnp.diff(motion.phases.ts, prepend=0.0)[:4]

    slopes, times = with_value(jax.jacfwd, periods)(1.09546283964766)
    assert_allclose(times, 1.03454981142327, rtol=1e-11)
    assert_allclose(slopes[1:] / slopes[:-1], 0.5, rtol=1e-9)


def test_of_a_batch_and_a_file(tmp_path):
    one, inputs = switching(NUMBERS), {"push": lambda t: 0.13 * jnp.sin(3 * t)}
    start = {"x": jnp.array([0.0, 0.1, 0.2]), "x_rate": 1.0, "y": 0.4}
    lanes = jj.rollout(one.scene, start, ts=[2.0, 6.0], inputs=inputs, **TIGHT)
    assert_array_equal(lanes.lane(1).phases.ts, one.phases.ts)
    jj.save(one, tmp_path / "motion.npz")
    found = jj.load_trajectory(tmp_path / "motion.npz", Switching)
    assert_array_equal(found.phases.lost, one.phases.lost)
    assert_array_equal(found.phase("side"), one.phase("side"))


def test_a_mode_to_begin_with():
    soft = jj.simulate(Switching(), {"x": 0.1}, ts=[0.05], inputs={"spring": "soft"})
    assert soft.phase("spring")[-1] == 1


class Ended(Ball):
    """The ball may not come so far up as it was."""

    def events(self, motion):
        return super().events(motion) | {"again": motion.q.z - 0.3 + 0.4 * motion.t}


def test_without_stop_events_the_others_stay():
    stopped = jj.simulate(Ended(), {"z": 1.0}, t1=2.0, **TIGHT)
    assert stopped.event_names[int(stopped.event)] == "again"
    motion, free = (
        jj.simulate(scene, {"z": 1.0}, t1=2.0, events=events, **TIGHT)
        for scene, events in ((Ended(), False), (Ball(), True))
    )
    assert_array_equal(motion.q, free.q)
    assert motion.succeeded


def test_a_fit_of_bounces():
    """100 throws with noise of 4 mm: the spread of the estimates is their standard error."""
    ts = jnp.linspace(0.0, 1.6, 81)
    heights = jj.simulate(Ball(0.72), {"z": 1.0}, ts=ts)["z"] + 0.004 * jax.random.normal(
        jax.random.PRNGKey(0), (100, 81)
    )
    throws = jj.Experiment(ts, {"z": heights}, 0.004, start={"z": 1.0})
    fits = jj.fit_batch(Ball(0.7, 9.7), throws, free=("bounce", "gravity"))
    assert fits.converged.all()
    for name, right in (("bounce", 0.72), ("gravity", 9.81)):
        found = fits.estimates[name]
        assert abs(np.mean(found.value) - right) < 3 * np.mean(found.standard_error) / np.sqrt(100)
        assert_allclose(np.std(found.value), np.mean(found.standard_error), rtol=0.25)


class Again(jj.Scene):
    """What has fallen through y = 0 is lifted above it at 1 s, and falls through it again at once. A ball
    strikes its floor, and begins again below it: it rises above that for a while, and falls through it again.
    """

    coordinates = jj.coordinates("y z")

    def bodies(self, t, q):
        return {"mass": jj.Particle(1.0, [q.y, 0.0, q.z])}

    def loads(self, motion):
        return jj.gravity(motion, 1.0)

    def events(self, motion):
        return {
            "falls": jj.Event(motion.q.y),
            "lifted": jj.Event(1.0 - motion.t, jump={"y": 0.05}),
            "floor": jj.Event(motion.q.z, jump={"z": -0.01, "z_rate": 0.3}),
        }


def test_events_count_again_that_another_one_lifts_or_that_were_left_within_one_step():
    motion = jj.simulate(Again(), {"y": 0.5, "y_rate": -1.0, "z": 50.0}, ts=[11.5])
    again = 0.3 + np.sqrt(0.3**2 - 2 * 0.01)
    expected = [0.5, 1.0, 1.05, 10.0, 10.0 + again, 10.0 + 2 * again, np.nan]
    assert_allclose(motion.phases.ts[:7], expected, rtol=1e-9)


class Timed(OnLine):
    """A mass that is pushed harder from a time on, and stops then; also as time runs back to it."""

    at: float = jj.parameter(1.0)
    way: float = jj.parameter(1.0)
    modes = jj.modes(push=("soft", "hard"))

    def loads(self, motion):
        return jj.gravity(motion, 1.0 + motion.modes.push, jnp.array([1.0, 0.0, 0.0]))

    def events(self, motion):
        late = self.way * (self.at - motion.t)
        return {"late": jj.Event(late, to={"push": "hard"}, jump={"x_rate": 0.0})}


@pytest.mark.parametrize("direction", [1.0, -1.0])
def test_state_and_mode_at_a_saved_time_agree(direction):
    """Where an event and a saved time are a rounding apart, either both are from before the event or both
    from after it.
    """
    t = direction * (0.7 + 0.0317 * np.arange(12))
    times = {"t0": 0.3 * direction, "rtol": 1e-10, "atol": 1e-10}

    @jax.jit
    @jax.vmap
    def seen(t, at):
        ts = jnp.stack([t, t + direction])
        motion = jj.simulate(Timed(at, direction), {"x_rate": direction}, ts=ts, **times)
        return motion["x_rate"][0], motion.phase("push")[0], motion.energies().balance

    at = np.concatenate([np.nextafter(t, -9), t, np.nextafter(t, 9)])
    rate, push, balance = seen(np.tile(t, 3), at)
    stopped = np.abs(rate) < 1e-9
    assert_array_equal(push, stopped)
    assert_allclose(balance, balance[:, :1] + np.zeros(2), atol=1e-9)
    assert set(stopped.tolist()) == {True, False}


def test_work_of_potentials_that_depend_on_modes():
    """What a mode and a jump add to a potential is the event's, not work done between events; x = 1.12 m at
    the event.
    """

    class Moved(Timed):
        def events(self, motion):
            jump = {"x": motion.q.x + 1.0, "x_rate": 0.0}
            return {"late": jj.Event(self.at - motion.t, to={"push": "hard"}, jump=jump)}

    motion = jj.simulate(Moved(0.8), {"x_rate": 1.0}, ts=[0.5, 1.5], rtol=1e-10, atol=1e-10)
    assert_allclose(motion.work, 0.0, atol=1e-8)
    assert_allclose(motion.phases.lost[0], 1.8**2 / 2 + 2 * 2.12 - 1.12, rtol=1e-9)
    assert_allclose(motion.energies().balance, 0.5, rtol=1e-8)
    assert not motion.warnings


def test_too_many_transitions():
    motion = jj.simulate(Ball(), {"z": 1.0}, t1=3.0, max_transitions=20)
    assert not motion.succeeded
    assert "max_transitions" in motion.message
    assert 2.5 < motion.t_end < 2.5587
    motion = jj.simulate(Ball(0.5), {"z": 1.0}, t1=3.0)  # its bounces end before there are so many
    assert motion.result == ZENO
    assert "rest" in motion.message
    assert_allclose(motion.t_end, 3 * np.sqrt(2 / 9.81), atol=1e-8)


def test_what_happens_at_the_start_has_no_derivative():
    """Below the floor already: the bounce is there, and its derivative, which does not exist, is NaN."""
    end = lambda z: jj.simulate(Ball(), {"z": z, "z_rate": -1.0}, ts=[0.05])["z"][-1]
    forwards, backwards = (with_value(derivative, end) for derivative in (jax.jacfwd, jax.grad))
    assert forwards(-1e-3)[1] > forwards(0.0)[1] - 2e-3
    assert np.isnan([forwards(-1e-3)[0], backwards(-1e-3)[0]]).all()


def test_wrong_events_are_named():
    for said, how in {
        "event `floor` of `Wrong` moves `w`, which is not a coordinate or speed": {"jump": {"w": 0.0}},
        "gives mode `gear` the value `third`.*`second`": {"to": {"gear": "third"}},
        "cannot switch anything": {"jump": {"z": 1.0}, "stop": True},
    }.items():

        class Wrong(Ball):
            modes = jj.modes(gear=("first", "second"))

            def events(self, motion, how=how):
                return {"floor": jj.Event(motion.q.z, **how)}

        with pytest.raises(ValueError, match=said):
            jj.simulate(Wrong())

    class Row(Switching):
        def velocity_constraints(self, motion):
            return {"edge": jnp.where(motion.modes.side == 0, motion.u.x_rate, motion.u.y_rate)}

    with pytest.raises(ValueError, match="constraints of `Row` depend on mode `side`"):
        jj.simulate(Row(), t1=1.0)
    with pytest.raises(ValueError, match="has the values"):
        jj.modes(gear="first")
    with pytest.raises(ValueError, match="cannot continue after events"):
        jj.simulate(Ball(), solver=diffrax.Kvaerno5())
