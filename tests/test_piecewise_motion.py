"""What moves along samples exerts a force of inertia, or is refused: a piecewise linear motion has no second derivative where anyone looks."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

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
        return (jj.gravity(motion, GRAVITY),)


class Prescribed(Driven):
    """The curve drives a coordinate."""

    coordinates = jj.coordinates("x angle")

    def bodies(self, t, q):
        return {"bob": bob(q.x, q.angle), "cart": jj.Particle(1.0, jnp.stack([q.x, 0.0 * q.x, 0.0 * q.x]))}

    def prescribed(self, t):
        return {"x": self.curve(t)}


class InGeometry(Prescribed):
    """The curve stands in a geometric row."""

    def prescribed(self, t):
        return {}

    def geometric_constraints(self, pose):
        return {"rail": pose.q.x - self.curve(pose.t)}


class Table(jj.Scene):
    pass


def ladder(t):
    return jnp.where(t < 0.4, 0.1 * t, jnp.where(t < 0.9, 0.04 + 0.3 * (t - 0.4), 0.19 - 0.1 * (t - 0.9)))


def gathered(t):
    k = jnp.clip(jnp.searchsorted(jnp.asarray(TS), t) - 1, 0, len(TS) - 2)
    h = TS[1] - TS[0]
    return jnp.asarray(DRIVE)[k] + (t - jnp.asarray(TS)[k]) / h * (jnp.asarray(DRIVE)[k + 1] - jnp.asarray(DRIVE)[k])


KINKED = {
    "jnp.interp": lambda t: jnp.interp(t, jnp.asarray(TS), jnp.asarray(DRIVE)),
    "few samples": lambda t: jnp.interp(t, jnp.array([0.0, 1.3, 2.0]), jnp.array([0.0, 1.0, 1.2])),
    "a ladder of branches": ladder,
    "jnp.piecewise": lambda t: jnp.piecewise(t, [t < 0.5, t >= 0.5], [lambda t: 0.2 * t, lambda t: 0.3 - 0.4 * t]),
    "a gather": gathered,
    "steps": lambda t: 0.01 * jnp.floor(20.0 * t),
    "rounded": lambda t: jnp.round(5.0 * t) / 50.0,
    "a saw": lambda t: 0.1 * jnp.mod(t, 0.7),
    "a triangle": lambda t: 0.1 * jnp.abs(jnp.mod(t, 0.5) - 0.25),
    "a late start": lambda t: 0.3 * jnp.maximum(t - 1.7, 0.0),
    "jnp.interp inside a sine": lambda t: 0.1 * jnp.sin(jnp.interp(t, jnp.asarray(TS), jnp.asarray(10.0 * DRIVE))),
    "a loop": lambda t: jax.lax.fori_loop(0, 5, lambda i, x: jnp.minimum(x, 0.1 * i + 0.05 * t), 0.1 * t),
    "far times": lambda t: jnp.interp(t, jnp.asarray(TS) + 3.0, jnp.asarray(DRIVE)),
}
SMOOTH = {
    "a ramp with a smooth step": lambda t: 0.3 * jnp.clip(t, 0.0, 1.0) ** 3 * (10 - 15 * jnp.clip(t, 0.0, 1.0) + 6 * jnp.clip(t, 0.0, 1.0) ** 2),
    "truncated powers": lambda t: 0.2 * jnp.maximum(t - 0.7, 0.0) ** 3,
    "pieces with equal slopes": lambda t: jnp.where(t < 1.0, t**2, 2.0 * t - 1.0),
    "a guarded quotient": lambda t: jnp.where(t == 0.0, 1.0, jnp.sin(t) / jnp.where(t == 0.0, 1.0, t)),
    "a root by iteration": lambda t: jax.lax.fori_loop(0, 30, lambda i, x: x - (x - 0.3 * jnp.sin(x) - t) / (1 - 0.3 * jnp.cos(x)), t),
    "steep": lambda t: 1e-3 * jnp.tanh(200.0 * (t - 1.0)) + 0.0 * jnp.abs(t),
    "a spline": jj.Spline(TS, DRIVE),
}


@pytest.mark.parametrize("kind", [Driven, Prescribed, InGeometry])
@pytest.mark.parametrize("curve", KINKED)
def test_a_motion_whose_velocity_jumps_is_refused(kind, curve):
    scene = kind(curve=KINKED[curve])
    with pytest.raises(ValueError, match=r"of `\w+` is not smooth.*jj\.Spline"):
        jj.simulate(scene, {"angle": 0.1}, t1=1.0)


@pytest.mark.parametrize("curve", SMOOTH)
def test_a_smooth_motion_is_not_refused(curve):
    assert jj.accelerations(Driven(curve=SMOOTH[curve]), 0.5, jnp.array([0.3]), jnp.array([0.1]), reduction=jj.Privileged()).udot.shape == (1,)


class TableOfScene(Driven):
    """The table is a field of the scene."""

    ts: jax.Array = jj.parameter(TS)
    values: jax.Array = jj.parameter(DRIVE)

    def bodies(self, t, q):
        return {"bob": bob(jnp.interp(t, self.ts, self.values), q.angle)}


def test_a_table_among_the_parameters_is_refused_also_while_it_is_traced():
    def end(values):
        return jj.simulate(TableOfScene(values=values), {"angle": 0.1}, t1=1.0).q_end[0]

    for call in (end, jax.jit(end), jax.grad(end)):
        with pytest.raises(ValueError, match="the pose of body `bob` of `TableOfScene` is not smooth"):
            call(jnp.asarray(DRIVE))
    late = TableOfScene(ts=TS + 1.7e9)
    with pytest.raises(ValueError, match="not smooth"):
        jj.report(late)


class Road(jj.Scene):
    """A mass on a bumpy road."""

    coordinates = jj.coordinates("x y")
    domain = {"x": (0.0, 2.0)}

    def bodies(self, t, q):
        return {"mass": jj.Particle(1.0, jnp.stack([q.x, q.y, jnp.interp(q.x, jnp.asarray(TS), jnp.asarray(DRIVE))]))}


def test_a_road_by_linear_interpolation_is_refused():
    with pytest.raises(ValueError, match="the pose of body `mass` of `Road` is not smooth.*at several places"):
        jj.simulate(Road(), {"x_rate": 1.0}, t1=1.0)


class Pushed(Driven):
    """Tables of forces are no matter: they need no derivative."""

    def bodies(self, t, q):
        return {"bob": bob(0.0 * t, q.angle)}

    def loads(self, motion):
        push = jnp.interp(motion.t, jnp.asarray(TS), jnp.asarray(DRIVE)) + jnp.floor(motion.q.angle)
        return jj.gravity(motion, GRAVITY), jj.Load(generalized={"angle_rate": push})


def test_tables_of_loads_are_not_refused():
    assert jj.structure_of(Pushed()).degrees_of_freedom == 1


def true_acceleration(t, angle):
    """l angledd = -g sin - xdd cos for x = 0.1 sin(3 t)."""
    return -GRAVITY * np.sin(angle) + 0.9 * np.sin(3.0 * t) * np.cos(angle)


@pytest.mark.parametrize("kind", [Driven, Prescribed, InGeometry])
def test_a_spline_exerts_the_force_of_inertia_of_what_it_goes_through(kind):
    scene = kind(curve=jj.Spline(TS, DRIVE))
    ends = [jj.simulate(scene, {"angle": 0.1}, t1=1.5, state=state) for state in ("minimal", "full")]
    exact = _integrated()
    for end in ends:
        assert bool(end.succeeded)
        assert float(end.q_end[-1]) == pytest.approx(exact, abs=2e-6)


def _integrated() -> float:
    t, y, h = 0.0, np.array([0.1, 0.0]), 1e-3
    f = lambda t, y: np.array([y[1], true_acceleration(t, y[0])])  # noqa: E731
    for _ in range(1500):
        k1 = f(t, y)
        k2 = f(t + h / 2, y + h / 2 * k1)
        k3 = f(t + h / 2, y + h / 2 * k2)
        k4 = f(t + h, y + h * k3)
        t, y = t + h, y + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    return float(y[0])


def test_a_spline_is_cubic_and_twice_differentiable():
    generator = np.random.default_rng(0)
    for n in (2, 3, 4, 5, 9):
        ts = np.sort(generator.uniform(0.0, 3.0, n)) + 0.3 * np.arange(n)
        cubic = np.poly1d(generator.normal(size=min(n, 4)))
        spline = jj.Spline(ts, cubic(ts))
        t = np.linspace(ts[0], ts[-1], 33)
        assert np.allclose(jax.vmap(spline)(t), cubic(t), atol=1e-10)  # polynomials up to the third degree are met exactly
        assert np.allclose(jax.vmap(jax.grad(jax.grad(spline)))(t[1:-1]), cubic.deriv(2)(t[1:-1]), atol=1e-9)
        values = generator.normal(size=n)
        spline = jj.Spline(ts, values)
        assert np.allclose(jax.vmap(spline)(ts), values, atol=1e-12)
        for f in (spline, jax.grad(spline), jax.grad(jax.grad(spline))):
            inner = ts[1:-1]
            assert np.allclose(jax.vmap(f)(inner - 1e-9), jax.vmap(f)(inner + 1e-9), atol=1e-5)
        beyond = jnp.array([ts[0] - 1.0, ts[-1] + 2.0])
        slopes = [jax.grad(spline)(ts[0] + 1e-12), jax.grad(spline)(ts[-1] - 1e-12)]
        assert np.allclose(jax.vmap(spline)(beyond), [values[0] - slopes[0], values[-1] + 2.0 * slopes[1]], atol=1e-6)


def test_a_spline_differentiates_with_respect_to_its_values():
    def end(values, angle=0.1):
        return jj.simulate(Driven(curve=jj.Spline(TS[::40], values)), {"angle": angle}, t1=1.0, adjoint=None).q_end[0]

    values, direction = jnp.asarray(DRIVE[::40]), jnp.cos(jnp.arange(11.0))
    slope = jax.jit(jax.grad(end))(values) @ direction
    h = 1e-4
    both = jax.jit(jax.vmap(end))(jnp.stack([values + h * direction, values - h * direction]))
    assert float(slope) == pytest.approx(float(both[0] - both[1]) / (2 * h), rel=1e-5)


@pytest.mark.parametrize("given", [([0.0, 2.0, 1.0], [0.0, 1.0, 2.0]), ([0.0, 1.0], [0.0, np.nan]), ([0.0, 1.0], [0.0, 1.0, 2.0]), (0.0, 1.0), (["a"], [0])])
def test_malformed_splines_are_refused(given):
    with pytest.raises(ValueError, match="`Spline`"):
        jj.Spline(*given)
