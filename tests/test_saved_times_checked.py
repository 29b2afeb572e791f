"""Times to save at that no motion can serve are refused where they are known, and end in a result code of
their own, lane by lane, where they are traced.
"""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import result_codes as results
from numpy.testing import assert_allclose, assert_array_equal
from refusals import refused
from small_scenes import Oscillator

import jourdain_jax as jj

SPRING, START = Oscillator(mass=1.0, damping=0.0, stiffness=4.0), {"x": 1.0}  # x = cos 2t
WRONG = {
    "before the start": {"ts": [-0.5, 0.5, 1.0]},
    "before a later start": {"ts": [0.5, 0.7, 1.0], "t0": 0.8},
    "backwards": {"ts": [1.0, 0.7, 0.5]},
    "beyond the end": {"ts": [0.0, 0.5, 0.7], "t1": 0.6},
    "against reversed time": {"ts": [0.2, 0.3, 0.4], "t0": 1.0, "t1": 0.0},
    "an empty span": {"ts": [0.5, 0.6, 0.7], "t0": 0.7},
}
SHUFFLED = {
    "out of order": {"ts": [0.0, 0.7, 0.5]},
    "twice": {"ts": [0.0, 0.5, 0.5]},
    "no number": {"ts": [0.0, np.nan, 0.5]},
}
RIGHT = {
    "plain": {"ts": [0.0, 0.5, 1.0]},
    "reversed": {"ts": [1.0, 0.5, 0.1], "t0": 1.2},
    "inside": {"ts": [0.3, 0.5, 0.6], "t0": 0.1, "t1": 0.8},
}


@pytest.mark.parametrize("times", [*WRONG.values(), *SHUFFLED.values()], ids=[*WRONG, *SHUFFLED])
def test_known_times_are_refused_alike_alone_in_lanes_and_inside_jit(times):
    sentences = {
        refused(r"`ts` (runs from|must be finite and strictly)|the span from", run, start)
        for run, start in (
            (lambda x: jj.simulate(SPRING, {"x": x}, **times), 1.0),
            (lambda x: jj.rollout(SPRING, {"x": x}, **times), np.array([1.0, 2.0])),
            (jax.jit(lambda x: jj.simulate(SPRING, {"x": x}, **times).q), 1.0),
        )
    }
    assert len(sentences) == 1


@pytest.mark.parametrize("solver", [None, diffrax.Kvaerno5()], ids=["lean", "diffrax"])
def test_traced_times_that_do_not_go_together_end_in_a_code_of_their_own_and_no_state(solver):
    every = [{"t0": 0.0, "t1": times["ts"][-1]} | times for times in (WRONG | SHUFFLED | RIGHT).values()]
    stacked = {name: jnp.array([times[name] for times in every]) for name in ("ts", "t0", "t1")}
    options = {"rtol": 1e-7, "atol": 1e-7, "solver": solver, "work": False}
    lanes = jax.jit(jax.vmap(lambda times: jj.simulate(SPRING, START, **options, **times)))(stacked)
    wrong = len(WRONG) + len(SHUFFLED)
    assert lanes.result.tolist() == [results.BAD_TIMES] * wrong + [results.SUCCESS] * len(RIGHT)
    assert np.isnan(lanes.q[:wrong]).all()
    assert np.isnan(lanes.u[:wrong]).all()
    assert_array_equal(lanes.ts, stacked["ts"])
    right = np.cos(2.0 * (stacked["ts"] - stacked["t0"][:, None]))
    assert_allclose(lanes.q[wrong:, :, 0], right[wrong:], atol=1e-5)
    assert_allclose(lanes.t_end[wrong:], stacked["t1"][wrong:], rtol=1e-14)


def test_even_times_of_any_span_go_together():
    generator = np.random.default_rng(0)
    ends = generator.normal(size=(200, 2)) * 10.0 ** generator.uniform(-3, 9, size=(200, 1))

    @jax.jit
    @jax.vmap
    def code(t0, t1):
        options = {"t0": t0, "t1": t1, "rtol": 1e-5, "atol": 1e-5, "max_steps": 1000}
        return jj.simulate(SPRING.replace(stiffness=0.0), START, **options).result

    assert not np.any(code(*ends.T) == results.BAD_TIMES)
