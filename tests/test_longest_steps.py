"""No step is longer than a part of the span: in machine code, in XLA's loop, by Taylor series and by diffrax; the same steps in the first two."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small_scenes import OnLine

import jourdain_jax as jj


class Bead(OnLine):
    """m x'' = -k x"""

    stiffness: float = jj.parameter(0.0)

    def loads(self, motion):
        return (jj.generalized_force(motion, x_rate=-self.stiffness * motion.q.x),)


FREE = Bead()
START = {"x": 1.0, "x_rate": 0.5}
WAYS = {"native": {}, "xla": {"backend": "xla"}, "dense": {"backend": "dense"}, "Taylor": {"solver": jj.Taylor()}, "Tsit5": {"solver": diffrax.Tsit5()}}
WAYS |= {"implicit": {"solver": jj.RadauIIA()}, "diffrax": {"solver": diffrax.Kvaerno3(), "work": False}}


def steps(**options):
    motion = jj.simulate(FREE, START, ts=[3.0], **options)
    assert np.isclose(float(motion.q_end[0]), 2.5, rtol=1e-9)
    return int(motion.accepted)


@pytest.mark.parametrize("way", WAYS)
def test_steps_are_no_longer_than_a_part_of_the_span(way):
    unbound, usual, short = (steps(**WAYS[way], **more) for more in ({"max_step": np.inf}, {}, {"max_step": 0.01}))
    assert unbound < 16 <= usual < 40
    assert 300 <= short < 330


def test_both_loops_take_the_same_steps_in_lanes_and_under_jit_and_back_in_time():
    starts = {"x": 1.0, "x_rate": jnp.linspace(-1.0, 2.0, 5)}
    lanes = [jj.rollout(FREE, starts, ts=[-3.0], max_step=0.3, backend=backend, progress=False).lanes for backend in ("native", "xla")]
    one = jax.jit(lambda longest: jj.simulate(FREE, START, ts=[-3.0], max_step=longest).accepted)(0.3)
    for motion in lanes:
        np.testing.assert_array_equal(motion.accepted, int(one))


@pytest.mark.parametrize("derivative", [jax.grad, jax.jacfwd])
@pytest.mark.parametrize("backend", ["native", "xla"])
def test_derivatives_go_through_bounded_steps(backend, derivative):
    def end(x):
        return jj.simulate(Bead(x), START, ts=[1.0], max_step=0.02, backend=backend).q_end[0]

    w = np.sqrt(2.0)
    expected = (-np.sin(w) + 0.5 * np.cos(w) / w - 0.5 * np.sin(w) / w**2) / (2 * w)
    assert np.isclose(derivative(end)(2.0), expected, atol=1e-7)


def test_a_step_of_one_length_has_its_own_bound():
    with pytest.raises(ValueError, match="`max_step`"):
        jj.simulate(FREE, START, ts=[3.0], max_step=0.1, solver=jj.ImplicitMidpoint(step=0.1))
