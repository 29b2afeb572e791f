"""Derivatives of motions that failed: NaN for what lies after the failure, right before it, and zero where nobody
asks, so that lanes left out of a loss disturb none.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose
from small_scenes import OnLine

import jourdain_jax as jj


class Slider(OnLine):
    """A mass on a spring, in a well that has no numbers below its edge."""

    stiffness: jnp.ndarray = jj.parameter(4.0, unit="N/m")
    mass: jnp.ndarray = jj.parameter(1.0, unit="kg", positive=True)
    edge: jnp.ndarray = jj.parameter(-50.0, unit="m")

    def loads(self, motion):
        force = -self.stiffness * motion.q.x + jnp.sqrt(motion.q.x - self.edge)
        return (jj.generalized_force(motion, x_rate=force),)


# what the second lane has in place of (amplitude 1, stiffness p, mass 1, edge -50), and whether it takes steps
FAILURES = {
    "steps": ((1.0, 1e8, 1.0, -50.0), True),
    "domain": ((1.0, 40.0, 1.0, 0.3), True),
    "parameter": ((1.0, 1.0, -1.0, -50.0), False),
    "start": ((jnp.nan, 1.0, 1.0, -50.0), False),
}
TIMES = [2e-4, 1.0]


def _first(p, amplitude):
    return jnp.where(jnp.isnan(amplitude), amplitude, 0.5 * p)  # numbers that are lost here are no product with p


def _lanes(kind, backend, rolled):
    """p -> (loss over lanes that succeeded, the early state of the second lane, its end); p is shared by all lanes."""
    factors = jnp.array([(1.0, 1.0, 1.0, -50.0), FAILURES[kind][0]])

    def found(p):
        def one(numbers):
            amplitude, stiffness, mass, edge = numbers
            scene = Slider(stiffness=stiffness * p, mass=mass, edge=edge)
            return jj.simulate(scene, {"x": _first(p, amplitude)}, ts=TIMES, max_steps=60, backend=backend)

        if rolled:
            amplitude, stiffness, mass, edge = factors.T
            parameters = {"stiffness": stiffness * p, "mass": mass, "edge": edge}
            options = {"ts": TIMES, "max_steps": 60, "backend": backend}
            motions = jj.rollout(Slider(), {"x": _first(p, amplitude)}, parameters=parameters, **options).lanes
        else:
            motions = jax.vmap(one)(factors)
        ok = motions.succeeded
        loss = jnp.sum(jnp.where(ok, motions.q_end[:, 0], 0.0) ** 2)
        return jnp.stack([loss, motions.q[1, 0, 0], motions.q_end[1, 0], motions.t_end[1]]), ok

    return found


def _alone(numbers, end):
    amplitude, stiffness, mass, edge = numbers

    def state(p, name="q_end"):
        scene = Slider(stiffness=stiffness * p, mass=mass, edge=edge)
        return getattr(jj.simulate(scene, {"x": _first(p, amplitude)}, ts=[end], backend="native"), name)[0]

    return state


CASES = [(kind, backend, rolled) for kind in FAILURES for backend in ("native", "xla") for rolled in (False, True)]
QUICK = {("domain", "native", False), ("start", "native", False)}


MARKED = [pytest.param(c, marks=() if c in QUICK else pytest.mark.slow) for c in CASES]


@pytest.mark.parametrize("case", MARKED, ids=lambda c: f"{c[0]}-{c[1]}-{c[2]}")
def test_they_are_nan_after_the_failure_right_before_it_and_zero_where_nobody_asks(case):
    kind, backend, rolled = case
    numbers, moves = FAILURES[kind]
    found = _lanes(kind, backend, rolled)
    slope, ok = jax.jit(jax.jacrev(found, has_aux=True))(1.0)
    assert ok.tolist() == [True, False]
    good = _alone((1.0, 1.0, 1.0, -50.0), 1.0)
    assert_allclose(slope[0], jax.grad(lambda p: good(p) ** 2)(1.0), rtol=1e-6)
    assert np.isnan(slope[2:]).all()
    if moves:
        assert_allclose(slope[1], jax.grad(_alone(numbers, TIMES[0]))(1.0), rtol=1e-6)
    else:
        assert np.isnan(slope[1])
    if backend == "native":
        twice = jax.jit(jax.hessian(lambda p: found(p)[0]))(1.0)
        assert_allclose(jax.jit(jax.jacfwd(lambda p: found(p)[0]))(1.0), slope, rtol=1e-8)
        assert_allclose(twice[0], jax.hessian(lambda p: good(p) ** 2)(1.0), rtol=1e-5)
        assert np.isnan(twice[2:]).all()


def test_a_single_motion_that_failed_has_no_derivative_at_its_end():
    def end(p, name):
        motion = jj.simulate(Slider(stiffness=40.0 * p, edge=0.3), {"x": 0.5 * p}, ts=TIMES, max_steps=60, backend="native")
        return getattr(motion, name)[0].sum()

    assert np.isnan(jax.grad(end)(1.0, "q_end"))
    assert np.isnan(jax.jacfwd(end)(1.0, "u_end"))
    assert np.isnan(jax.grad(jax.grad(end))(1.0, "q_end"))
    before = _alone((1.0, 40.0, 1.0, 0.3), TIMES[0])
    assert_allclose(jax.grad(end)(1.0, "u"), jax.grad(lambda p: before(p, "u_end"))(1.0), rtol=1e-6)
