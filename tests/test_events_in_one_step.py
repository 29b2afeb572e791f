"""Of several stop events in one step the first in time ends the motion, whatever its name; one whose value ends at its boundary is found there."""

import itertools

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import result_codes as results
from numpy.testing import assert_allclose, assert_array_equal
from small_scenes import OnLine, Upright

import jourdain_jax as jj

LOOPS = {"lean": {}, "diffrax": {"solver": diffrax.Bosh3()}}
GRAVITY = 9.81


class Thrown(Upright):
    """A particle under gravity between a floor, a wall and two more planes: all its coordinates are polynomials in time, which steps follow at any length."""

    floor: object = jj.parameter(0.0)
    wall: object = jj.parameter(2.0)
    roof: object = jj.parameter(9.0)
    slope: object = jj.parameter(9.0)
    example = {"z": 1.0, "x_rate": 4.5}

    def loads(self, motion):
        return (jj.gravity(motion, GRAVITY),)

    def events(self, motion):
        q = motion.q
        return {"a floor": q.z - self.floor, "b wall": self.wall - q.x, "c roof": self.roof - q.z, "d slope": self.slope - q.x - q.z}


def first_crossing(x_rate, z_rate, floor, wall, roof, slope):
    """Index and time of the first event from x = 0, z = 1."""

    def least(*coefficients):
        roots = np.roots(coefficients)
        return min((r.real for r in roots if abs(r.imag) < 1e-12 and r.real > 0), default=np.inf)

    fall = [-GRAVITY / 2, z_rate, 1.0]
    times = least(*np.subtract(fall, [0, 0, floor])), wall / x_rate, least(*np.subtract(fall, [0, 0, roof])), least(*np.subtract(fall, [0, -x_rate, slope]))
    return int(np.argmin(times)), min(times)


def generated_throws(count=48):
    random = np.random.default_rng(13)
    throws = [
        (random.uniform(2, 6), random.uniform(-2, 3), random.uniform(-1, 0.9), random.uniform(0.3, 3), random.uniform(1.05, 3), random.uniform(1.3, 6))
        for _ in range(count)
    ]
    # one shortly after the other, in every order
    for floor, wall, slope in itertools.permutations([0.20, 0.21, 0.22]):
        throws.append((4.0, 0.0, 1 - GRAVITY * floor**2 / 2, 4.0 * wall, 9.0, 1 + 4.0 * slope - GRAVITY * slope**2 / 2))
    return np.array(throws)


@pytest.mark.parametrize("options", LOOPS.values(), ids=LOOPS)
def test_the_first_of_several_events_in_one_long_step_ends_the_motion(options):
    throws = generated_throws()
    if options:
        throws[:, 4] = 100.0  # a hump over the roof is found by our explicit Runge-Kutta loop; by diffrax not where it is over at the end of a step
    starts = {"x": np.zeros(len(throws)), "z": np.ones(len(throws)), "x_rate": throws[:, 0], "z_rate": throws[:, 1]}
    walls = dict(zip(("floor", "wall", "roof", "slope"), throws[:, 2:].T, strict=True))
    lanes = jj.rollout(Thrown(), starts, parameters=walls, ts=[5.0], max_step=np.inf, progress=False, **options).lanes  # some step is beyond all of them
    expected = [first_crossing(*throw) for throw in throws]
    assert_array_equal(lanes.event, [event for event, _ in expected])
    assert_allclose(lanes.t_end, [t for _, t in expected], rtol=1e-12)
    assert set(np.asarray(lanes.event)) >= {0, 1, 3}
    assert np.all(np.asarray(lanes.result) == results.EVENT)
    assert_allclose(lanes.q_end[:, 0], throws[:, 0] * lanes.t_end, rtol=1e-12)


def test_the_derivative_of_the_first_event_is_its_own():
    def end(wall):
        motion = jj.simulate(Thrown(wall=wall), ts=[5.0], max_step=np.inf)
        return jnp.stack([motion.t_end, motion.q_end[1]])

    t, dt = 2.0 / 4.5, 1 / 4.5
    expected = [dt, -GRAVITY * t * dt]
    assert_allclose(jax.jacrev(end)(2.0), expected, rtol=1e-10)
    assert_allclose(jax.jacfwd(end)(2.0), expected, rtol=1e-10)


# where a stone from z = 1 with the speeds 4.5 and 2 m/s meets a plane: its place, and the value a t^2 + b t + c
MEETS = {
    "floor": (0.6, lambda place: (-GRAVITY / 2, 2.0, 1.0 - place)),
    "wall": (0.8, lambda place: (0.0, -4.5, place)),
    "roof": (1.1, lambda place: (GRAVITY / 2, -2.0, place - 1.0)),
    "slope": (1.9, lambda place: (GRAVITY / 2, -6.5, place - 1.0)),
}


@pytest.mark.parametrize("plane", MEETS)
def test_the_second_derivative_of_one_of_several_events_is_its_own(plane):
    place, value = MEETS[plane]

    def end(place):
        walls = {"floor": -9.0, "wall": 9.0} | {plane: place}
        motion = jj.simulate(Thrown(**walls), {"z": 1.0, "x_rate": 4.5, "z_rate": 2.0}, t1=1.0)
        return jnp.stack([motion.t_end, *motion.q_end])

    def closed(place):
        a, b, c = value(place)
        t = 2 * c / (-b + jnp.sqrt(b**2 - 4 * a * c))
        return jnp.stack([t, 4.5 * t, 1.0 + 2.0 * t - GRAVITY * t**2 / 2])

    assert_allclose(end(place), closed(place), rtol=1e-9)
    assert_allclose(jax.hessian(end)(place), jax.hessian(closed)(place), rtol=1e-6, atol=1e-9)


class Bounded(OnLine):
    """A particle without forces; event values that are no numbers beyond edges of their own."""

    arc: object = jj.parameter(1.0)
    root: object = jj.parameter(1e3)
    jump: object = jj.parameter(1e3)
    positive: object = jj.parameter(1e3)
    example = {"x_rate": 1.0}

    def events(self, motion):
        x = motion.q.x
        return {
            "arc": 1 - jnp.arcsin(x / self.arc) / (jnp.pi / 2),
            "root": jnp.sqrt(1 - x / self.root),
            "jump": 1 + jnp.sqrt(1 - x / self.jump),
            "positive": jnp.arccosh(2 - x / self.positive) + 1e-3,
        }


def test_an_event_that_is_no_number_beyond_its_boundary_stops_the_motion_there():
    edges, kinds = (x.ravel() for x in np.meshgrid([0.3, 1.0, 1.7], [0, 1, 2, 3]))
    own = {name: np.where(kinds == k, edges, 1e3) for k, name in enumerate(("arc", "root", "jump", "positive"))}
    lanes = jj.rollout(Bounded(), {"x_rate": np.full(12, 1.3)}, parameters=own, ts=[5.0], progress=False).lanes
    assert np.all(np.asarray(lanes.result) == results.EVENT)
    assert_array_equal(lanes.event, np.array([0, 3, 1, 2])[kinds])  # in the order of the alphabet
    assert_allclose(lanes.q_end[:, 0], edges, rtol=1e-13)
    assert_allclose(lanes.t_end, edges / 1.3, rtol=1e-13)


def test_the_time_at_which_a_value_ends_has_the_derivative_of_its_boundary():
    def end(edge):
        return jj.simulate(Bounded(arc=edge), {"x_rate": 1.3}, ts=[5.0]).t_end

    assert_allclose(jax.grad(end)(0.7), 1 / 1.3, rtol=1e-6)
    assert_allclose(jax.jacfwd(end)(0.7), 1 / 1.3, rtol=1e-6)


def test_a_start_whose_event_is_no_number_is_beyond_it_and_a_state_that_is_none_is_a_failure():
    beyond = jj.simulate(Bounded(), {"x": 1.5, "x_rate": 1.0}, ts=[5.0])
    assert (int(beyond.result), float(beyond.t_end)) == (results.EVENT, 0.0)
    lost = eqx.tree_at(lambda s: s.q, jj.start(Bounded(), x_rate=1.0), jnp.array([jnp.nan]))
    assert int(jj.simulate(Bounded(), lost, t1=5.0).result) == results.BAD_START


def test_a_value_that_falls_below_zero_and_rises_again_within_a_step_is_an_event():
    """A stone thrown up against a roof that it passes by little: a step would take it there and back."""
    passes, longest = np.array([1e-4, 1e-2, 0.3]), 2.5
    top = 1.0 + 5.0**2 / (2 * GRAVITY)
    starts = {"z": np.ones(3), "z_rate": np.full(3, 5.0)}
    scene = Thrown(floor=-100.0, wall=100.0, slope=100.0)
    lanes = jj.rollout(scene, starts, parameters={"roof": top - passes}, ts=[longest], max_step=np.inf, progress=False).lanes
    expected = 5.0 / GRAVITY - np.sqrt(2 * passes / GRAVITY)
    assert_array_equal(lanes.event, np.full(3, 2))
    assert_allclose(lanes.t_end, expected, rtol=1e-9)


@pytest.mark.parametrize("backend", ["auto", "xla"])
def test_a_value_that_ends_a_step_just_below_zero_was_zero_where_it_fell_not_there(backend):
    """A roof that a stone passes by some nm, and a value that decays to next to nothing; both are flat where the first step of the search ends."""

    class Decaying(Bounded):
        def events(self, motion):
            return {"decayed": jnp.exp(-50.0 * motion.t) - 1e-10}

    found = jj.simulate(Decaying(), {"x_rate": 1.0}, ts=[5.0], backend=backend)
    assert_allclose(found.t_end, np.log(1e10) / 50, rtol=1e-9)
    by, top = 3e-9, 1.0 + 5.0**2 / (2 * GRAVITY)

    def end(roof):
        motion = jj.simulate(Thrown(floor=-100.0, wall=100.0, roof=roof, slope=100.0), {"z": 1.0, "x_rate": 0.0, "z_rate": 5.0}, ts=[2.0], backend=backend)
        return motion.t_end

    assert_allclose(end(top - by), 5.0 / GRAVITY - np.sqrt(2 * by / GRAVITY), rtol=1e-9)
    assert_allclose(jax.grad(end)(top - by), 1 / np.sqrt(2 * GRAVITY * by), rtol=1e-4)


def test_an_event_is_no_mistake_to_a_search_for_nan_and_a_mistake_still_is():
    class Wrong(Thrown):
        def loads(self, motion):
            return (jj.gravity(motion, GRAVITY * jnp.sqrt(motion.q.z - 0.9)),)

    with jax.debug_nans(True):
        motion = jj.simulate(Thrown(), t1=5.0)
        assert int(motion.result) == results.EVENT
        assert np.isnan(np.asarray(motion["x"])[-1])
        assert "stopped at an event" in str(motion)
        with pytest.raises(FloatingPointError):
            jj.simulate(Wrong(), t1=5.0)


WITH_MARKS = {
    "energies": lambda motion, path: motion.energies().balance,
    "a point": lambda motion, path: motion.point("mass", jnp.zeros(3)),
    "a rollout": lambda motion, path: jj.rollout(Thrown(), {"x_rate": jnp.array([0.5, 1.0])}, t1=5.0).lanes.q,
    "a file": lambda motion, path: (jj.save(motion, path), jj.load_trajectory(path, Thrown).q)[1],
    "a derivative": lambda motion, path: jax.grad(lambda z: jj.simulate(Thrown(), {"z": z}, t1=5.0).t_end)(1.5),
}


@pytest.mark.parametrize("what", WITH_MARKS)
def test_times_that_were_not_reached_are_no_mistake_to_a_search_for_nan(what, tmp_path):
    motion = jj.simulate(Thrown(), t1=5.0)
    with jax.debug_nans(True):
        found = np.asarray(WITH_MARKS[what](motion, tmp_path / "motion.npz"))
    assert np.isnan(found).any() == (what != "a derivative")
