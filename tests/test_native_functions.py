"""Inputs that are functions of time, in machine code: motions and derivatives are those of closed forms and
of XLA.
"""

from concurrent.futures import ThreadPoolExecutor

import jax
import jax.numpy as jnp
import machine_code
import numpy as np
import pytest
import result_codes as results
from numpy.testing import assert_allclose, assert_array_equal
from small_scenes import OnPlane

import jourdain_jax as jj

pytestmark = machine_code.needed
TS = np.array([0.3, 1.0, 1.7, 2.5])
TIGHT = {"rtol": 1e-11, "atol": 1e-11, "work": False}
both_modes = pytest.mark.parametrize("derivative", [jax.jacrev, jax.jacfwd])


class Pushed(OnPlane):
    """x'' = force - k x, and beside it y'' = aside; it stops where x has come to the wall, which the force
    moves.
    """

    k: float = jj.parameter(4.0)
    wall: float = jj.parameter(9.0)
    inputs = jj.inputs("force aside")

    def loads(self, motion):
        return jj.generalized_force(
            motion, x_rate=motion.inputs.force - self.k * motion.q.x, y_rate=motion.inputs.aside
        )

    def events(self, motion):
        return {"wall": self.wall - motion.q.x - 0.1 * motion.inputs.force}


def position(t, x, k, a, b):
    """x(t) at rest at first, where the force is a sin(b t)."""
    w, driven = jnp.sqrt(k), a / (k - b**2)
    return x * jnp.cos(w * t) - driven * b / w * jnp.sin(w * t) + driven * jnp.sin(b * t)


X = {"x": 0.3, "k": 4.0, "a": 0.8, "b": 1.3}


def motion(x, k, a, b, aside=0.0, wall=9.0, **options):
    inputs = {"force": lambda t: a * jnp.sin(b * t), "aside": aside}
    return jj.simulate(Pushed(k, wall), {"x": x}, ts=TS, inputs=inputs, **TIGHT | options)


@both_modes
def test_motions_and_derivatives_are_those_of_the_closed_form(derivative):
    found = motion(**X)
    assert found.reduction.endswith("machine code")
    assert_allclose(found["x"], position(TS, **X), rtol=0, atol=1e-9)
    slopes = jax.jit(derivative(lambda x: motion(**x)["x"]))(X)
    for name, expected in jax.jit(jax.jacfwd(lambda x: position(TS, **x)))(X).items():
        assert_allclose(slopes[name], expected, rtol=0, atol=1e-8, err_msg=name)


def test_functions_samples_and_numbers_stand_side_by_side():
    record = jj.Sampled([0.0, 1.0, 3.0], [0.0, 0.6, 0.2])
    for aside in (record, 0.7):
        found = motion(**X, aside=aside)
        assert found.reduction.endswith("machine code")
        assert_allclose(found["x"], position(TS, **X), rtol=0, atol=1e-9)
    assert_allclose(found["y"], 0.35 * TS**2, rtol=0, atol=1e-10)
    slope = jax.jit(jax.jacfwd(lambda f: motion(**X, aside=f)["y"]))(0.7)
    assert_allclose(slope, TS**2 / 2, rtol=0, atol=1e-9)
    of_record = jax.jit(jax.jacfwd(lambda a: motion(**X | {"a": a}, aside=record)["x"]))(0.8)
    expected = np.subtract(*(position(TS, **X | {"a": a}) for a in (1.0, 0.0)))
    assert_allclose(of_record, expected, rtol=0, atol=1e-9)


@both_modes
def test_an_event_may_depend_on_a_function_of_time(derivative):

    def end(a):
        return motion(-0.3, 4.0, a, 1.3, wall=0.2)

    def gap(t, a):
        return 0.2 - position(t, -0.3, 4.0, a, 1.3) - 0.1 * a * jnp.sin(1.3 * t)

    found = end(0.8)
    assert found.result == results.EVENT
    assert abs(gap(found.t_end, 0.8)) < 1e-9
    by_t, by_a = jax.grad(gap, (0, 1))(found.t_end, 0.8)
    slope = jax.jit(derivative(lambda a: end(a).t_end))(0.8)
    assert_allclose(slope, -by_a / by_t, rtol=0, atol=1e-7)


def test_threads_that_make_the_same_machine_code_at_once_all_get_it():
    class Fresh(Pushed):
        """A scene of which nothing is known yet."""

    def end(_):
        return jj.simulate(Fresh(), {"x": 0.1}, ts=TS, inputs={"force": lambda t: t}, **TIGHT)["x"]

    with ThreadPoolExecutor(2) as threads:
        assert_array_equal(*threads.map(end, range(2)))
