"""Stop events: found in their step to round-off, the first of several, in short windows, and again from where
they stopped; with derivatives.
"""

import itertools
from functools import cache

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import result_codes as results
from derivatives import with_value
from machine_code import BACKENDS
from numpy.testing import assert_allclose, assert_array_equal
from small_scenes import OnLine, Upright

import jourdain_jax as jj
from jourdain_jax.integrate.explicit_steps import DOPRI5, DOPRI8, TSIT5, method_of

# Stop events located inside the loop over steps: to round-off, with derivatives up to the third, and never
# outside of the step they lie in.


GRAVITY = 9.81


SHAPES = ("flat", "jump", "kinked", "saturated", "steep", "straight")


class Shaped(OnLine):
    """A particle that meets walls, by values of many shapes."""

    walls: object = jj.parameter(np.full(6, 3.0))

    def events(self, motion):
        flat, jump, kinked, saturated, steep, straight = self.walls - motion.q.x
        return {
            "flat": flat**3,  # its slope vanishes there
            "jump": jnp.where(jump > 0, 1.0, -1.0),  # a jump has no slope at all
            "kinked": jnp.where(kinked > 0, 1e3, 1.0) * kinked,
            "saturated": jnp.tanh(40 * saturated),
            "steep": jnp.expm1(30 * steep),
            "straight": straight,
        }


def test_an_event_is_found_in_its_step_whatever_its_shape():
    walls = np.where(np.eye(6, dtype=bool), 0.7, 3.0)
    lanes = jj.rollout(Shaped(), {"x_rate": 1.0}, parameters={"walls": walls}, ts=[2.0]).lanes
    assert tuple(lanes.event_names[event] for event in np.asarray(lanes.event)) == SHAPES
    assert_allclose(lanes.t_end[:2], 0.7, atol=1e-2)
    assert_allclose(lanes.t_end[2:], 0.7, atol=1e-14)
    assert_allclose(lanes.q_end[:, 0], lanes.t_end, rtol=1e-13)


class Flat(OnLine):
    """A particle that meets a wall; the value of the event has a root of three fold there, or one of one
    fold.
    """

    wall: object = jj.parameter(1.5)
    order: int = eqx.field(static=True, default=3)

    def events(self, motion):
        return {"wall": (self.wall - motion.q.x) ** self.order}


@pytest.mark.parametrize(
    "options",
    [{"backend": "native"}, {"backend": "xla"}, {"backend": "dense"}, {"solver": jj.RadauIIA()}],
    ids=str,
)
@pytest.mark.parametrize("derivative", [jax.jacrev, jax.jacfwd])
def test_the_time_of_an_event_whose_value_has_no_slope_has_no_derivative(options, derivative):
    def met(wall, order):
        motion = jj.simulate(
            Flat(wall=wall, order=order), {"x": 0.0, "x_rate": 1.0}, t1=4.0, ts=[0.5], **options
        )
        return jnp.stack([motion.t_end, motion.q_end[0], motion.q[0, 0] * wall])

    assert_allclose(met(1.5, 3), [1.5, 1.5, 0.75], rtol=1e-7)
    assert_allclose(derivative(met)(1.5, 1), [1.0, 1.0, 0.5], rtol=1e-9)
    assert_allclose(
        derivative(met)(1.5, 3), [np.nan, np.nan, 0.5], rtol=1e-9
    )  # what was saved on the way is none of the event's


# Solvers of our own. --------------------------------------------------------------------------------


@pytest.mark.parametrize("method", [TSIT5, DOPRI5, DOPRI8], ids=lambda method: method.name)
def test_our_tableaus_are_those_of_the_solvers_of_that_name(method):
    solver = getattr(diffrax, method.name)()
    tableau = solver.tableau
    for row, theirs in zip(method.A[1:], tableau.a_lower, strict=True):
        assert np.array_equal(row[: len(theirs)], theirs)
        assert not row[len(theirs) :].any()
    assert np.array_equal(method.b, tableau.b_sol)
    assert np.array_equal(method.b_error, tableau.b_error)
    assert np.array_equal(method.c[1:], tableau.c)
    assert method.order == solver.order(None)
    assert method_of(solver) is method


def test_only_a_solver_itself_has_its_tableau():
    class Tsit5(diffrax.Tsit5):
        pass

    assert method_of(Tsit5()) is None
    assert method_of(diffrax.Bosh3()) is None


# Stop events whose values are negative in a short part of the way are met: the relations in them are watched
# over each step.


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


@cache
def scene_of(kind):
    value, _ = KINDS[kind]

    class Passing(OnLine):
        a: float = jj.parameter(A)
        w: float = jj.parameter(W)

        def events(self, motion):
            return {"met": value(motion.q.x, motion.t, self.a, self.w), "far": 30.0 - jnp.abs(motion.q.x)}

    return Passing


@pytest.mark.parametrize("kind", KINDS)
def test_a_short_window_is_met(kind):
    scene, start = scene_of(kind)(), {"x": 0.0, "x_rate": 1.0}
    assert jj.lower(scene).event_relations
    lanes = jj.rollout(scene, start | {"x_rate": jnp.linspace(0.5, 1.5, 7)}, ts=[4.0])
    assert_array_equal(lanes.result, results.EVENT)
    motion = lanes.lane(3)
    assert motion.event_names[int(motion.event)] == "met"
    assert abs(motion.t_end - KINDS[kind][1]) < 1e-9


@pytest.mark.parametrize("derivative", [jax.grad, jax.jacfwd])
def test_the_time_of_a_short_window_has_derivatives(derivative):
    def time(a):
        return jj.simulate(scene_of("distance")(a=a), {"x": 0.0, "x_rate": 1.0}, ts=[2.0]).t_end

    assert abs(jax.jit(derivative(time))(A) - 1.0) < 1e-8


def test_values_with_a_peak_where_a_relation_changes_are_not_watched():
    """As of a disc that falls to either side, or of a rod between two walls."""

    class Leaning(scene_of("distance")):
        def events(self, motion):
            return {
                "low": 1.5 - jnp.abs(motion.q.x),
                "walls": jnp.minimum(2.0 - motion.q.x, motion.q.x + 2.0),
            }

    assert jj.lower(Leaning()).event_relations == ()
    assert jj.lower(jj.models.TiltingDisc()).event_relations == ()


# Of several stop events in one step the first in time ends the motion, whatever its name; one whose value
# ends at its boundary is found there.


LOOPS = {"lean": {}, "diffrax": {"solver": diffrax.Bosh3()}}


class Thrown(Upright):
    """A particle under gravity between a floor, a wall and two more planes: all its coordinates are
    polynomials in time, which steps follow at any length.
    """

    floor: object = jj.parameter(0.0)
    wall: object = jj.parameter(2.0)
    roof: object = jj.parameter(9.0)
    slope: object = jj.parameter(9.0)
    example = {"z": 1.0, "x_rate": 4.5}

    def loads(self, motion):
        return jj.gravity(motion, GRAVITY)

    def events(self, motion):
        q = motion.q
        return {
            "a floor": q.z - self.floor,
            "b wall": self.wall - q.x,
            "c roof": self.roof - q.z,
            "d slope": self.slope - q.x - q.z,
        }


def first_crossing(x_rate, z_rate, floor, wall, roof, slope):
    """Index and time of the first event from x = 0, z = 1."""

    def least(*coefficients):
        roots = np.roots(coefficients)
        return min((r.real for r in roots if abs(r.imag) < 1e-12 and r.real > 0), default=np.inf)

    fall = [-GRAVITY / 2, z_rate, 1.0]
    times = (
        least(*np.subtract(fall, [0, 0, floor])),
        wall / x_rate,
        least(*np.subtract(fall, [0, 0, roof])),
        least(*np.subtract(fall, [0, -x_rate, slope])),
    )
    return int(np.argmin(times)), min(times)


def generated_throws(count=48):
    low, high = [2, -2, -1, 0.3, 1.05, 1.3], [6, 3, 0.9, 3, 3, 6]
    # the last ones: one shortly after the other, in every order
    close = [
        (4.0, 0.0, 1 - GRAVITY * floor**2 / 2, 4.0 * wall, 9.0, 1 + 4.0 * slope - GRAVITY * slope**2 / 2)
        for floor, wall, slope in itertools.permutations([0.20, 0.21, 0.22])
    ]
    return np.vstack([np.random.default_rng(13).uniform(low, high, (count, 6)), close])


@pytest.mark.parametrize("options", LOOPS.values(), ids=LOOPS)
def test_the_first_of_several_events_in_one_long_step_ends_the_motion(options):
    throws = generated_throws()
    if options:
        throws[:, 4] = (
            # a hump over the roof is found by our explicit Runge-Kutta loop; by diffrax not where it is over
            # at the end of a step
            100.0
        )
    starts = {"x": 0.0, "z": 1.0, "x_rate": throws[:, 0], "z_rate": throws[:, 1]}
    walls = dict(zip(("floor", "wall", "roof", "slope"), throws[:, 2:].T, strict=True))
    lanes = jj.rollout(
        Thrown(), starts, parameters=walls, ts=[5.0], max_step=np.inf, **options
    ).lanes  # some step is beyond all of them
    expected = [first_crossing(*throw) for throw in throws]
    assert_array_equal(lanes.event, [event for event, _ in expected])
    assert_allclose(lanes.t_end, [t for _, t in expected], rtol=1e-12)
    assert set(np.asarray(lanes.event)) >= {0, 1, 3}
    assert_array_equal(lanes.result, results.EVENT)
    assert_allclose(lanes.q_end[:, 0], throws[:, 0] * lanes.t_end, rtol=1e-12)


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
    own = {
        name: np.where(kinds == k, edges, 1e3) for k, name in enumerate(("arc", "root", "jump", "positive"))
    }
    lanes = jj.rollout(Bounded(), {"x_rate": 1.3}, parameters=own, ts=[5.0]).lanes
    assert_array_equal(lanes.result, results.EVENT)
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
    assert jj.simulate(Bounded(), lost, t1=5.0).result == results.BAD_START


def test_a_value_that_falls_below_zero_and_rises_again_within_a_step_is_an_event():
    """A stone thrown up against a roof that it passes by little: a step would take it there and back."""
    passes, longest = np.array([1e-4, 1e-2, 0.3]), 2.5
    top = 1.0 + 5.0**2 / (2 * GRAVITY)
    starts = {"z": 1.0, "z_rate": 5.0}
    scene = Thrown(floor=-100.0, wall=100.0, slope=100.0)
    lanes = jj.rollout(scene, starts, parameters={"roof": top - passes}, ts=[longest], max_step=np.inf).lanes
    expected = 5.0 / GRAVITY - np.sqrt(2 * passes / GRAVITY)
    assert_array_equal(lanes.event, 2)
    assert_allclose(lanes.t_end, expected, rtol=1e-9)


def test_a_value_that_ends_a_step_just_below_zero_was_zero_where_it_fell_not_there():
    """A roof that a stone passes by some nm, and a value that decays to next to nothing; both are flat where
    the first step of the search ends.
    """

    class Decaying(Bounded):
        def events(self, motion):
            return {"decayed": jnp.exp(-50.0 * motion.t) - 1e-10}

    found = jj.simulate(Decaying(), {"x_rate": 1.0}, ts=[5.0])
    assert_allclose(found.t_end, np.log(1e10) / 50, rtol=1e-9)
    by, top = 3e-9, 1.0 + 5.0**2 / (2 * GRAVITY)

    def end(roof):
        motion = jj.simulate(
            Thrown(floor=-100.0, wall=100.0, roof=roof, slope=100.0),
            {"z": 1.0, "x_rate": 0.0, "z_rate": 5.0},
            ts=[2.0],
        )
        return motion.t_end

    slope, time = with_value(jax.grad, end)(top - by)
    assert_allclose(time, 5.0 / GRAVITY - np.sqrt(2 * by / GRAVITY), rtol=1e-9)
    assert_allclose(slope, 1 / np.sqrt(2 * GRAVITY * by), rtol=1e-4)


WITH_MARKS = {
    "energies": lambda motion, path: motion.energies().balance,
    "a point": lambda motion, path: motion.point("mass", jnp.zeros(3)),
    "a rollout": lambda motion, path: jj.rollout(Thrown(), {"x_rate": jnp.array([0.5, 1.0])}, t1=5.0).lanes.q,
    "a file": lambda motion, path: (jj.save(motion, path), jj.load_trajectory(path, Thrown).q)[1],
    "a derivative": lambda motion, path: jax.grad(lambda z: jj.simulate(Thrown(), {"z": z}, t1=5.0).t_end)(
        1.5
    ),
}


@pytest.mark.parametrize("what", WITH_MARKS)
def test_times_that_were_not_reached_are_no_mistake_to_a_search_for_nan(what, tmp_path):
    motion = jj.simulate(Thrown(), t1=5.0)
    with jax.debug_nans(True):
        found = np.asarray(WITH_MARKS[what](motion, tmp_path / "motion.npz"))
    assert np.isnan(found).any() == (what != "a derivative")


# A motion that starts at a stop event goes on where the value of the event rises there, as after a bounce; it
# stops where that falls through zero.


class Ball(Upright):
    """A ball above a floor at `level`, between walls."""

    level: float = jj.parameter(0.0)
    mass = 0.5

    def loads(self, motion):
        return jj.gravity(motion, GRAVITY)

    def events(self, motion):
        return {"floor": motion.q.z - self.level, "walls": 5.0 - jnp.abs(motion.q.x)}


def thrown_back(scene, motion, restitution):
    end = motion.end
    return jj.start(
        scene, t0=end.t, x=end["x"], z=end["z"], x_rate=end["x_rate"], z_rate=-restitution * end["z_rate"]
    )


@pytest.mark.parametrize(("backend", "level"), [(BACKENDS[-1], 0.0), (BACKENDS[-1], 1e3), ("xla", 0.3)])
def test_bounces_go_on_from_the_end(backend, level):
    scene, restitution = Ball(level), 0.8
    motion = jj.simulate(scene, {"z": level + 1.0, "x_rate": 0.5}, ts=[10.0], backend=backend)
    fall = np.sqrt(2 / GRAVITY)
    expected = fall
    for k in range(1, 7):
        motion = jj.simulate(scene, thrown_back(scene, motion, restitution), ts=[10.0], backend=backend)
        expected += 2 * fall * restitution**k
        assert motion.event_names[int(motion.event)] == "floor"
        assert abs(motion.t_end - expected) < 1e-9 * max(1.0, level)


def test_back_in_time_a_value_rises_where_its_rate_is_negative():
    motion = jj.simulate(Ball(), {"z": 0.0, "z_rate": -2.0}, ts=[-2.0])
    assert abs(float(motion.t_end) + 4 / GRAVITY) < 1e-9
    assert float(jj.simulate(Ball(), {"z": 0.0, "z_rate": 2.0}, ts=[-2.0]).t_end) == 0.0


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_bounce_that_is_over_has_happened(backend):
    """Whatever round-off is left of the height, and of the speed."""
    height, rate = (x.ravel() for x in np.meshgrid([0.0, -1e-13, 1e-13], [0.0, 1e-14, 1e-12]))
    starts = {"z": np.append(height, -1e-3), "z_rate": np.append(rate, 5.0)}
    lanes = jj.rollout(Ball(), starts, ts=[1.0], backend=backend).lanes
    assert {lanes.event_names[event] for event in np.asarray(lanes.event)} == {"floor"}
    assert np.all(lanes.t_end < 1e-6)
    assert lanes.t_end[-1] == 0.0


class AtLevel(OnLine):
    """A mass that starts at its event, under a force that grows with time; forwards and back in time."""

    level: float = jj.parameter(0.0)
    push: float = jj.parameter(0.0)
    growth: float = jj.parameter(0.0)
    goes_on = False

    def loads(self, motion):
        return jj.generalized_force(motion, x_rate=self.push + self.growth * motion.t)

    def events(self, motion):
        value = motion.q.x - self.level
        return {"level": jj.Event(value, jump={"x_rate": -0.5 * motion.u.x_rate}) if self.goes_on else value}


class OffLevel(AtLevel):
    goes_on = True


# level, push, growth, and x and its rate at the start -> time of the first event (None: none)
AT_LEVEL = {
    "accelerates": ((0.0, 2.0, 0.0, 0.0, 0.0), None),
    "accelerates from round-off": ((0.1 + 0.2, 2.0, 0.0, 0.3, 0.0), None),
    "sets off by its third derivative": ((0.0, 0.0, 3.0, 0.0, 0.0), None),
    "comes back": ((0.0, 2.0, -6.0, 0.0, 0.0), 1.0),
    "comes back at once": ((0.0, 2.0, -600.0, 0.0, 0.0), 0.01),
    "rises and falls": ((0.0, -2.0, 0.0, 0.0, 1.0), 1.0),
    "falls": ((0.0, -2.0, 0.0, 0.0, 0.0), 0.0),
    "falls by its third derivative": ((0.0, 0.0, -3.0, 0.0, 0.0), 0.0),
    "sinks and rises": ((0.0, 2.0, 0.0, 0.0, -1e-6), 0.0),
    "is below": ((0.0, 2.0, 0.0, -1e-9, 0.0), 0.0),
    "stays": ((0.0, 0.0, 0.0, 0.0, 0.0), 0.0),
}
WAYS_FROM_LEVEL = [{"backend": "native"}, {"solver": jj.Taylor()}, {"backend": "xla"}, {"backend": "dense"}]
WAYS_FROM_LEVEL += [{"solver": jj.RadauIIA()}]


@pytest.mark.parametrize("options", WAYS_FROM_LEVEL, ids=str)
@pytest.mark.parametrize("kind", [AtLevel, OffLevel])
@pytest.mark.parametrize("direction", [1.0, -1.0])
def test_a_value_of_zero_at_the_start_falls_by_the_first_derivative_that_is_not_zero(
    options, kind, direction
):
    level, push, growth, x, rate = np.array([numbers for numbers, _ in AT_LEVEL.values()]).T
    expected = [np.inf if time is None else time for _, time in AT_LEVEL.values()]
    parameters = {"level": level, "push": push, "growth": direction * growth}
    lanes = jj.rollout(
        kind(), {"x": x, "x_rate": direction * rate}, parameters=parameters, t1=2.0 * direction, **options
    ).lanes
    times, happened = (
        (lanes.phases.ts[:, 0], lanes.phases.events[:, 0] >= 0)
        if kind is OffLevel
        else (lanes.t_end, lanes.event >= 0)
    )
    assert_allclose(np.where(happened, np.abs(times), np.inf), expected, atol=1e-6)
