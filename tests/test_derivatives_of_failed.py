"""Derivatives of motions that failed, and what is answered inside of a derivative, jit or vmap where numbers
are not known.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from derivatives import with_value
from numpy.testing import assert_allclose
from small_scenes import BeadOnTurningWire, OnLine

import jourdain_jax as jj

# Derivatives of motions that failed: NaN for what lies after the failure, right before it, and zero where
# nobody


class Slider(OnLine):
    """A mass on a spring, in a well that has no numbers below its edge."""

    stiffness: float = jj.parameter(4.0, unit="N/m")
    mass: float = jj.parameter(1.0, unit="kg", positive=True)
    edge: float = jj.parameter(-50.0, unit="m")

    def loads(self, motion):
        force = -self.stiffness * motion.q.x + jnp.sqrt(motion.q.x - self.edge)
        return jj.generalized_force(motion, x_rate=force)


# what the second lane has in place of (amplitude 1, stiffness p, mass 1, edge -50), and whether it takes
# steps
FAILURES = {
    "steps": ((1.0, 1e8, 1.0, -50.0), True),
    "domain": ((1.0, 40.0, 1.0, 0.3), True),
    "parameter": ((1.0, 1.0, -1.0, -50.0), False),
    "start": ((np.nan, 1.0, 1.0, -50.0), False),
}
TIMES = [2e-4, 1.0]


def _first(p, amplitude):
    return jnp.where(
        jnp.isnan(amplitude), amplitude, 0.5 * p
    )  # numbers that are lost here are no product with p


def _lanes(kind, backend, rolled):
    """p -> (loss over lanes that succeeded, the early state of the second lane, its end); p is shared by all
    lanes.
    """
    factors = np.array([(1.0, 1.0, 1.0, -50.0), FAILURES[kind][0]])

    def found(p):
        def one(numbers):
            amplitude, stiffness, mass, edge = numbers
            scene = Slider(stiffness=stiffness * p, mass=mass, edge=edge)
            return jj.simulate(scene, {"x": _first(p, amplitude)}, ts=TIMES, max_steps=60, backend=backend)

        if rolled:
            amplitude, stiffness, mass, edge = factors.T
            parameters = {"stiffness": stiffness * p, "mass": mass, "edge": edge}
            options = {"ts": TIMES, "max_steps": 60, "backend": backend}
            motions = jj.rollout(
                Slider(), {"x": _first(p, amplitude)}, parameters=parameters, **options
            ).lanes
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


CASES = [
    (kind, backend, rolled) for kind in FAILURES for backend in ("native", "xla") for rolled in (False, True)
]


@pytest.mark.parametrize("case", CASES, ids=lambda c: f"{c[0]}-{c[1]}-{c[2]}")
def test_they_are_nan_after_the_failure_right_before_it_and_zero_where_nobody_asks(case):
    kind, backend, rolled = case
    numbers, moves = FAILURES[kind]
    found, good = _lanes(kind, backend, rolled), _alone((1.0, 1.0, 1.0, -50.0), 1.0)

    def once(p):
        slope, ok = jax.jacrev(found, has_aux=True)(p)
        return slope, (slope, ok)

    right_twice, right = with_value(jax.jacfwd, jax.grad(lambda p: good(p) ** 2))(1.0)
    if backend == "native":
        twice, (slope, ok) = jax.jit(jax.jacfwd(once, has_aux=True))(1.0)
        assert_allclose(jax.jit(jax.jacfwd(lambda p: found(p)[0]))(1.0), slope, rtol=1e-8)
        assert_allclose(twice[0], right_twice, rtol=1e-5)
        assert np.isnan(twice[2:]).all()
    else:
        slope, ok = jax.jit(once)(1.0)[1]
    assert ok.tolist() == [True, False]
    assert_allclose(slope[0], right, rtol=1e-6)
    assert np.isnan(slope[2:]).all()
    if moves:
        assert_allclose(slope[1], jax.jit(jax.grad(_alone(numbers, TIMES[0])))(1.0), rtol=1e-6)
    else:
        assert np.isnan(slope[1])


# What is not known inside a derivative, `jit` or `vmap` is answered by an error of our own, and a wrong
# parameter by NaN.


@pytest.mark.parametrize("ask", [jj.report, jj.verify, jj.analysis.energy_balance, jj.sample_states])
@pytest.mark.parametrize("inside", [jax.jit, jax.vmap, lambda f: lambda x: jax.jvp(f, (x,), (x,))])
def test_functions_that_need_numbers_say_so_by_name(ask, inside):
    with pytest.raises(
        jj.DifferentiationModeError,
        match=rf"`{ask.__name__}` was called inside jit, vmap or a derivative.*outside",
    ):
        inside(lambda radius: ask(jj.models.TiltingDisc(radius=radius)))(
            jnp.array([0.5]) if inside is jax.vmap else 0.5
        )


def test_what_a_motion_says_in_words_and_pictures_needs_its_numbers(tmp_path):
    motion = jj.simulate(BeadOnTurningWire(), {"r": 0.5}, ts=[0.1])
    written = {jj.save: "motion.npz", jj.show: "motion.html", jj.plot: "motion.png", jj.animate: "motion.gif"}
    asks = {
        ask.__name__: lambda motion, ask=ask, name=name: ask(motion, path=tmp_path / name)
        for ask, name in written.items()
    }
    asks |= {
        "message": lambda motion: motion.message,
        "warnings": lambda motion: motion.warnings,
        "raise_if_failed": lambda motion: motion.raise_if_failed(),
    }
    for name, ask in asks.items():
        with pytest.raises(jj.DifferentiationModeError, match=f"`{name}` was called inside jit"):
            jax.jit(ask)(motion)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("derivative", [jax.jacrev, jax.jacfwd])
@pytest.mark.parametrize("backend", ["auto", "xla"])
def test_a_wrong_parameter_has_derivatives_that_are_nan(derivative, backend):
    scene = jj.models.Skate()

    def place(gravity_and_speed):
        mass, speed = gravity_and_speed
        return jj.simulate(
            scene.replace(mass=mass), {"x_rate": speed, "heading_rate": 0.7}, ts=[0.5], backend=backend
        ).q[0]

    numbers = jnp.array([[1.0, 0.5], [jnp.nan, 0.5], [-1.0, 0.5]])
    lanes = jax.jit(jax.vmap(derivative(place)))
    slopes, right = lanes(numbers), lanes(numbers[jnp.zeros(3, int)])
    assert_allclose(slopes[0], right[0], rtol=1e-10, atol=1e-12)
    assert np.isfinite(right).all()
    assert np.isnan(slopes[1:, :, 0]).all()
