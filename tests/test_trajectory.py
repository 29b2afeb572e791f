"""Trajectories: named access, summaries that say what can be trusted, files that come back as they were."""

import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import jourdain_jax as jj
from jourdain_jax.models import TiltingDisc


@pytest.fixture(scope="module")
def rolling():
    return jj.simulate(TiltingDisc(), t1=1.0, ts=jnp.linspace(0.0, 1.0, 11))


def test_named_access_reaches_coordinates_speeds_and_time(rolling):
    assert_array_equal(rolling["lean"], rolling.q[:, 3])
    assert_array_equal(rolling["spin_rate"], rolling.u[:, 4])
    assert_array_equal(rolling["t"], rolling.ts)
    with pytest.raises(KeyError, match="did you mean `lean`"):
        rolling["laen"]


def test_the_summary_prints_steps_drift_residuals_contact_and_result(rolling):
    text = str(rolling)
    for part in ("Trajectory of TiltingDisc", "reached the end", "Dopri8", "minimal", "drift", "velocity", "friction coefficient needed", "N"):
        assert part in text
    assert rolling._repr_html_().startswith(f"<pre>{text[:60]}")
    assert "drift is not seen: one time was saved" in str(jj.simulate(rolling.scene, {"lean": 0.3}, ts=[0.1]))


def test_the_path_of_a_point_is_where_the_body_says_it_is(rolling):
    centre = np.asarray(rolling.point("disc"))
    assert_allclose(centre[:, 2], 0.5 * np.cos(np.asarray(rolling["lean"])), atol=1e-14)
    assert_array_equal(centre, rolling.motions()["disc"].position)
    with pytest.raises(KeyError, match=r'`disc` is a body of `TiltingDisc`.*`motion\.point\("disc"\)`.*`motion\.motions\(\)\["disc"\]`'):
        rolling["disc"]


def test_a_motion_goes_on_from_the_end_of_another():
    scene, start = TiltingDisc(), {"lean": 0.3, "spin_rate": 4.0}
    first = jj.simulate(scene, start, t1=0.7)
    second = jj.simulate(scene, first.end, ts=jnp.array([1.5]))
    whole = jj.simulate(scene, start, t1=1.5)
    assert float(second.ts[0]) == 1.5
    assert_allclose(second.q[-1], whole.q_end, atol=2e-8)
    assert_allclose(second.u[-1], whole.u_end, atol=2e-8)


def test_the_end_is_the_state_at_an_event():
    fallen = jj.simulate(TiltingDisc(), {"lean": 0.3}, t1=5.0)
    assert fallen.event_names[int(fallen.event)] == "fallen"
    assert float(fallen.end.t) == float(fallen.t_end) < 5.0
    assert_allclose(fallen.end.q, fallen.q_end, atol=1e-12)


def test_a_batch_goes_on_from_its_ends():
    scene, starts = TiltingDisc(), {"lean": jnp.array([0.1, 0.2, 0.3]), "spin_rate": 4.0}
    first = jj.rollout(scene, starts, t1=0.7)
    ends = first.lanes.end
    assert ends.q.shape == first.lanes.q_end.shape
    second = jj.rollout(scene, ends, t1=1.5)
    whole = jj.rollout(scene, starts, t1=1.5)
    assert_allclose(second.lanes.q_end, whole.lanes.q_end, atol=2e-8)
