"""Derivatives with respect to the times of a motion by machine code: against XLA and differences, up to
events and of motions that fail.
"""

import jax
import jax.numpy as jnp
import machine_code
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from small_scenes import OnLine

import jourdain_jax as jj

pytestmark = machine_code.needed

MODES = "jacfwd", "jacrev"


class Driven(OnLine):
    """A particle on a spring whose push changes with time, by a formula and by an input, and a wall at x =
    -1.2.
    """

    mass = 1.5
    inputs = jj.inputs("push")
    example = {"x": 1.1, "x_rate": 0.7}

    def loads(self, motion):
        push = motion.inputs.push + jnp.cos(2.0 * motion.t) - 0.3 * motion.u.x_rate
        return jj.generalized_force(motion, x_rate=push - 6.0 * motion.q.x)

    def events(self, motion):
        return {"wall": 1.2 + motion.q.x}


PUSH = jj.Sampled([0.0, 0.5, 0.8, 1.5, 4.0], [0.3, 0.1, 0.9, -0.4, 0.2])
DISC = jj.models.TiltingDisc()
CASES = {
    "driven": (Driven(), None, {"inputs": {"push": PUSH}, "events": False}),
    "driven, backwards": (Driven(), None, {"inputs": {"push": PUSH}, "events": False}),
    "driven, up to a wall": (Driven(), None, {"inputs": {"push": PUSH}}),
    "driven, by Taylor series": (Driven(), None, {"solver": jj.Taylor()}),
    "disc that falls": (DISC, {"lean": 0.6, "spin_rate": -0.1}, {}),
    "disc with a quaternion, projected": (
        jj.models.TiltingDiscQuaternion(),
        None,
        {"formulation": jj.Formulation("full"), "events": False},
    ),
}
TIMES = np.array([0.2, 0.45, 0.71, 1.3])  # start, two that are saved, end
BACK = np.array([2.0, 1.9, 1.2, 0.6])


def _seen(name, times, backend="native", **options):
    """What a motion from the first of the times to the last shows: states at those between, the end with its
    time and the work done until then.
    """
    scene, start, given = CASES[name]
    options = {"rtol": 1e-11, "atol": 1e-11} | given | options
    start = scene.example if start is None else start
    motion = jj.simulate(scene, start, t0=times[0], ts=times[1:-1], t1=times[-1], backend=backend, **options)
    saved = jnp.where(
        motion.ts * jnp.sign(times[-1] - times[0]) <= motion.t_end * jnp.sign(times[-1] - times[0]),
        motion.q[:, 0],
        0.0,
    )
    work = jnp.zeros(0) if motion.work is None else motion.work[:1]
    return jnp.concatenate([saved, motion.u[:1, 0], work, motion.q_end, motion.u_end, motion.t_end[None]])


@pytest.mark.parametrize("name", CASES)
def test_derivatives_with_respect_to_times_are_differences(name):
    times, h = BACK if "backwards" in name else TIMES, 1e-4
    seen, steps = jax.jit(jax.vmap(lambda t: _seen(name, t))), h * np.eye(4)
    near = np.asarray(seen(jnp.concatenate([times + k * steps for k in (-2, -1, 1, 2)]))).reshape(4, 4, -1)
    differences = np.einsum("k,kij->ji", [1.0, -8.0, 8.0, -1.0], near) / (12.0 * h)
    for mode in MODES:
        found = jax.jit(getattr(jax, mode)(lambda t: _seen(name, t)))(times)
        assert_allclose(found, differences, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("mode", MODES)
def test_a_motion_that_starts_beyond_an_event_ends_where_and_when_it_starts(mode):
    def end(t):
        motion = jj.simulate(Driven(), {"x": -1.3, "x_rate": 0.2}, t0=t[0], ts=t[1:])
        return jnp.concatenate([motion.q_end, motion.u_end, motion.t_end[None]])

    found = jax.jit(getattr(jax, mode)(end))(jnp.array([0.2, 0.5]))
    assert_array_equal(found, [[0.0, 0.0], [0.0, 0.0], [1.0, 0.0]])


def test_third_derivatives_with_respect_to_times_are_refused():
    def end(x, time):
        return jj.simulate(Driven(), {"x": x, "x_rate": 0.2}, ts=[time], backend="xla", events=False).q_end[0]

    along = lambda f: lambda a: jax.jvp(f, (a,), (1.0,))[1]
    with pytest.raises(jj.DifferentiationModeError, match="no third derivatives with respect to times"):
        jax.jit(along(along(along(lambda a: end(a, a))))).lower(0.3)
