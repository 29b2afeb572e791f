"""Reverse mode of our own loop goes back over the steps that the motion took: right in any number of steps, alone and in lanes, to events and times."""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import result_codes as results
from numpy.testing import assert_allclose

import jourdain_jax as jj
from jourdain_jax.motion.integrators import erk_loop, recorded_adjoint
from jourdain_jax.motion.integrators.tableaus import method_of

LANES = 3
AT_FOUR_SAVED_TIMES = jnp.array([0.0, 0.7, 1.5, 4.0, 4.0])  # the first is the start, the last comes twice


def pendulum(kind, *, rtol, solver=None, events=False, max_steps=100_000):
    """`(y0, t0, goals, gravity)` -> saved states, time and state at the end, the loop's own account. The pendulum is driven, damped and stops as it falls."""

    def rates(t, y, gravity):
        return jnp.stack([y[1], -gravity * jnp.sin(y[0]) - 0.1 * y[1] + 0.3 * jnp.cos(2 * t)])

    def falls(t, y, gravity):
        return (0.4 + y[0] + 0.05 * gravity)[None]

    def run(y0, t0, goals, gravity):
        same = jnp.full(jnp.shape(t0), 1.0)
        problem = erk_loop.Problem(
            rates=rates,
            args=gravity,
            project=None,
            events=falls if events else None,
            norm=lambda y: jnp.sqrt(jnp.mean(y**2, axis=0)),
            rtol=rtol * same,
            atol=rtol * same,
            shortest=1e-14 * same,
            longest=jnp.inf * same,
            span=same,
            max_steps=max_steps,
        )
        method = method_of(diffrax.Dopri8() if solver is None else solver)
        ys, _, end = erk_loop.integrate(problem, method, y0, t0, goals, 1e-3, kind)
        return ys, end.t, end.y, end

    return run


def weighed(run):
    """One number of all that may be differentiated, and the loop's own account."""

    def value(*arguments):
        ys, t, y, end = run(*arguments)
        parts = [jnp.reshape(x, (-1, *jnp.shape(t))) for x in (ys, t, y)]
        weights = [jnp.cos(1.0 + jnp.arange(len(part)) + 7 * k) for k, part in enumerate(parts)]
        return sum(jnp.sum(jnp.tensordot(w, part, 1)) for w, part in zip(weights, parts, strict=True)), end

    return value


def arguments(lanes: bool):
    if not lanes:
        return jnp.array([1.2, 0.3]), jnp.array(0.0), AT_FOUR_SAVED_TIMES, jnp.array(9.81)
    across = jnp.arange(float(LANES))
    y0 = jnp.stack([1.2 - 0.5 * across, 0.3 + 0.1 * across])
    return y0, 0.0 * across, AT_FOUR_SAVED_TIMES[:, None] + 0.0 * across, 9.81 - across


def forward_mode(value, x):
    return jax.jit(jax.jacfwd(lambda x: value(*x)[0]))(x)


@pytest.mark.parametrize("steps", [2048, 24], ids=["one window", "many windows"])
@pytest.mark.parametrize("events", [False, True], ids=["", "events"])
@pytest.mark.parametrize("lanes", [False, True], ids=["alone", "lanes"])
def test_reverse_mode_has_the_derivatives_of_forward_mode(lanes, events, steps, monkeypatch):
    monkeypatch.setattr(recorded_adjoint, "STEPS_ALONE", steps)
    monkeypatch.setattr(recorded_adjoint, "STEPS_TOGETHER", steps)
    x = arguments(lanes)
    options = {"rtol": 1e-11, "solver": diffrax.Tsit5(), "events": events}
    (_, end), found = jax.jit(jax.value_and_grad(lambda x: weighed(pendulum("reverse", **options))(*x), has_aux=True))(x)
    assert np.all(end.accepted > 3 * 24)
    assert np.any(end.code == results.EVENT) == events
    expected = forward_mode(weighed(pendulum("forward", **options)), x)
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        assert_allclose(a, b, rtol=1e-8, atol=1e-8)


def test_lanes_of_vmap_keep_their_own_events_and_derivatives(monkeypatch):
    monkeypatch.setattr(recorded_adjoint, "STEPS_ALONE", 24)
    y0, t0, goals, gravity = arguments(lanes=True)
    options = {"rtol": 1e-11, "solver": diffrax.Tsit5(), "events": True}

    def each(y0, t0, goals, gravity):
        value = weighed(pendulum("reverse", **options))
        return jax.value_and_grad(lambda gravity: value(y0, t0, goals, gravity), has_aux=True)(gravity)

    (_, end), found = jax.jit(jax.vmap(each, in_axes=(1, 0, 1, 0)))(y0, t0, goals, gravity)
    assert len(np.unique(end.code)) == 2
    expected = forward_mode(lambda gravity: weighed(pendulum("forward", **options))(y0, t0, goals, gravity), (gravity,))
    assert_allclose(found, expected[0], rtol=1e-8)


def test_a_derivative_is_not_a_number_where_memory_does_not_hold_the_motion(monkeypatch):
    monkeypatch.setattr(recorded_adjoint, "STEPS_ALONE", 24)
    x = arguments(lanes=False)

    def derivative(windows):
        monkeypatch.setattr(recorded_adjoint, "_MEMORY", (2**27, 0))
        monkeypatch.setattr(recorded_adjoint, "_FEWEST", (16, windows))
        return jax.grad(lambda gravity: weighed(pendulum("reverse", rtol=1e-9))(*x[:3], gravity)[0])(x[3])

    assert np.isnan(derivative(2))
    assert np.isfinite(derivative(40))


@pytest.mark.parametrize("backend", ["native", "xla"])
def test_the_derivative_of_a_long_motion_at_round_off_is_right(backend):
    """A rattleback for 2 s, 2580 steps at rtol 1e-13: where reverse mode chose its steps once more, its derivative was off by more than 1 %."""
    scene = jj.models.Rattleback()
    start = jj.start(scene, **scene.example)

    def turned(factor):
        begun = eqx.tree_at(lambda s: s.u, start, factor * start.u)
        motion = jj.simulate(scene, begun, ts=jnp.array([2.0]), rtol=1e-13, atol=1e-13, formulation=jj.Formulation(stabilisation=None), backend=backend)
        return jnp.sum(motion.q_end), motion.accepted

    found, steps = jax.grad(turned, has_aux=True)(1.0)
    assert steps > recorded_adjoint.STEPS_ALONE
    _, expected = jax.jvp(lambda x: turned(x)[0], (1.0,), (1.0,))
    assert_allclose(found, expected, rtol=1e-9)
