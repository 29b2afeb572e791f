"""Stop events located inside the loop over steps: to round-off, with derivatives up to the third, and never outside of the step they lie in."""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import result_codes as results
from numpy.testing import assert_allclose
from small_scenes import OnLine

import jourdain_jax as jj
from jourdain_jax.motion.integrators import erk_loop
from jourdain_jax.motion.integrators.tableaus import DOPRI5, DOPRI8, TSIT5, method_of

GRAVITY = 9.81


def stopped(y0, value, *, rates, longest=2.0, solver=None, kind="forward", lanes=(), max_steps=500):
    """Where a motion from `y0` at t = 0 stopped; `value(t, y)` of the one event."""
    real = lambda x: jnp.full(lanes, x)  # noqa: E731
    problem = erk_loop.Problem(
        rates=lambda t, y, args: rates(t, y),
        args=None,
        project=None,
        events=lambda t, y, args: value(t, y)[None],
        norm=lambda y: jnp.sqrt(jnp.mean(y**2, axis=0)),
        rtol=real(1e-9),
        atol=real(1e-9),
        shortest=real(1e-14),
        longest=real(jnp.inf),
        span=real(longest),
        max_steps=max_steps,
    )
    goals = jnp.stack([real(0.5 * longest), real(longest)])
    method = method_of(diffrax.Dopri8() if solver is None else solver)
    return erk_loop.integrate(problem, method, y0, real(0.0), goals, 1e-2, kind)[2]


def falling(t, y):
    return jnp.stack([y[1], -GRAVITY * jnp.ones_like(y[1])])


@pytest.mark.parametrize("solver", [pytest.param(diffrax.Dopri8(), id="Dopri8", marks=pytest.mark.slow), pytest.param(diffrax.Tsit5(), id="Tsit5")])
def test_a_fall_is_located_with_derivatives_up_to_the_third(solver):
    def fall_time(height):
        return stopped(jnp.stack([height, 0.0 * height]), lambda t, y: y[0], rates=falling, solver=solver).t

    height = 2.0
    exact = np.sqrt(2 * height / GRAVITY)
    for expected in (exact, exact / (2 * height), -exact / (4 * height**2), 3 * exact / (8 * height**3)):
        assert_allclose(fall_time(height), expected, rtol=1e-9)
        fall_time = jax.jacfwd(fall_time)


def test_reverse_mode_to_an_event_does_not_depend_on_derivatives_beyond_it():
    depth, stiffness, height = 0.05, 5e-3, 2.0
    beyond = []

    def push(x):  # k x^9.5 above -depth, zero below it, where reverse mode divides by sqrt(0)
        return stiffness * x**9 * jnp.sqrt(jnp.maximum(x, 0.0))

    def rates(t, y):
        jax.debug.callback(lambda y: beyond.append(y < -depth), y[0])
        return jnp.stack([y[1], -GRAVITY + push(y[0] + depth)])

    def landing_speed(height):
        return stopped(jnp.stack([height, 0.0 * height]), lambda t, y: y[0], rates=rates, kind="reverse", solver=diffrax.Tsit5()).y[1]

    # v^2/2 + g z - k (z + d)^10.5/10.5 is constant
    work = lambda z: GRAVITY * z - stiffness * (z + depth) ** 10.5 / 10.5  # noqa: E731
    speed = np.sqrt(2 * (work(height) - work(0.0)))
    assert np.isnan(jax.grad(push)(-depth))
    assert_allclose(landing_speed(height), -speed, rtol=1e-9)
    assert any(beyond)
    assert_allclose(jax.grad(landing_speed)(height), -(GRAVITY - push(height + depth)) / speed, rtol=1e-7)


@pytest.mark.parametrize(
    ("value", "digits"),
    [
        (lambda t, y: 0.7 - y[0], 1e-14),
        (lambda t, y: jnp.tanh(40 * (0.7 - y[0])), 1e-14),
        (lambda t, y: jnp.expm1(30 * (0.7 - y[0])), 1e-14),
        (lambda t, y: jnp.where(y[0] < 0.7, 1e3, 1.0) * (0.7 - y[0]), 1e-14),
        (lambda t, y: (0.7 - y[0]) ** 3, 1e-2),  # its slope vanishes there
        (lambda t, y: jnp.where(y[0] < 0.7, 1.0, -1.0), 1e-2),  # a jump has no slope at all
    ],
    ids=["straight", "saturated", "steep", "kinked", "flat", "jump"],
)
def test_an_event_is_found_in_its_step_whatever_its_shape(value, digits):
    end = stopped(jnp.array([0.0]), value, rates=lambda t, y: jnp.ones_like(y))
    assert int(end.code) == results.EVENT
    assert_allclose(end.t, 0.7, atol=digits)
    assert_allclose(end.y[0], end.t, rtol=1e-13)


class Flat(OnLine):
    """A particle that meets a wall; the value of the event has a root of three fold there, or one of one fold."""

    wall: object = jj.parameter(1.5)
    order: int = eqx.field(static=True, default=3)

    def events(self, motion):
        return {"wall": (self.wall - motion.q.x) ** self.order}


@pytest.mark.parametrize("options", [{"backend": "native"}, {"backend": "xla"}, {"backend": "dense"}, {"solver": jj.RadauIIA()}], ids=str)
@pytest.mark.parametrize("derivative", [jax.jacrev, jax.jacfwd])
def test_the_time_of_an_event_whose_value_has_no_slope_has_no_derivative(options, derivative):
    def met(wall, order):
        motion = jj.simulate(Flat(wall=wall, order=order), {"x": 0.0, "x_rate": 1.0}, t1=4.0, ts=[0.5], **options)
        return jnp.stack([motion.t_end, motion.q_end[0], motion.q[0, 0] * wall])

    assert_allclose(met(1.5, 3), [1.5, 1.5, 0.75], rtol=1e-7)
    assert_allclose(derivative(met)(1.5, 1), [1.0, 1.0, 0.5], rtol=1e-9)
    assert_allclose(derivative(met)(1.5, 3), [np.nan, np.nan, 0.5], rtol=1e-9)  # what was saved on the way is none of the event's


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
