"""Inputs given by samples, in machine code: against the loop of XLA, which takes the same steps, and against
closed forms.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import result_codes as results
from numpy.testing import assert_allclose, assert_array_equal
from small_scenes import OnLine

import jourdain_jax as jj


class Pushed(OnLine):
    """An oscillator with two inputs and a wall."""

    inputs = jj.inputs("push pull")
    mass = 1.5
    wall: object = jj.parameter(0.8)

    def loads(self, motion):
        f = motion.inputs
        return jj.generalized_force(motion, x_rate=f.push * motion.q.x + f.pull - 6.0 * motion.q.x)

    def events(self, motion):
        return {"wall": self.wall - motion.q.x}


OPTIONS = {"ts": np.array([0.0, 0.25, 0.7, 1.1]), "t1": 1.7, "rtol": 1e-10, "atol": 1e-10}
TIMES = np.array([-0.3, 0.1, 0.25, 0.4, 0.9, 1.3])


def inputs(scale=1.0):
    """A record with a knot at a saved time, one before the start, and a jump; and a constant."""
    return {
        "push": jj.Sampled(TIMES, scale * jnp.array([0.0, 2.0, -3.0, 5.0, 0.5, 1.0])),
        "pull": jj.Sampled([0.6, 0.601], [0.0, 0.4]),
    }


def numbers(motion):
    return jnp.concatenate([motion.q.ravel(), motion.u_end, motion.t_end[None]])


@pytest.mark.parametrize(
    "more",
    [
        {"events": False},
        {},
        {"t1": -1.7, "ts": -OPTIONS["ts"], "events": False},
        {"rtol": 1e-5, "atol": 1e-5},
    ],
    ids=["plain", "to a wall", "backwards", "loose"],
)
def test_steps_are_those_of_xla(more):
    options = OPTIONS | more
    ours, theirs = (
        jj.simulate(Pushed(), {"x": 0.5, "x_rate": 0.2}, inputs=inputs(), backend=backend, **options)
        for backend in ("native", "xla")
    )
    for name in ("result", "accepted", "rejected", "event"):
        assert getattr(ours, name) == getattr(theirs, name)
    assert_allclose(numbers(ours), numbers(theirs), rtol=1e-13, atol=1e-13)


def test_a_record_far_from_time_zero_is_followed_as_at_zero():
    ends, options = [], {"rtol": 1e-10, "atol": 1e-10, "backend": "native"}
    for t0 in (0.0, 2.0**30):  # a clock with three bits less than a microsecond
        pull = {"pull": jj.Sampled(t0 + np.arange(9) / 4, np.sin(np.arange(9.0)))}
        times = {"t0": t0, "ts": [t0 + 0.75, t0 + 2.0]}
        ends.append(jj.simulate(Pushed(), {"x": 0.5}, inputs=pull, **times, **options).q)
    assert_array_equal(*ends)


def test_derivatives_with_respect_to_samples_are_refused_by_a_text_that_names_the_backend_that_has_them():
    end = lambda s: jj.simulate(Pushed(), {"x": 0.5}, inputs=inputs(s), events=False, **OPTIONS).q_end[0]
    with pytest.raises(jj.DifferentiationModeError, match=r'samples of an input.*backend="xla"'):
        jax.grad(end)(1.3)


def test_a_blow_is_felt_and_one_sample_is_a_constant():
    blow = {"pull": jj.Sampled([0.5, 0.5005, 0.501], [0.0, 3000.0, 0.0])}  # 1.5 N s
    motion = jj.simulate(Pushed(), {"x": 0.0}, inputs=blow, t1=0.501, rtol=1e-9, atol=1e-9, backend="native")
    assert_allclose(motion.u_end, 1.0, rtol=1e-5)  # less what the spring has taken within the blow
    constant, sampled = (
        jj.simulate(Pushed(), {"x": 0.3}, inputs={"pull": f}, backend="native", **OPTIONS)
        for f in (0.4, jj.Sampled([3.0], [0.4]))
    )
    assert_array_equal(constant.q, sampled.q)


def test_a_record_that_is_no_number_ends_its_lane_alone():
    values = jnp.ones((3, 6)).at[1, 3].set(jnp.nan)
    options = OPTIONS | {"events": False, "backend": "native"}
    push = lambda v: {"push": jj.Sampled(TIMES, v)}
    motion = jax.vmap(lambda v: jj.simulate(Pushed(), {"x": 0.3}, inputs=push(v), **options))(values)
    assert motion.result[1] not in (results.SUCCESS, results.EVENT)
    assert_array_equal(motion.q[0], motion.q[2])
    assert np.isfinite(motion.q[0]).all()


class Until(Pushed):
    """It ends when the push does."""

    def events(self, motion):
        return {"released": motion.inputs.push - 0.1}


def test_inputs_that_machine_code_does_not_take_are_left_to_xla():
    def taken(scene, given):
        return jax.eval_shape(
            lambda: jj.simulate(scene, {"x": 0.1}, inputs=given, t1=0.1)
        ).reduction.endswith("machine code")

    assert taken(Pushed(), inputs())
    table = jnp.linspace(0.0, 1.0, 300)
    assert not taken(Pushed(), {"pull": lambda t: jnp.sum(table) * t})
    assert not taken(Pushed(), {"pull": lambda t: jnp.interp(t, table[:9], table[:9])})
    assert not taken(Until(), inputs())
