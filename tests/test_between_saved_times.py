"""Between saved times too, a motion is right or flagged: pivots keep their signs, and a projection moves a
step by no more than an error.
"""

import numpy as np
import pytest
import result_codes as results
from moving_linkages import NarrowPendulum, Parallelogram

import jourdain_jax as jj

SPEEDS = np.linspace(
    5.0, 10.0, 16
)  # of the pendulum's x, m/s: some swing beyond the horizontal, some go round
END = np.array([2.0])


@pytest.mark.parametrize(
    "options",
    [
        {"solver": jj.RadauIIA(), "rtol": 1e-6, "atol": 1e-6},
        {"solver": jj.ImplicitMidpoint(step=0.01)},
        {"backend": "dense", "rtol": 1e-6, "atol": 1e-6},
    ],
    ids=["implicit", "constant steps", "dense"],
)
def test_every_way_of_integrating_watches_its_pivots(options):
    asked = jj.rollout(
        NarrowPendulum(),
        {"x": 0.3, "z": -np.sqrt(0.91), "x_rate": SPEEDS[::5]},
        ts=END,
        formulation=jj.Formulation("minimal"),
        **options,
    )
    assert np.all(asked.result == results.SINGULAR_PARTITION)


def _parallelograms(count, **options):
    w, a_0, ts = np.linspace(0.5, 8.0, count), 0.7, np.linspace(0.0, 3.0, 201)
    starts = {"a": a_0, "b": 0.0, "c": a_0, "a_rate": w, "b_rate": 0.0, "c_rate": w}
    found = jj.rollout(Parallelogram(), starts, ts=ts, **options)
    error = np.max(
        np.abs(np.asarray(found.lanes.q) - (a_0 + w[:, None] * ts)[..., None] * [1, 0, 1]), axis=(1, 2)
    )
    return found.result, error


@pytest.mark.parametrize("rtol", [1e-4, 1e-6, 1e-8])
def test_a_parallelogram_passes_flat_on_its_branch_or_is_flagged(rtol):
    result, error = _parallelograms(128, rtol=rtol, atol=rtol)
    arrived = result == results.SUCCESS
    assert np.mean(arrived) > 0.6
    assert np.all(error[arrived] < 100 * rtol)
