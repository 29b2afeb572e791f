"""What moves along samples exerts a force of inertia, or is refused: a piecewise linear motion has no second
derivative where anyone looks.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose
from refusals import refused
from slopes import slope

import jourdain_jax as jj

TS = np.linspace(0.0, 2.0, 401)
DRIVE = 0.1 * np.sin(3.0 * TS)
LENGTH, GRAVITY = 1.0, 9.81


def bob(x, angle):
    return jj.Particle(1.0, jnp.stack([x + LENGTH * jnp.sin(angle), 0.0 * angle, -LENGTH * jnp.cos(angle)]))


class Driven(jj.Scene):
    """A pendulum on a cart that follows a curve; the curve is in the pose."""

    coordinates = jj.coordinates("angle")
    curve: object = None

    def bodies(self, t, q):
        return {"bob": bob(self.curve(t), q.angle)}

    def loads(self, motion):
        return jj.gravity(motion, GRAVITY)


class Prescribed(Driven):
    """The curve drives a coordinate."""

    coordinates = jj.coordinates("x angle")

    def bodies(self, t, q):
        return {"bob": bob(q.x, q.angle), "cart": jj.Particle(1.0, [q.x, 0.0, 0.0])}

    def prescribed(self, t):
        return {"x": self.curve(t)}


class InGeometry(Prescribed):
    """The curve stands in a geometric row."""

    def prescribed(self, t):
        return {}

    def geometric_constraints(self, pose):
        return {"rail": pose.q.x - self.curve(pose.t)}


def ladder(t):
    return jnp.where(t < 0.4, 0.1 * t, jnp.where(t < 0.9, 0.04 + 0.3 * (t - 0.4), 0.19 - 0.1 * (t - 0.9)))


def gathered(t):
    ts, xs = jnp.asarray(TS), jnp.asarray(DRIVE)
    k = jnp.clip(jnp.searchsorted(ts, t) - 1, 0, len(TS) - 2)
    return xs[k] + (t - ts[k]) / (TS[1] - TS[0]) * (xs[k + 1] - xs[k])


KINKED = {
    "jnp.interp": lambda t: jnp.interp(t, TS, DRIVE),
    "few samples": lambda t: jnp.interp(t, jnp.array([0.0, 1.3, 2.0]), jnp.array([0.0, 1.0, 1.2])),
    "a ladder of branches": ladder,
    "jnp.piecewise": lambda t: jnp.piecewise(
        t, [t < 0.5, t >= 0.5], [lambda t: 0.2 * t, lambda t: 0.3 - 0.4 * t]
    ),
    "a gather": gathered,
    "steps": lambda t: 0.01 * jnp.floor(20.0 * t),
    "rounded": lambda t: jnp.round(5.0 * t) / 50.0,
    "a saw": lambda t: 0.1 * jnp.mod(t, 0.7),
    "a triangle": lambda t: 0.1 * jnp.abs(jnp.mod(t, 0.5) - 0.25),
    "a late start": lambda t: 0.3 * jnp.maximum(t - 1.7, 0.0),
    "jnp.interp inside a sine": lambda t: 0.1 * jnp.sin(jnp.interp(t, TS, 10.0 * DRIVE)),
    "a loop": lambda t: jax.lax.fori_loop(1, 5, lambda i, x: jnp.minimum(x, 0.1 * i + 0.1 * t), 0.5 * t),
    "far times": lambda t: jnp.interp(t, TS + 3.0, DRIVE),
}
SMOOTH = {
    "a ramp with a smooth step": lambda t: (
        0.3 * jnp.clip(t, 0.0, 1.0) ** 3 * (10 - 15 * jnp.clip(t, 0.0, 1.0) + 6 * jnp.clip(t, 0.0, 1.0) ** 2)
    ),
    "truncated powers": lambda t: 0.2 * jnp.maximum(t - 0.7, 0.0) ** 3,
    "pieces with equal slopes": lambda t: jnp.where(t < 1.0, t**2, 2.0 * t - 1.0),
    "a guarded quotient": lambda t: jnp.where(t == 0.0, 1.0, jnp.sin(t) / jnp.where(t == 0.0, 1.0, t)),
    "a root by iteration": lambda t: jax.lax.fori_loop(
        0, 30, lambda i, x: x - (x - 0.3 * jnp.sin(x) - t) / (1 - 0.3 * jnp.cos(x)), t
    ),
    "steep": lambda t: 1e-3 * jnp.tanh(200.0 * (t - 1.0)) + 0.0 * jnp.abs(t),
    "a spline": jj.Spline(TS, DRIVE),
}


@pytest.mark.parametrize(
    ("kind", "curve"),
    [
        *((Driven, name) for name in KINKED),
        (Prescribed, "jnp.interp"),
        (Prescribed, "steps"),
        (InGeometry, "jnp.interp"),
    ],
)
def test_a_motion_whose_velocity_jumps_is_refused(kind, curve):
    scene = kind(curve=KINKED[curve])
    refused(r"of `\w+` is not smooth.*jj\.Spline", jj.simulate, scene, {"angle": 0.1}, t1=1.0)


@pytest.mark.parametrize("curve", SMOOTH)
def test_a_smooth_motion_is_not_refused(curve):
    assert jj.structure_of(Driven(curve=SMOOTH[curve])).degrees_of_freedom == 1


class TableOfScene(Driven):
    """The table is a field of the scene."""

    ts: jax.Array = jj.parameter(TS)
    values: jax.Array = jj.parameter(DRIVE)

    def bodies(self, t, q):
        return {"bob": bob(jnp.interp(t, self.ts, self.values), q.angle)}


def test_a_table_among_the_parameters_is_refused_also_while_it_is_traced():
    def end(values):
        return jj.simulate(TableOfScene(values=values), {"angle": 0.1}, t1=1.0).q_end[0]

    refused("the pose of body `bob` of `TableOfScene` is not smooth", jax.jit(jax.grad(end)), DRIVE)
    refused("not smooth", jj.report, TableOfScene(ts=TS + 1.7e9))


def drive(x):
    return jnp.interp(x, TS, DRIVE)


class Road(jj.Scene):
    """A mass on a bumpy road."""

    coordinates = jj.coordinates("x y")
    domain = {"x": (0.0, 2.0)}

    def bodies(self, t, q):
        return {"mass": jj.Particle(1.0, [q.x, q.y, drive(q.x)])}


def test_a_road_by_linear_interpolation_is_refused_and_a_check_names_it():
    said = "the pose of body `mass` of `Road` is not smooth"
    refused(f"{said}.*at several configurations", jj.simulate, Road(), {"x_rate": 1.0}, t1=1.0)
    found = jj.check(Road())
    assert not found.passed
    assert said in str(found)


class Pushed(Driven):
    """Tables of forces are no matter: they need no derivative."""

    def bodies(self, t, q):
        return {"bob": bob(0.0 * t, q.angle)}

    def loads(self, motion):
        push = drive(motion.t) + jnp.floor(motion.q.angle)
        return jj.gravity(motion, GRAVITY), jj.Load(generalized={"angle_rate": push})


def test_tables_of_loads_are_not_refused():
    assert jj.structure_of(Pushed()).degrees_of_freedom == 1


@pytest.mark.parametrize("kind", [Driven, Prescribed, InGeometry])
def test_a_spline_exerts_the_force_of_inertia_of_what_it_goes_through(kind):
    scene = kind(curve=jj.Spline(TS, DRIVE))
    for t, angle in ((0.3, 0.2), (1.1, -0.7), (1.7031, 1.0)):
        x = 0.1 * np.sin(3.0 * t)
        q, u = jnp.array([x, angle]), jnp.array([0.3 * np.cos(3.0 * t), 0.4])
        own = slice(1 if kind is Driven else 0, None)
        expected = -GRAVITY * np.sin(angle) + 9.0 * x * np.cos(angle)  # l angledd + g sin(angle) = -xdd cos
        assert jj.accelerations(scene, t, q[own], u[own]).udot[-1] == pytest.approx(expected, abs=1e-3)


@jax.jit
def with_derivatives(spline, t):
    first = jax.grad(spline.__call__)
    return jax.vmap(lambda t: jnp.stack([spline(t), first(t), jax.grad(first)(t)]))(t).T


@pytest.mark.parametrize("n", [2, 3, 4, 9])
def test_a_spline_is_cubic_and_twice_continuously_differentiable(n):
    generator = np.random.default_rng(n)
    ts = np.sort(generator.uniform(0.0, 3.0, n)) + 0.3 * np.arange(n)
    cubic, t = np.poly1d(generator.normal(size=min(n, 4))), np.linspace(ts[0], ts[-1], 2 * n + 1)
    expected = [cubic(t), cubic.deriv()(t), cubic.deriv(2)(t)]
    found = with_derivatives(jj.Spline(ts, cubic(ts)), t)
    assert_allclose(
        found[:2, 1:-1], np.array(expected)[:2, 1:-1], atol=1e-9
    )  # polynomials up to the third degree are met exactly
    assert_allclose(found[2, 1:-1], expected[2][1:-1], atol=1e-8)
    values = generator.normal(size=n)
    spline = jj.Spline(ts, values)
    assert_allclose(jax.vmap(spline)(ts), values, atol=1e-12)
    inside, outside = ts[1:-1], [ts[0] + 1e-12, ts[-1] - 1e-12, ts[0] - 1.0, ts[-1] + 2.0, ts[0]]
    at = np.concatenate([inside - 1e-9, inside + 1e-9, outside])
    below, above, ends = np.split(with_derivatives(spline, at)[:, : 2 * n], [n - 2, 2 * n - 4], axis=1)
    assert_allclose(below, above, rtol=1e-5, atol=1e-5)
    assert_allclose(
        ends[0, 2:], [ends[0, 0] - ends[1, 0], ends[0, 1] + 2.0 * ends[1, 1]], atol=1e-6
    )  # along the tangents


def test_a_spline_differentiates_with_respect_to_its_values():
    def acceleration(values):
        return jj.accelerations(
            Driven(curve=jj.Spline(TS[::40], values)), 0.71, jnp.array([0.2]), jnp.array([0.4])
        ).udot[0]

    values, direction = jnp.asarray(DRIVE[::40]), jnp.cos(jnp.arange(11.0))
    slopes = jax.jit(jax.grad(acceleration))(values)
    by_values = slope(lambda x: acceleration(values + x * direction), 0.0, 1.0)  # linear in the values
    assert_allclose(slopes @ direction, float(by_values), rtol=1e-9)


class OnBelt(jj.Scene):
    """A skate on a belt, and a wheel in it that no row holds: it turns back where the belt jerks the skate.
    `way`: how the belt runs.
    """

    coordinates = jj.coordinates("x wheel")
    way: object = None

    def bodies(self, t, q):
        weight = jnp.stack([q.x + q.wheel, 0.0, 0.0])
        return {"weight": jj.Particle(1.0, weight), "skate": jj.Particle(1.0, [q.x, q.wheel, 0.0])}

    def velocity_constraints(self, motion):
        return {"grip": self.way(motion)}


JERKS = {
    "a branch": lambda motion: motion.u.x_rate - jnp.where(motion.t < 1.0, 1.0, 2.0),
    "steps": lambda motion: motion.u.x_rate - 0.1 * jnp.floor(3.0 * motion.t),
}
WITHOUT_JERK = {
    "a ramp": lambda motion: motion.u.x_rate - jnp.clip(motion.t, 1.0, 2.0),
    "a row that sets in": lambda motion: jnp.where(motion.t < 1.0, 0.0, motion.u.x_rate - 1.0),
    "a row that sets in early": lambda motion: jnp.where(motion.t < 0.003, 0.0, motion.u.x_rate - 1.0),
    "a row that becomes another": lambda motion: jnp.where(
        motion.t < 1.0, motion.u.x_rate - 1.0, motion.u.wheel_rate
    ),
}


@pytest.mark.parametrize("way", JERKS)
def test_a_velocity_row_that_jumps_in_time_is_refused(way):
    refused(
        r"constraint `grip` of `OnBelt` jumps at t = .* s: speeds would have to jump",
        jj.simulate,
        OnBelt(way=JERKS[way]),
        {"x_rate": 1.0},
        t1=2.0,
    )


@pytest.mark.parametrize("way", WITHOUT_JERK)
def test_a_velocity_row_that_bends_or_sets_in_is_not_refused(way):
    jj.structure_of(OnBelt(way=WITHOUT_JERK[way]))


def test_a_ramp_in_a_row_moves_what_no_row_holds():
    motion = jj.simulate(OnBelt(way=WITHOUT_JERK["a ramp"]), {"x_rate": 1.0}, t1=3.0)
    assert motion["wheel_rate"][-1] == pytest.approx(-0.5, abs=1e-6)  # x'' + 2 wheel'' = 0
