"""Steps end at relations of loads and events, and derivatives of both orders go through: closed forms."""

from collections.abc import Callable

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
from small_scenes import OnLine, OnPlane

import jourdain_jax as jj

SPAN = 2.0


class Bead(OnLine):
    """A bead of 1 kg on a line with the force `law(scene, t, x, v)`, and events of the motion."""

    a: float = jj.parameter(0.7)
    k: float = jj.parameter(0.5)
    law: Callable = eqx.field(static=True, default=lambda s, t, x, v: 0 * x)
    event: Callable | None = eqx.field(static=True, default=None)

    def loads(self, motion):
        return jj.generalized_force(motion, x_rate=self.law(self, motion.t, motion.q.x, motion.u.x_rate))

    def events(self, motion):
        return {} if self.event is None else {"event": self.event(self, motion)}


def end(scene, start=None, **options):
    options = {"ts": [SPAN], "rtol": 1e-12, "atol": 1e-12} | options
    return jj.simulate(scene, {"x": 0.0, "x_rate": 1.0} | (start or {}), **options)


def sets_in(a, k, v):
    """x(2) where -k acts from x = a on."""
    s = SPAN - a / v
    return a + v * s - k * s * s / 2


def sets_in_at_time(a, k, v):
    s = SPAN - a
    return v * SPAN - k * s * s / 2


def dead_zone(a, k, v):
    """x(2) behind a spring of stiffness k that begins at x = a."""
    s, w = SPAN - a / v, jnp.sqrt(k)
    return a + v / w * jnp.sin(w * s)


def slides(a, k, v):
    """x(2) of a bead that friction k brakes, and a force 2 k pushes back: v changes its sign at v/(3 k)."""
    stop = v / (3 * k)
    return v * stop / 2 - k * (SPAN - stop) ** 2 / 2


def pushed_by_two(a, k, v):
    """x(2) where -k acts from x = a on, and as much again from t = a + 0.4 on."""
    s, r = SPAN - a / v, SPAN - a - 0.4
    return a + v * s - k * s * s / 2 - k * r * r / 2


def two_at_once(a, k, v):
    s = SPAN - a / v
    return a + v * s - k * s * s


def saws(a, k, v):
    """x(2) under the force k floor(2 x/a), where v and k let it pass two whole numbers."""
    first = a / (2 * v)
    at = jnp.sqrt(v * v + k * a)
    second = first + (at - v) / k
    s = SPAN - second
    return a + at * s + k * s * s


LAWS = {
    "sets in at a place": (lambda s, t, x, v: jnp.where(x > s.a, -s.k, 0.0), sets_in),
    "sets in at a time": (lambda s, t, x, v: jnp.where(t > s.a, -s.k, 0.0), sets_in_at_time),
    "dead zone": (lambda s, t, x, v: -s.k * jnp.maximum(x - s.a, 0.0), dead_zone),
    "friction away from rest": (lambda s, t, x, v: -s.k * jnp.sign(v) - 2 * s.k, slides),
    "a place and a time": (
        lambda s, t, x, v: -s.k * ((x > s.a) + jnp.where(t - s.a > 0.4, 1.0, 0.0)),
        pushed_by_two,
    ),
    "two at once": (
        lambda s, t, x, v: jnp.where(x > s.a, -s.k, 0.0) + jnp.where(x * x > s.a * s.a, -s.k, 0.0),
        two_at_once,
    ),
    "floor": (lambda s, t, x, v: s.k * jnp.floor(2 * x / s.a), saws),
}
AT = np.array([0.7, 0.5, 1.1])
SAWED = np.array([1.9, 0.3, 1.1])  # 2 s end before the third step


def case(kind):
    """Return x(2) of a motion and as a closed form, functions of (a, k, v), and their argument."""
    law, exact = LAWS[kind]

    def x(p):
        return end(Bead(law=law, a=p[0], k=p[1]), {"x_rate": p[2]}, backend="native").q_end[0]

    return x, lambda p: exact(*p), SAWED if kind == "floor" else AT


@pytest.mark.parametrize("kind", LAWS)
def test_values_and_slopes_are_those_of_closed_forms(kind):
    *functions, at = case(kind)
    of = (jax.jit(lambda p, f=f: (*jax.value_and_grad(f)(p), jax.jacfwd(f)(p)))(at) for f in functions)
    for found, right, close in zip(*of, (1e-12, 1e-11, 1e-11), strict=True):
        assert_allclose(found, right, rtol=0, atol=close)


@pytest.mark.parametrize("kind", LAWS)
@pytest.mark.parametrize(
    "second", [jax.hessian, lambda f: jax.jacfwd(jax.jacfwd(f))], ids=["reverse", "forward"]
)
def test_second_derivatives_are_those_of_closed_forms(kind, second):
    x, exact, at = case(kind)
    assert_allclose(*(jax.jit(second(f))(at) for f in (x, exact)), rtol=0, atol=1e-9)


def both(*truths):
    return jnp.where(jnp.all(jnp.stack(truths)), 1.0, 0.0)


# how hard a patch brakes a bead that crosses it on its way x = t, y = 0.4 t; few probed states are on it
PATCHES = {
    "one condition": lambda s, t, x, y: jnp.where(
        (x > s.a) & (x < s.a + s.w) & (y > 0.25) & (y < 0.4), s.k, 0.0
    ),
    "signs": lambda s, t, x, y: (
        s.k
        * both(jnp.sign(x - s.a) > 0, jnp.sign(s.a + s.w - x) > 0)
        * (jnp.maximum(y, 0.27) == y)
        * (y < 0.4)
    ),
    "at its time": lambda s, t, x, y: (
        s.k * both(t > s.a, t < s.a + 3 * s.w, x > s.a, x < s.a + s.w, y > 0.27, y < 0.33)
    ),
}


class Patch(OnPlane):
    a: float = jj.parameter(0.7)
    w: float = jj.parameter(0.03)
    k: float = jj.parameter(3.0)
    on: Callable | None = eqx.field(static=True, default=None)
    off: Callable | None = eqx.field(static=True, default=None)

    def loads(self, motion):
        brakes = 0.0 if self.on is None else -self.on(self, motion.t, motion.q.x, motion.q.y)
        return jj.generalized_force(motion, x_rate=brakes + 0 * motion.t)

    def events(self, motion):
        return (
            {}
            if self.off is None
            else {"on it": 0.5 * self.k - self.off(self, motion.t, motion.q.x, motion.q.y)}
        )


def crossed(a, w, k):
    """x(2) behind the patch."""
    v = (1 - 2 * k * w) ** 0.5
    return a + w + v * (SPAN - a - (1 - v) / k)


# the first lane at a tight tolerance, narrower and narrower patches at that of `simulate`
ACROSS = np.array([[0.7, 0.03 * 0.5**k, 3.0] for k in (0, *range(9))])
CLOSENESS = np.array([1e-12, *[jj.Options().rtol] * 9])
CROSSED = jax.jit(jax.vmap(jax.value_and_grad(lambda p: crossed(*p))))


@pytest.mark.parametrize("kind", PATCHES)
def test_what_acts_where_several_conditions_meet_is_met(kind):
    def found(p, close):
        scene = Patch(a=p[0], w=p[1], k=p[2], on=PATCHES[kind])
        return end(scene, {"y_rate": 0.4}, rtol=close, atol=close, solver=diffrax.Dopri8()).q_end[0]

    values, slopes = jax.jit(jax.vmap(jax.value_and_grad(found)))(ACROSS, CLOSENESS)
    exact, right = CROSSED(ACROSS)
    assert_allclose(values, exact, rtol=0, atol=1e-7)
    assert_allclose(values[0], exact[0], rtol=0, atol=1e-12)
    assert_allclose(slopes[0], right[0], rtol=0, atol=1e-10)
    if kind in ("one condition", "at its time"):
        forward = jax.jit(jax.jacfwd(found))(ACROSS[0], CLOSENESS[0])
        assert_allclose(forward, slopes[0], rtol=0, atol=1e-10)


@pytest.mark.parametrize("kind", PATCHES)
def test_an_event_where_several_conditions_meet_is_met(kind):
    def time(a):
        start = {"x": 0.0, "x_rate": 1.0, "y_rate": 0.4}
        return jj.simulate(Patch(a=a, off=PATCHES[kind]), start, ts=[SPAN]).t_end

    slope, value = with_value(jax.grad, time)(0.7)
    assert_allclose(value, 0.7, rtol=0, atol=1e-9)
    # the value jumps below zero where a relation changes
    assert np.isnan(slope)
    if kind == "one condition":
        assert np.isnan(jax.jit(jax.jacfwd(time))(0.7))


def test_lanes_are_in_modes_of_their_own():
    law, exact = LAWS["sets in at a place"]
    a = np.linspace(-0.5, 3.0, 30)
    options = {"parameters": {"a": a}, "ts": [SPAN], "rtol": 1e-12, "atol": 1e-12}
    found = jj.rollout(Bead(law=law), {"x_rate": 1.1}, **options).lanes
    met, free, held = (a > 0) & (a < 2.2), 2.2, 2.2 - 0.5 * SPAN**2 / 2
    right = np.where(met, exact(a, 0.5, 1.1), np.where(a > 1, free, held))
    assert_allclose(found.q_end[:, 0], right, atol=1e-12)
    assert_array_equal(found.crossings, met)


def test_a_step_ends_at_a_relation_at_little_cost():
    found = end(Bead(law=LAWS["sets in at a place"][0]), rtol=1e-8, atol=1e-8)
    assert int(found.accepted) + int(found.rejected) <= 40


def test_a_motion_that_begins_at_a_relation_takes_the_side_to_which_it_goes():
    for x, rate, exact in ((0.7, 1.0, 1.7), (0.7, -1.0, -1.3), (0.7 - 1e-9, 1.0, 1.7)):
        found = end(Bead(law=LAWS["sets in at a place"][0]), {"x": x, "x_rate": rate})
        assert_allclose(found.q_end[0], exact, atol=3e-9)


def test_what_rests_at_a_relation_rests_whatever_round_off_says():
    drag = Bead(law=lambda s, t, x, v: -v * jnp.abs(v) - jnp.sin(x) + jnp.where(x > 0, -x, 0.0))
    still = end(drag, {"x_rate": 0.0})
    assert (still.result, still.crossings, float(still.q_end[0])) == (results.SUCCESS, 0, 0.0)
    # what brakes stays there, or goes on
    later = Bead(law=lambda s, t, x, v: jnp.where(v > 0, -0.5, 0.0) + jnp.where(t > s.a, s.k, 0.0))
    for k, close, right in ((0.0, 1e-12, [1.0, 0.0]), (1.0, 1e-7, [1.25, 0.5])):
        found = end(later.replace(a=3.0, k=k), ts=[4.0])
        assert found.result == results.SUCCESS
        assert_allclose([found.q_end[0], found.u_end[0]], right, atol=close)


@pytest.mark.parametrize("start", [0.0, 1.0])
def test_dry_friction_at_rest_is_said_to_stick(start):
    pulled = lambda a, **options: end(
        Bead(a, law=lambda s, t, x, v: s.a - s.k * jnp.sign(v)), {"x_rate": start}, **options
    )
    found = pulled(0.3, ts=[10.0])
    assert found.result == results.STICKS
    assert "friction=" in found.message
    assert "the force along `x_rate`" in found.message
    assert_allclose(found.t_end, 5 * start, atol=1e-6)
    assert pulled(0.7).result == results.SUCCESS


def test_relations_within_events_and_inputs():
    stops = lambda s, motion: jnp.where(motion.q.x > s.a, s.a + s.k - motion.q.x, 1.0)
    t = lambda a: end(Bead(a, event=stops), {"x_rate": 2.0}).t_end
    assert_allclose(with_value(jax.grad, t)(0.7), [0.5, 0.6], atol=1e-12)
    bounces = Bead(
        law=LAWS["sets in at a place"][0],
        event=lambda s, motion: jj.Event(s.a + 0.2 - motion.q.x, jump={"x_rate": -motion.u.x_rate}),
    )

    def back(a):
        """The force stops where the bead comes back."""
        v = jnp.sqrt(1 - 2 * 0.5 * 0.2)
        return a - (SPAN - a - 2 * (1 - v) / 0.5)

    x = lambda a: end(bounces.replace(a=a)).q_end[0]
    for derivative in (jax.jacfwd, jax.grad):
        assert_allclose(*(with_value(derivative, f)(0.7) for f in (x, back)), atol=1e-11)


class Driven(Bead):
    inputs = jj.inputs("push")

    def loads(self, motion):
        return jj.generalized_force(motion, x_rate=motion.inputs.push)


@pytest.mark.parametrize("backend", BACKENDS)
def test_numbers_of_inputs_move_the_times_of_their_relations(backend):
    def x(a):
        return end(Driven(), inputs={"push": lambda t: jnp.where(t > a, -0.5, 0.0)}, backend=backend).q_end[0]

    for derivative in (jax.jacfwd, jax.grad):
        assert_allclose(with_value(derivative, x)(0.7), [0.5 * 1.3, 2 - 0.25 * 1.3**2], atol=1e-12)


def test_guards_have_no_sides():
    scene = Bead(
        law=lambda s, t, x, v: -jnp.where(jnp.abs(x) > 1e-9, jnp.sin(x) / jnp.where(x == 0, 1.0, x), 1.0)
    )
    assert end(scene).crossings == 0


class Lost(jj.Scene):
    coordinates = jj.coordinates("x")

    def bodies(self, t, q):
        return {"mass": jj.RigidBody(1.0, jnp.eye(3), jnp.stack([q.x, 0.0 * q.x, 0.0 * q.x]), jnp.eye(3))}

    def loads(self, motion):
        return jj.generalized_force(motion, x_rate=jnp.where(motion.q.x > 20.0, jnp.nan, -9.81))


def test_a_start_where_a_load_is_no_number_ends():
    assert jj.simulate(Lost(), {"x": 22.0}, t1=1.0).result == results.NOT_FINITE


@pytest.mark.parametrize("backend", BACKENDS)
def test_no_step_goes_on_where_a_load_is_no_number(backend):
    """The place 20 = 19 + 5 t - g t^2/2; a comparison with NaN is false, which hid that of an early stage."""
    found = jj.simulate(Lost(), {"x": 19.0, "x_rate": 5.0}, ts=np.linspace(0.0, 0.5, 51), backend=backend)
    assert found.result == results.STEP_TOO_SMALL
    assert_allclose(found.t_end, (5 - np.sqrt(25 - 2 * 9.81)) / 9.81, rtol=1e-9)
    assert not np.any(found["x"] > 20.0)
