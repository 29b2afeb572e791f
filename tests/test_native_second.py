"""Second derivatives by machine code in all modes: closed forms, and what is refused."""

import functools

import jax
import jax.numpy as jnp
import machine_code
import numpy as np
import pytest
from numpy.testing import assert_allclose

import jourdain_jax as jj
from jourdain_jax import DifferentiationModeError

pytestmark = machine_code.needed


class Falling(jj.Scene):
    """A ball that is thrown against the wind, which is an input, and the ground."""

    mass: object = jj.parameter(1.5, positive=True)
    drag: object = jj.parameter(0.4, positive=True)
    coordinates = jj.coordinates("z")
    inputs = jj.inputs("wind")

    def bodies(self, t, q):
        return {"ball": jj.Particle(self.mass, [0.0, 0.0, q.z])}

    def loads(self, motion):
        return jj.generalized_force(
            motion, z_rate=-self.drag * (motion.u.z_rate - motion.inputs.wind) - 9.81 * self.mass
        )

    def events(self, motion):
        return {"ground": motion.q.z}


X = np.array([1.5, 0.4, 2.0, 3.0, 0.7, 0.1, 0.5])  # mass, drag, height, speed, wind, start, a time saved


def _seen(x, events, **options):
    """States on the way, the end and its time."""
    start, options = {"z": x[2], "z_rate": x[3]}, {"rtol": 1e-11, "atol": 1e-11} | options
    options |= {
        "inputs": {"wind": x[4]},
        "events": events,
        "t0": x[5],
        "ts": x[5] + jnp.stack([0.3, x[6]]),
        "t1": x[5] ** 2 + (9.0 if events else 1.0),
    }
    motion = jj.simulate(Falling(mass=x[0], drag=x[1]), start, **options)
    return jnp.concatenate([motion.q[:, 0], motion.u[1], motion.q_end, motion.u_end, motion.t_end[None]])


def _exact(x, events):
    """z = h + w t + (v - w) (1 - exp(-k t))/k with w the speed at which forces balance; the ground is met
    where Newton's method ends.
    """
    k, w = x[1] / x[0], x[4] - 9.81 * x[0] / x[1]

    def at(t):
        return x[2] + w * t + (x[3] - w) * (1 - jnp.exp(-k * t)) / k, w + (x[3] - w) * jnp.exp(-k * t)

    end = x[5] ** 2 + 1.0 - x[5]
    t = jax.lax.fori_loop(0, 12, lambda _, t: t - at(t)[0] / at(t)[1], end) if events else end
    return jnp.stack([at(0.3)[0], at(x[6])[0], at(x[6])[1], *at(t), x[5] + t])


LANES = X * (1 + 0.05 * np.random.default_rng(0).normal(size=(3, 7)))


MODES = {
    "forward of reverse": (jax.jacfwd, jax.jacrev),
    "reverse of forward": (jax.jacrev, jax.jacfwd),
    "reverse of reverse": (jax.jacrev, jax.jacrev),
    "forward of forward": (jax.jacfwd, jax.jacfwd),
}


def both_orders(mode, f):
    """Second derivatives of a function, and first ones, as these modes find them."""
    outer, inner = MODES[mode]
    first = inner(f)
    return outer(lambda x: (first(x),) * 2, has_aux=True)


@functools.cache
def derivatives_of_the_closed_form(events):
    """Those of `_exact` in all lanes."""
    return jax.jit(jax.vmap(both_orders("forward of forward", lambda x: _exact(x, events))))(LANES)


def _height(x, samples=False, **options):
    wind = jj.Sampled([0.0, 0.5, 2.0], jnp.stack([x, 0.3 * x, x**2])) if samples else 0.3
    options |= {"inputs": {"wind": wind}, "events": False, "rtol": 1e-10, "atol": 1e-10}
    return jj.simulate(Falling(drag=0.4 * x), {"z": 2.0, "z_rate": 1.0 + x}, ts=[0.4], **options).q_end[0]


MOTIONS = [
    *((mode, True, None) for mode in MODES),
    *((mode, False, None) for mode in list(MODES)[::3]),
    *((mode, True, jj.Taylor()) for mode in list(MODES)[::3]),
]


@pytest.mark.parametrize(("mode", "events", "solver"), MOTIONS)
def test_all_modes_are_those_of_the_closed_form(mode, events, solver):
    """With respect to parameters, a start, an input, the start's time, a time saved and the end; or up to an
    event.
    """
    seen = lambda x: _seen(x, events, solver=solver, max_steps=1357)
    found, first = jax.jit(jax.vmap(both_orders(mode, seen)))(LANES)
    right, right_first = derivatives_of_the_closed_form(events)
    assert_allclose(first, right_first, rtol=1e-9, atol=1e-9)
    assert_allclose(found, right, rtol=1e-8, atol=1e-8)
    assert_allclose(found, np.swapaxes(found, 2, 3), rtol=1e-9, atol=1e-9)


def _lowest(x, wind, **options):
    """What is asked of one fall."""
    motion = jj.simulate(
        Falling(mass=x[0], drag=x[1]),
        {"z": x[2], "z_rate": x[3]},
        t1=9.0,
        inputs={"wind": wind},
        rtol=1e-10,
        atol=1e-10,
        **options,
    )
    return motion.t_end**2 + motion.u_end[0] * x[0]


def test_hessians_under_an_input_that_is_samples():
    """Up to an event whose time such an input moves."""
    wind = jj.Sampled([0.0, 0.3, 0.8, 2.0], [0.0, 1.5, -2.0, 1.0])
    fall = lambda x: _lowest(x, wind)
    found, expected = (jax.jit(f)(X) for f in (jax.hessian(fall), jax.jacfwd(jax.jacfwd(fall))))
    assert_allclose(found, expected, rtol=1e-9, atol=1e-9)
    assert np.all(found[:4, :4] != 0)


@pytest.mark.parametrize(
    ("of", "options", "says"),
    [
        ("reverse of reverse", {"backend": "xla"}, "machine code"),
        ("forward of reverse", {"samples": True}, "samples"),
    ],
)
def test_what_is_not_there_is_refused_by_name(of, options, says):
    with pytest.raises(DifferentiationModeError, match=says):
        jax.jit(both_orders(of, lambda x: _height(x, **options))).lower(1.0)


def test_derivatives_of_the_third_order_are_refused_unless_forward_mode_takes_them():
    with pytest.raises(DifferentiationModeError, match="three times"):
        jax.eval_shape(jax.jacrev(jax.jacrev(jax.jacrev(_height))), 1.0)
