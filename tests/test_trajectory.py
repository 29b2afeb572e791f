"""Trajectories: named access, summaries that say what can be trusted, files that come back as they were."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jourdain_jax as jj
from jourdain_jax.models import ChaplyginSleigh, TiltingDisc
from jourdain_jax.motion.trajectories import over_times


@pytest.fixture(scope="module")
def rolling():
    return jj.simulate(TiltingDisc(), t1=1.0, ts=jnp.linspace(0.0, 1.0, 11))


def test_named_access_reaches_coordinates_speeds_and_time(rolling):
    np.testing.assert_array_equal(rolling["lean"], rolling.q[:, 3])
    np.testing.assert_array_equal(rolling["spin_rate"], rolling.u[:, 4])
    np.testing.assert_array_equal(rolling["t"], rolling.ts)
    with pytest.raises(KeyError, match="did you mean `lean`"):
        rolling["laen"]


def test_the_summary_prints_steps_drift_residuals_contact_and_result(rolling):
    text = str(rolling)
    for part in ("Trajectory of TiltingDisc", "reached the end", "Dopri8", "minimal", "drift", "velocity", "friction coefficient needed", "N"):
        assert part in text
    html = rolling._repr_html_()
    assert html.startswith("<table>")
    assert html.count("<tr>") == text.count("\n")
    assert "drift is not seen: one time was saved" in str(jj.simulate(rolling.scene, {"lean": 0.3}, ts=[0.1]))


def test_the_contact_force_is_the_one_newton_asks_for(rolling):
    force = rolling.contact_forces()["rim"]
    acceleration = np.stack([np.asarray(rolling.accelerations().udot)])[0]
    # S1 for the mass centre of a single body: N = m (g + zddot), with z = a cos(lean)
    lean, rate, leaning = np.asarray(rolling["lean"]), np.asarray(rolling["lean_rate"]), acceleration[:, 3]
    z_acceleration = -0.5 * (np.sin(lean) * leaning + np.cos(lean) * rate**2)
    np.testing.assert_allclose(force.normal, 9.81 + z_acceleration, rtol=1e-12)
    assert np.all(np.asarray(force.friction_needed) > 0)
    assert not np.any(np.asarray(force.pulls))


def test_a_contact_that_would_have_to_pull_is_flagged():
    # a disc thrown upright so fast in lean that its centre accelerates down by more than g
    thrown = jj.simulate(TiltingDisc(), {"lean": 0.2, "lean_rate": 9.0}, t1=0.01, events=False)
    assert np.any(np.asarray(thrown.contact_forces()["rim"].pulls))
    assert "WOULD HAVE TO PULL" in str(thrown)


def test_the_path_of_a_point_is_where_the_body_says_it_is(rolling):
    centre = np.asarray(rolling.point("disc"))
    np.testing.assert_allclose(centre[:, 2], 0.5 * np.cos(np.asarray(rolling["lean"])), atol=1e-14)
    np.testing.assert_array_equal(centre, rolling.motions()["disc"].position)
    with pytest.raises(KeyError, match=r'`disc` is a body of `TiltingDisc`.*`motion\.point\("disc"\)`.*`motion\.motions\(\)\["disc"\]`'):
        rolling["disc"]


def test_a_saved_trajectory_comes_back_as_it_was(rolling, tmp_path):
    path = tmp_path / "disc.npz"
    jj.save(rolling, path)
    loaded = jj.load_trajectory(path, TiltingDisc)
    assert jax.tree.structure(loaded) == jax.tree.structure(rolling)
    for a, b in zip(jax.tree.leaves(loaded), jax.tree.leaves(rolling), strict=True):
        np.testing.assert_array_equal(a, b)
    assert str(loaded) == str(rolling)


def test_unreadable_files_are_refused_with_the_reason(rolling, tmp_path):
    path = tmp_path / "disc.npz"
    jj.save(rolling, path)
    with pytest.raises(ValueError, match="holds a trajectory of `TiltingDisc`, expected `ChaplyginSleigh`"):
        jj.load_trajectory(path, ChaplyginSleigh)
    (tmp_path / "cut.npz").write_bytes(path.read_bytes()[:200])
    (tmp_path / "text.npz").write_text("no numbers here")
    np.savez(tmp_path / "other.npz", a=1)
    for name, sentence in (
        ("cut.npz", "no trajectory file"),
        ("text.npz", "no trajectory file"),
        ("other.npz", "no trajectory file"),
        ("none.npz", "there is no file"),
    ):
        with pytest.raises(ValueError, match=sentence):
            jj.load_trajectory(tmp_path / name, TiltingDisc)


def test_a_motion_goes_on_from_the_end_of_another():
    scene, start = TiltingDisc(), {"lean": 0.3, "spin_rate": 4.0}
    first = jj.simulate(scene, start, t1=0.7)
    second = jj.simulate(scene, first.end, ts=jnp.array([1.5]))
    whole = jj.simulate(scene, start, t1=1.5)
    assert float(second.ts[0]) == 1.5
    np.testing.assert_allclose(second.q[-1], whole.q_end, atol=2e-8)
    np.testing.assert_allclose(second.u[-1], whole.u_end, atol=2e-8)


def test_the_end_is_the_state_at_an_event():
    fallen = jj.simulate(TiltingDisc(), {"lean": 0.3}, t1=5.0)
    assert fallen.event_names[int(fallen.event)] == "fallen"
    assert float(fallen.end.t) == float(fallen.t_end) < 5.0
    np.testing.assert_allclose(fallen.end.q, fallen.q_end, atol=1e-12)


def test_a_batch_goes_on_from_its_ends():
    scene, starts = TiltingDisc(), {"lean": jnp.array([0.1, 0.2, 0.3]), "spin_rate": 4.0}
    first = jj.rollout(scene, starts, t1=0.7)
    ends = first.lanes.end
    assert ends.q.shape == first.lanes.q_end.shape
    second = jj.rollout(scene, ends, t1=1.5)
    whole = jj.rollout(scene, starts, t1=1.5)
    np.testing.assert_allclose(second.lanes.q_end, whole.lanes.q_end, atol=2e-8)


def test_states_looked_at_a_few_at_a_time_show_what_all_at_once_do(monkeypatch):
    disc = jj.models.TiltingDisc()
    motion = jj.simulate(disc, ts=np.linspace(0.0, 1.0, 21))
    whole = motion.accelerations(), motion.energies()
    monkeypatch.setattr(over_times, "MOST_ENTRIES", 8 * len(disc.coordinate_names) ** 2)  # seven at a time
    monkeypatch.setattr(over_times, "_compiled", lambda programs: over_times._mapped)
    parts = motion.accelerations(), motion.energies()
    for a, b in zip(jax.tree.leaves(whole), jax.tree.leaves(parts), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-12)
