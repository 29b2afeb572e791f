"""Derivatives of motions that cross a jump of their loads: where steps do not end there, they leave out how
the time of the jump moves, and a warning says so.

Kinks are none of this. Closed forms of derivatives through relations: `test_sides.py`.
"""

import warnings
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small_scenes import OnPlane

import jourdain_jax as jj

TS = np.linspace(0.0, 2.0, 9)


class Pushed(OnPlane):
    """A particle in a plane, pushed along y."""

    push: Callable = eqx.field(static=True)
    size: float = jj.parameter(0.4)

    def loads(self, motion):
        return (jj.generalized_force(motion, y_rate=self.push(motion, self.size)),)


JUMPS = {
    "at a place": lambda m, p: jnp.where(m.q.x > 0.2, 1.0, 2.0),
    "at a time that is a parameter": lambda m, p: jnp.where(m.t > p, 1.0, 0.0),
    "friction": lambda m, p: -p * jnp.sign(m.u.y_rate),
    "steps": lambda m, p: p * jnp.floor(3.0 * m.q.x),
    "a damper that sets in": lambda m, p: jnp.where(m.q.y < 0.0, -m.q.y - p * m.u.y_rate, 0.0),
    "a branch": lambda m, p: jax.lax.cond(m.q.x > p, lambda x: 1.0 + x, lambda x: 3.0 - x, m.q.x),
}
KINKS = {
    "smooth": lambda m, p: -p * jnp.sin(m.q.x),
    "a magnitude": lambda m, p: -p * jnp.abs(m.q.x) * m.u.y_rate,
    "one-sided": lambda m, p: jnp.maximum(m.q.x - p, 0.0),
    "limited": lambda m, p: jnp.clip(m.u.y_rate, -p, p),
    "a table": lambda m, p: jnp.interp(m.q.x, TS, p * jnp.sin(TS)) + jnp.interp(m.t, TS, jnp.cos(TS)),
    "a spline": lambda m, p: jj.Spline(TS, jnp.sin(3.0 * TS))(m.t) + jnp.abs(p),
    "a root": lambda m, p: jnp.sqrt(jnp.maximum(m.q.y, 0.0)),
    "steep": lambda m, p: -p * jnp.tanh(1e4 * m.u.y_rate) + jnp.abs(m.q.x),
    "Hertz": lambda m, p: 1e5 * jnp.maximum(p - m.q.y, 0.0) ** 1.5,
    "Hunt and Crossley": lambda m, p: 1e5 * jnp.maximum(p - m.q.y, 0.0) ** 1.5 * (1.0 - 0.3 * m.u.y_rate),
    "equal pieces": lambda m, p: jnp.where(m.q.x > p, m.q.x**2, p**2 + 2.0 * p * (m.q.x - p)),
    "a guarded quotient": lambda m, p: jnp.where(
        m.q.x == 0.0, 1.0, jnp.sin(m.q.x) / jnp.where(m.q.x == 0.0, 1.0, m.q.x)
    ),
    "a root of what may be negative": lambda m, p: jnp.sqrt(m.q.y) + jnp.abs(m.q.x),
    "a pole": lambda m, p: p / m.q.x + jnp.abs(m.q.y),
    "a table that slides": lambda m, p: jnp.interp(m.t, TS + p, jnp.cos(TS)),
    "a time that no parameter moves": lambda m, p: p * jnp.where(m.t > 0.3, 1.0, 0.0),
}


def end(push, start=0.4, see=lambda motion: motion.q_end[1], **options):
    """Where the particle ends, or what else is seen, as a function of its speed along x."""

    def of(speed, size=0.4):
        motion = jj.simulate(
            Pushed(push=push, size=size),
            {"x": start, "x_rate": speed, "y_rate": 0.1},
            ts=[1.0],
            work=False,
            **options,
        )
        return see(motion)

    return of


def warned(f, *arguments):
    """What differentiating says of jumps."""
    with warnings.catch_warnings(record=True) as given:
        warnings.simplefilter("always")
        jax.block_until_ready(f(*arguments))
    return [
        str(w.message)
        for w in given
        if issubclass(w.category, jj.SensitivityWarning) and "jump" in str(w.message)
    ]


def test_a_derivative_across_a_jump_warns_where_no_step_ends_there():
    f = end(JUMPS["at a place"])
    assert not warned(jax.grad(f), -1.0)

    def see(motion):
        assert "the scene has no scalar program" in motion.unwatched
        return motion.q_end[1], motion.crossings

    dense = end(JUMPS["at a place"], see=see, backend="dense")
    for derivative in (jax.grad, jax.jacfwd):
        found = []
        slope = derivative(dense, has_aux=True)
        (said,) = warned(lambda speed, slope=slope, found=found: found.extend(slope(speed)), -1.0)
        assert found[1] == -1  # dense matrices do not watch relations
        assert "`Pushed`" in said
        assert "omit the shift of the jump's time" in said
    assert len(warned(slope, -0.1)) == 1  # whether the jump is met is not seen


def test_derivatives_of_lanes_warn():
    def mean(size, backend):
        options = {"ts": [0.5], "work": False, "backend": backend}
        lanes = jj.rollout(
            Pushed(push=JUMPS["at a place"], size=size),
            {"x": jnp.array([0.0, 1.0]), "x_rate": jnp.array([1.0, 2.0]) * size},
            **options,
        )
        return jnp.mean(lanes["y"][:, -1])

    assert not warned(jax.grad(mean), 0.3, "native")
    assert len(warned(jax.grad(mean), 0.3, "dense")) == 1


def test_a_fit_across_a_jump_does_not_warn_where_a_step_ends_there():
    scene, start = Pushed(push=lambda m, p: p * jnp.where(m.q.x > 0.2, 1.0, 2.0), size=0.3), {"x_rate": 1.0}
    ts = np.linspace(0.0, 1.0, 20)
    y = np.asarray(jj.simulate(scene, start, ts=ts)["y"])
    fit = jj.fit(scene.replace(size=0.25), jj.Experiment(ts, {"y": y}, 1e-3, start=start), ("size",))
    assert not any("a jump of its loads" in text for text in fit.warnings)
    assert abs(float(fit["size"].value) - 0.3) < 1e-6


class ByInput(Pushed):
    """The push along x is an input."""

    inputs = jj.inputs("pull")

    def loads(self, motion):
        return (*super().loads(motion), jj.generalized_force(motion, x_rate=motion.inputs.pull))


PULLS = {
    "switched on": (True, lambda on: lambda t: jnp.where(t > on, 1.0, 0.0)),
    "steps": (True, lambda on: lambda t: jnp.floor(t / (0.5 * on))),
    "switched on at a time that does not move": (False, lambda on: lambda t: jnp.where(t > 0.4, on, 0.0)),
    "a ramp": (False, lambda on: lambda t: jnp.clip(3.0 * (t - on), 0.0, 1.0)),
    "samples": (
        False,
        lambda on: jj.Sampled(jnp.stack([0.0 * on, on, 2.0 * on]), jnp.array([0.0, 1.0, 0.0])),
    ),
}


@pytest.mark.parametrize("name", PULLS)
def test_inputs_that_jump_at_a_time_that_moves(name):
    jumps, pull = PULLS[name]

    # machine code does not differentiate with respect to samples, and its steps end where inputs jump
    options = {"backend": "xla"} if name == "samples" else {"backend": "dense"} if jumps else {}

    def f(on):
        return jj.simulate(
            ByInput(push=KINKS["smooth"]), {}, ts=[1.0], inputs={"pull": pull(on)}, work=False, **options
        ).q_end[0]

    for slope in (jax.grad(f), jax.jacfwd(f))[: 1 + jumps]:
        assert len(warned(slope, 0.4)) == jumps


def test_a_derivative_along_which_no_time_moves_does_not_warn():
    pull = PULLS["switched on"][1]

    def f(on, size):
        scene = ByInput(push=KINKS["smooth"], size=size)
        return jj.simulate(scene, {}, ts=[1.0], inputs={"pull": pull(on)}, work=False, backend="dense").q_end[
            0
        ]

    assert len(warned(jax.grad(f, 0), 0.4, 0.4)) == 1
    assert not warned(jax.grad(f, 1), 0.4, 0.4)


ROUGH = {
    "one-sided": lambda m, p: jnp.maximum(m.q.x, 0.0),
    "a magnitude": lambda m, p: -p * jnp.abs(m.q.x),
    "a root": KINKS["a root"],
    "whole numbers": lambda m, p: p * jnp.floor(m.q.x),
    "a jump on one side": lambda m, p: jnp.where(m.q.x > 0.0, 1.0 + m.q.x, 0.0),
}
SMOOTH = {
    "stiff": lambda m, p: -p * jnp.sin(m.q.x) + 1e6 * (m.q.y + m.u.y_rate),
    "steep": lambda m, p: -p * jnp.tanh(1e5 * m.u.y_rate) + 1e3 * jnp.abs(m.q.x - 0.1),
    "air, Hertz and a guarded quotient": lambda m, p: (
        -1e3 * p * jnp.abs(m.u.y_rate) * m.u.y_rate
        + 1e5 * jnp.maximum(-m.q.y, 0.0) ** 1.5
        + KINKS["a guarded quotient"](m, p)
    ),
    "tables": lambda m, p: (
        jj.Spline(TS, jnp.sin(3.0 * TS))(m.q.x + 0.5) + jnp.interp(m.q.x + 0.3, TS, jnp.sin(TS))
    ),
    "large and far away": lambda m, p: 1e9 + 1e3 * jnp.where(m.q.x > 1.0, 2.0, m.q.x),
}
AT_REST = ROUGH | SMOOTH


@pytest.mark.parametrize("name", AT_REST)
def test_linearizing_where_a_load_has_no_slope_warns(name):
    with warnings.catch_warnings(record=True) as given:
        warnings.simplefilter("always")
        jj.linearize(Pushed(push=AT_REST[name]), {"x": 0.0, "y": 0.0, "x_rate": 0.0, "y_rate": 0.0})
    assert [
        "the force along `y_rate`" in str(w.message) for w in given if w.category is jj.SensitivityWarning
    ] == [True] * (name in ROUGH)


ONE_SIGN = {  # at all probed states; u_y(4) from rest at x = 0 with 3 m/s along x
    "of a place": (lambda m, p: jnp.abs(m.q.x - 5.0), 12.5 / 3 + 49.0 / 6),
    "by a root": (lambda m, p: jnp.sqrt((m.q.x - 5.0) ** 2), 12.5 / 3 + 49.0 / 6),
    "of a time": (lambda m, p: jnp.abs(m.t - 1.0), 5.0),
    "of a length": (lambda m, p: jnp.hypot(m.t - 1.0, 0.0), 5.0),
    "a bump": (lambda m, p: jnp.maximum(0.0, 1.0 - jnp.abs(m.q.x - 6.0)), 1.0 / 3),
}


@pytest.mark.parametrize("name", ONE_SIGN)
def test_a_magnitude_goes_on_past_its_switch(name):
    push, expected = ONE_SIGN[name]
    motion = jj.simulate(Pushed(push=push), {"x_rate": 3.0}, ts=[4.0], rtol=1e-9, atol=1e-9)
    assert motion.succeeded
    assert motion["y_rate"][-1] == pytest.approx(expected, abs=2e-3)


def test_a_magnitude_is_written_as_text():
    """The hypotenuse holds an infinity."""
    source = jj.lower(Pushed(push=ONE_SIGN["of a length"][0])).python_source()
    assert "abs(t - 1.0)" in source
    assert "math.inf" in source
