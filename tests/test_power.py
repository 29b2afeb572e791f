"""Power: the rate of T + V is the power of what has no potential, by every way energy can enter a scene."""

import jax.numpy as jnp
import pytest
import small_scenes as small
from numpy.testing import assert_allclose
from timed_scenes import TIMED
from tolerances import CLOSED_FORM, ROUND_OFF, relative_error

import jourdain_jax as jj
from jourdain_jax.dynamics.reactions import power
from jourdain_jax.models import IsokineticParticle, TiltingDisc


def test_the_wire_does_the_work_that_turns_the_bead():
    # torque about the axis is d(m r^2 w)/dt = 2 m r rdot w, its power 2 m r rdot w^2
    scene = small.BeadOnTurningWire(mass=0.6, rate=1.7)
    t, q, u = jnp.asarray(0.4), jnp.array([0.5]), jnp.array([0.8])
    found = power(scene, jj.motion_at(scene, t, q, u), jj.accelerations(scene, t, q, u))
    assert_allclose(found.driven, 2 * 0.6 * 0.5 * 0.8 * 1.7**2, rtol=ROUND_OFF)
    assert found.loads == 0.0


def test_prescribed_coordinates_and_moving_springs_each_do_work_of_their_own():
    scene = small.DrivenPendulum()
    t, q, u = (jnp.asarray(x[0]) for x in jj.sample_states(scene, 1))
    found = power(scene, jj.motion_at(scene, t, q, u), jj.accelerations(scene, t, q, u))
    assert all(jnp.abs(part) > 1e-3 for part in (found.loads, found.rows, found.potential))


@pytest.mark.parametrize(
    ("scene", "changed_by"),
    [
        (TiltingDisc(), ()),
        (small.BeadOnTurningWire(), ("poses driven as functions of time",)),
        (IsokineticParticle(), ("constraints that do real work",)),
        (
            small.DrivenPendulum(),
            ("loads without a potential", "constraints that do real work", "potentials that depend on time"),
        ),
        (TIMED[4][0], ("masses or inertias that change",)),
    ],
    ids=small.name_of,
)
def test_what_changes_the_energy_of_a_scene_is_named(scene, changed_by):
    balance = jj.analysis.energy_balance(scene)
    assert balance.changed_by == changed_by
    assert balance.conserved == (not changed_by)


def test_energy_is_kinetic_and_potential():
    scene = TiltingDisc(mass=2.0, radius=0.5)
    q, u, _ = scene.named(lean=0.4, lean_rate=1.5)
    found = jj.energy(scene, 0.0, q, u)
    # a tilt about the rim: A + m a^2 with A = m a^2/4; height a cos(lean)
    assert_allclose(found.kinetic, 0.5 * 1.25 * 2.0 * 0.5**2 * 1.5**2, rtol=ROUND_OFF)
    assert_allclose(found.potential, 2.0 * 9.81 * 0.5 * jnp.cos(0.4), rtol=ROUND_OFF)
    assert found.total == found.kinetic + found.potential


def assert_balanced(motion):
    balance, size = motion.energies().balance, jnp.max(jnp.abs(motion.work))
    assert jnp.ptp(balance) <= CLOSED_FORM * size


@pytest.mark.parametrize("case", TIMED, ids=lambda case: type(case[0]).__name__)
def test_the_work_that_time_does_is_integrated_and_is_that_of_the_closed_form(case):
    scene, timed, driven = case
    structure = jj.structure_of(scene)
    assert (structure.timed, structure.driven) == (timed, driven)
    assert structure.rheonomic == bool(timed)
    ts = jnp.linspace(0.0, 1.5, 6)
    inputs = {"speed": 0.6} if scene.inputs.entries else None
    motion = jj.simulate(scene, ts=ts, rtol=1e-12, atol=1e-12, inputs=inputs).raise_if_failed()
    assert motion.energies().kind == "T + V less the work done"
    assert relative_error(motion.work, scene.work(ts)) <= CLOSED_FORM
    assert_balanced(motion)


class PulledBead(small.BeadOnTurningWire):
    """The bead in a potential of its place, its coordinate and time, which the scene states as a whole."""

    def potential(self, pose):
        x, y, _ = pose["bead"].position
        return 3.0 * x**2 + 2.0 * y + jnp.sin(pose.q.r) * pose.t


@pytest.mark.parametrize("backend", ["auto", "dense"])
def test_the_work_along_driven_poses_is_part_of_the_scalar_program(backend):
    motion = jj.simulate(PulledBead(), {"r": 0.5}, t1=1.5, rtol=1e-11, atol=1e-11, backend=backend)
    assert ("lowered" in motion.reduction) == (backend == "auto")
    assert_balanced(motion)


def test_work_that_is_left_out_is_no_fault():
    driven = jj.simulate(small.BeadOnTurningWire(), {"r": 0.5}, t1=1.0, work=False)
    assert jj.diagnose(driven).energy_drift > 0.1
    assert driven.warnings == ()
    assert "T + V, changed by work that was not integrated" in str(driven)
