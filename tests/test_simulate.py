"""Simulation: right to tolerance in every state form, honest about how it ended, differentiable in every
supported mode.
"""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import result_codes as results
from numpy.testing import assert_allclose, assert_array_equal
from small_scenes import Upright

import jourdain_jax as jj
from jourdain_jax.identification import log_likelihood
from jourdain_jax.models import ChaplyginSleigh, DoublePendulumRods, TiltingDisc


class Falling(Upright):
    """A particle thrown up from the floor, with air drag if asked: the smallest scene with an event."""

    mass: object = jj.parameter(1.0, positive=True)
    gravity: object = jj.parameter(9.81)
    drag: object = jj.parameter(0.0)

    inputs = jj.inputs("force")
    example = {"z_rate": 5.0, "x_rate": 2.0}

    def loads(self, motion):
        drag = jj.point_force(motion["mass"].point(), -self.drag * motion["mass"].velocity)
        return (
            jj.gravity(motion, self.gravity),
            drag,
            jj.generalized_force(motion, x_rate=motion.inputs.force),
        )

    def events(self, motion):
        return {"landed": motion.q.z + 0.5, "too far": 100.0 - motion.q.x}


def flight_time(speed, gravity=9.81, drop=0.5):
    return (speed + np.sqrt(speed**2 + 2 * gravity * drop)) / gravity


def test_an_event_stops_the_motion_at_the_closed_form_time():
    motion = jj.simulate(Falling(), t1=3.0, rtol=1e-10, atol=1e-10)
    assert motion.result == results.EVENT
    assert "`landed`" in motion.message
    assert_allclose(motion.t_end, flight_time(5.0), rtol=1e-12)
    assert_allclose(motion.q_end, [2 * flight_time(5.0), -0.5], rtol=1e-11)
    assert motion.end.t == float(motion.t_end)
    assert_allclose(motion.end.q, motion.q_end, atol=1e-12)
    later = motion.ts > float(motion.t_end)
    assert np.all(np.isnan(motion.q[later]))
    assert np.all(np.isfinite(motion.q[~later]))


def test_work_without_potential_is_taken_off_the_energy_and_the_result_says_so():
    motion = jj.simulate(
        Falling(drag=0.3), t1=1.0, inputs={"force": lambda t: jnp.sin(3 * t)}, rtol=1e-11, atol=1e-11
    )
    energy = motion.energies()
    assert energy.kind == "T + V less the work done"
    assert jnp.ptp(energy.kinetic + energy.potential) > 1.0
    assert jnp.ptp(energy.balance) < 1e-10


def test_a_conservative_scene_tracks_no_work():
    motion = jj.simulate(ChaplyginSleigh(), t1=1.0)
    assert motion.work is None
    assert motion.energies().kind == "T + V"


def test_minimal_and_full_state_give_the_same_motion():
    options = {"t1": 3.0, "rtol": 1e-10, "atol": 1e-10}
    minimal, full = (
        jj.simulate(ChaplyginSleigh(), formulation=jj.Formulation(form), **options)
        for form in ("minimal", "full")
    )
    assert (minimal.state_form, full.state_form) == ("minimal", "full")
    assert_allclose(minimal.q, full.q, atol=1e-8)
    assert jnp.max(jnp.abs(minimal.residuals()[1])) < 1e-14
    assert jnp.max(jnp.abs(full.residuals()[1])) < 1e-13  # by projection


def test_geometric_rows_hold_after_every_step_by_projection_and_drift_without():
    options = {"rtol": 1e-6, "atol": 1e-6, "ts": jnp.linspace(0.0, 10.0, 21)}
    kept, drifted = (
        jj.simulate(DoublePendulumRods(), formulation=jj.Formulation("full", stabilisation=by), **options)
        for by in ("projection", None)
    )
    assert jnp.max(jnp.abs(kept.residuals()[0])) < 1e-12
    assert jnp.max(jnp.abs(drifted.residuals()[0])) > 1e-8


def test_a_start_off_the_constraints_is_moved_onto_them_and_the_motion_says_how_far():
    scene = ChaplyginSleigh()
    on = jj.start(scene, **scene.example)
    motion = jj.simulate(scene, eqx.tree_at(lambda state: state.u, on, on.u + 1e-3), t1=0.5)
    assert 1e-5 < motion.moved_u < 2e-3
    assert jnp.max(jnp.abs(motion.residuals()[1])) < 1e-13


def test_too_few_steps_are_a_result_code_and_an_error_only_on_request():
    motion = jj.simulate(ChaplyginSleigh(), t1=5.0, max_steps=8)
    assert motion.result == results.MAX_STEPS
    assert np.isnan(motion.q[-1]).all()
    assert np.isfinite(motion.q_end).all()
    with pytest.raises(jj.SimulationError, match=r"`ChaplyginSleigh` at t = .* s: ran out of steps"):
        motion.raise_if_failed()


def test_reversed_time_runs_back_to_the_start():
    there = jj.simulate(ChaplyginSleigh(), t1=2.0, rtol=1e-11, atol=1e-11)
    back = jj.simulate(there.scene, there.end, t1=0.0, rtol=1e-11, atol=1e-11)
    assert_allclose(back.q_end, there.q[0], atol=1e-8)


def test_simulate_traces_once_for_different_numbers():
    end = lambda scene, start: jj.simulate(scene, start, t1=0.5).q_end
    run = eqx.filter_jit(eqx.debug.assert_max_traces(end, max_traces=1))
    for mass in (1.0, 2.0):
        scene = Falling(mass=mass)
        run(scene, jj.start(scene, z_rate=mass))


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
    parts = ("Trajectory of TiltingDisc", "reached the end", "Dopri8", "minimal", "drift", "velocity", "N")
    for part in (*parts, "friction coefficient needed"):
        assert part in text
    assert rolling._repr_html_().startswith(f"<pre>{text[:60]}")
    assert "no drift from one saved time" in str(jj.simulate(rolling.scene, {"lean": 0.3}, ts=[0.1]))


def test_the_path_of_a_point_is_where_the_body_says_it_is(rolling):
    centre = np.asarray(rolling.point("disc"))
    assert_allclose(centre[:, 2], 0.5 * np.cos(rolling["lean"]), atol=1e-14)
    assert_array_equal(centre, rolling.motions()["disc"].position)
    with pytest.raises(
        KeyError,
        match=(
            r'`disc` is a body of `TiltingDisc`.*`motion\.point\("disc"\)`.*`motion\.motions\(\)\["disc"\]`'
        ),
    ):
        rolling["disc"]


def test_a_motion_goes_on_from_the_end_of_another():
    scene, start = TiltingDisc(), {"lean": 0.3, "spin_rate": 4.0}
    first = jj.simulate(scene, start, t1=0.7)
    second = jj.simulate(scene, first.end, ts=[1.5])
    whole = jj.simulate(scene, start, t1=1.5)
    assert second.ts[0] == 1.5
    assert_allclose(second.q[-1], whole.q_end, atol=2e-8)
    assert_allclose(second.u[-1], whole.u_end, atol=2e-8)


SLEIGH, START, TS = jj.models.ChaplyginSleigh(), {"x_rate": 0.6, "heading_rate": 0.9}, np.array([0.5, 1.0])
DATA = jj.Experiment(TS, {"x": np.array([0.3, 0.5])}, 0.01, start=START)


def test_an_object_and_its_fields_by_name_ask_for_the_same_and_names_replace_fields():
    coarse = jj.Options(rtol=1e-4, atol=1e-4, max_step=np.inf)
    by_name = jj.simulate(SLEIGH, START, ts=TS, rtol=1e-4, atol=1e-4, max_step=np.inf)
    mixed = jj.simulate(
        SLEIGH, START, ts=TS, options=jj.Options(rtol=1e-4, atol=1e-9), atol=1e-4, max_step=np.inf
    )
    for motion in (jj.simulate(SLEIGH, START, ts=TS, options=coarse), mixed):
        assert_array_equal(motion.q, by_name.q)
        assert motion.accepted == int(by_name.accepted)
    lanes = jj.rollout(SLEIGH, START | {"x_rate": np.array([0.6, 0.7])}, ts=TS, options=coarse)
    assert lanes.lane(0).accepted == int(by_name.accepted)
    assert log_likelihood(SLEIGH, DATA, options=coarse) == float(
        log_likelihood(SLEIGH, DATA, rtol=1e-4, atol=1e-4, max_step=np.inf)
    )


def test_options_are_a_tree_whose_numbers_may_be_traced():
    def end(options):
        return jj.simulate(SLEIGH, START, ts=TS, options=options, solver=jj.RadauIIA()).q_end

    options = jj.Options(rtol=1e-6, atol=1e-6)
    assert_allclose(jax.jit(end)(options), end(options), rtol=0, atol=1e-12)
    assert len(jax.tree.leaves(jax.tree.map(jnp.asarray, options))) == 2


@pytest.mark.parametrize("solver", [diffrax.Bosh3(), jj.ImplicitMidpoint(step=0.01)])
def test_any_solver_lands_on_the_saved_times(solver):
    ts = jnp.array([0.11, 0.123, 0.3])
    motion = jj.simulate(Falling(), {"x_rate": 2.0}, ts=ts, solver=solver, work=False)
    assert motion.result == results.SUCCESS
    assert_allclose(motion["x"], 2.0 * ts, rtol=1e-12)


def test_an_implicit_solver_serves_a_projected_scene():
    implicit, explicit = (
        jj.simulate(DoublePendulumRods(), solver=solver, t1=0.5) for solver in (diffrax.Kvaerno5(), None)
    )
    assert implicit.result == results.SUCCESS
    assert_allclose(implicit.q_end, explicit.q_end, atol=1e-6)


class Tied(jj.Scene):
    """A bead at height z, tied to the origin by a rod and to the line y = 3: its default rod is too short to
    be assembled.
    """

    mass: float = jj.parameter(1.0, positive=True)
    length: float = jj.parameter(1.0, positive=True)
    coordinates = jj.coordinates("x y z")
    domain = {"x": (3.0, 6.0), "y": (2.0, 4.0)}

    def bodies(self, t, q):
        return {"bead": jj.Particle(self.mass, q.array)}

    def geometric_constraints(self, pose):
        return {"rod": pose.q.x**2 + pose.q.y**2 - self.length**2, "line": pose.q.y - 3.0}


def test_a_batch_is_probed_near_its_own_parameters():
    start, lengths = {"x": np.sqrt([16.0, 27.0]), "z_rate": 1.0}, {"length": np.array([5.0, 6.0])}
    lanes = jj.rollout(Tied(length=6.0), start, parameters=lengths, t1=0.5)
    assert list(lanes.result) == [results.SUCCESS, results.SUCCESS]
    assert_allclose(lanes.lanes.q_end, [[4.0, 3.0, 0.5], [np.sqrt(27.0), 3.0, 0.5]], atol=1e-9)
