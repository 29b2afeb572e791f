"""Second derivatives by machine code: against closed forms, those of XLA and differences of first ones, at events, under `vmap`, and when XLA takes them."""

import functools

import diffrax
import jax
import jax.numpy as jnp
import machine_code
import numpy as np
import pytest
from ends_of_models import end_of_model

import jourdain_jax as jj

pytestmark = machine_code.needed

FORWARD = diffrax.ForwardMode()


def twice(f):
    return jax.jit(jax.jacfwd(jax.jacfwd(f)))


class Falling(jj.Scene):
    """A ball that is thrown against the wind, which is an input, and the ground."""

    mass: object = jj.parameter(1.5, unit="kg", positive=True)
    drag: object = jj.parameter(0.4, unit="kg/s", positive=True)
    coordinates = jj.coordinates("z")
    inputs = jj.inputs("wind")

    def bodies(self, t, q):
        return {"ball": jj.Particle(self.mass, jnp.stack([0.0 * q.z, 0.0 * q.z, q.z]))}

    def loads(self, motion):
        return (jj.generalized_force(motion, z_rate=-self.drag * (motion.u.z_rate - motion.inputs.wind) - 9.81 * self.mass),)

    def events(self, motion):
        return {"ground": motion.q.z}


X = jnp.array([1.5, 0.4, 2.0, 3.0, 0.7, 0.1, 0.5])  # mass, drag, height, speed, wind, start, a time saved


def _seen(x, events, **options):
    """States on the way, the end and its time."""
    start, options = {"z": x[2], "z_rate": x[3]}, {"rtol": 1e-11, "atol": 1e-11, "adjoint": FORWARD} | options
    options |= {"inputs": {"wind": x[4]}, "events": events, "t0": x[5], "ts": x[5] + jnp.stack([0.3, x[6]]), "t1": x[5] ** 2 + (9.0 if events else 1.0)}
    motion = jj.simulate(Falling(mass=x[0], drag=x[1]), start, **options)
    return jnp.concatenate([motion.q[:, 0], motion.u[1], motion.q_end, motion.u_end, motion.t_end[None]])


def _exact(x, events):
    """z = h + w t + (v - w) (1 - exp(-k t))/k with w the speed at which forces balance; the ground is met where Newton's method ends."""
    k, w = x[1] / x[0], x[4] - 9.81 * x[0] / x[1]

    def at(t):
        return x[2] + w * t + (x[3] - w) * (1 - jnp.exp(-k * t)) / k, w + (x[3] - w) * jnp.exp(-k * t)

    t = x[5] ** 2 + 1.0 - x[5]
    for _ in range(12 if events else 0):
        t = t - at(t)[0] / at(t)[1]
    return jnp.stack([at(0.3)[0], at(x[6])[0], at(x[6])[1], *at(t), x[5] + t])


LANES = X * (1 + 0.05 * np.random.default_rng(0).normal(size=(3, 7)))


@functools.cache
def seconds_of_the_closed_form(events):
    """Second derivatives of `_exact` in all lanes."""
    return np.asarray(jax.jit(jax.vmap(jax.jacfwd(jax.jacfwd(lambda x: _exact(x, events)))))(LANES))


@pytest.mark.parametrize(("events", "solver"), [(False, None), (True, None), (True, jj.Taylor())], ids=["to a time", "to the ground", "by series"])
def test_second_derivatives_of_falls_are_those_of_their_closed_form(events, solver):
    found = np.asarray(jax.jit(jax.vmap(jax.jacfwd(jax.jacfwd(lambda x: _seen(x, events, solver=solver, max_steps=1357)))))(LANES))
    np.testing.assert_allclose(found, seconds_of_the_closed_form(events), rtol=1e-8, atol=1e-8)
    np.testing.assert_allclose(found, np.swapaxes(found, 2, 3), rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("which", ["samples", "a third time"])
def test_what_machine_code_does_not_serve_is_left_to_xla(which):
    def height(x):
        wind = jj.Sampled([0.0, 0.5, 2.0], jnp.stack([x, 0.3 * x, x**2])) if which == "samples" else x
        start, options = {"z": 2.0, "z_rate": 1.0 + x}, {"adjoint": FORWARD, "events": False, "max_steps": 99, "rtol": 1e-10, "atol": 1e-10, "backend": "xla"}
        return jj.simulate(Falling(drag=0.4 * x), start, ts=[0.4], inputs={"wind": wind}, **options).q_end[0]

    lower = jax.jit(jax.jacfwd(jax.jacfwd(height) if which == "a third time" else height))
    found, h = jax.jit(jax.jacfwd(lower))(1.0), 1e-4
    np.testing.assert_allclose(found, (lower(1.0 + h) - lower(1.0 - h)) / (2 * h), rtol=1e-6)


@pytest.mark.parametrize(
    ("name", "start", "parameters", "options"),
    [
        ("chaplygin-sleigh", None, ["mass", "inertia"], {"t1": 2.0}),
        ("tilting-disc", {"lean": 0.6, "spin_rate": -0.1}, ["radius", "mass"], {"t1": 5.0}),
        ("tilting-disc", {"lean": 0.0}, ["radius", "gravity"], {"t1": 0.5}),
        ("rattleback", None, [], {"t1": 0.5}),
        ("double-pendulum-rods", None, [], {"t1": 0.5}),
        ("tilting-disc-quaternion", None, ["radius"], {"t1": 0.5, "formulation": jj.Formulation("full")}),
    ],
    ids=["sleigh", "falling disc", "disc at rest", "rattleback", "rods", "quaternion"],
)
def test_second_derivatives_of_a_model_are_those_of_xla(name, start, parameters, options):
    ends = (end_of_model(name, start, parameters, backend=backend, adjoint=FORWARD, **options) for backend in ("native", "xla"))
    found, expected = (np.asarray(twice(end)(x)) for end, x in ends)
    np.testing.assert_allclose(found, expected, rtol=1e-8, atol=1e-8 * np.max(np.abs(expected)))
    assert np.any(expected != 0)


@pytest.mark.parametrize("formulation", [jj.Formulation(), jj.Formulation(stabilisation=None)], ids=["projected", "not projected"])
def test_second_derivatives_of_a_bicycle_are_differences_of_first_ones(formulation):
    end, x = end_of_model("whipple-bicycle", None, ["w", "g", "mB"], t1=0.5, formulation=formulation, adjoint=FORWARD)
    first, h = jax.jit(jax.jacfwd(end)), 1e-4
    differences = [(8 * (first(x + h * e) - first(x - h * e)) - first(x + 2 * h * e) + first(x - 2 * h * e)) / (12 * h) for e in np.eye(5)]
    np.testing.assert_allclose(twice(end)(x), differences, rtol=1e-5, atol=1e-6 * np.max(np.abs(differences)))
