"""A row that vanishes at a configuration is lost there, in whatever unit it is written; and the conditioning
says so beforehand.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from atlas_cases.references import linkage_angle
from atlas_cases.scenes import FourBars
from linkages import Parallelogram, SliderCrank, Windows, bennett, bricard
from numpy.testing import assert_allclose
from slopes import slope

import jourdain_jax as jj
from jourdain_jax import structure_of
from jourdain_jax.equations import position_residual

SINGULAR = {
    "parallelogram": (Parallelogram, {"a": np.pi / 2, "b": 0.0, "c": np.pi / 2}, {"a": 1.0, "c": 1.0}),
    "slider-crank": (SliderCrank, {"a": np.pi / 2, "b": -np.pi / 2, "x": 0.0}, {"a": 1.0, "b": -1.0}),
}
UNITS = (1.0, 1e6, 1e-6)


def _near(name, distance, unit=1.0):
    """Accelerations at a distance from the singular configuration, along the linkage's motion."""
    make, at, towards = SINGULAR[name]
    scene = make(unit=unit)
    at = {key: value - distance * towards.get(key, 0.0) for key, value in at.items()}
    if name == "slider-crank":
        at["x"] = 2.0 * np.cos(at["a"])
    q, u, _ = scene.named(**at)
    return scene, q, jj.accelerations(scene, 0.0, q, u)


@pytest.mark.parametrize("unit", UNITS)
@pytest.mark.parametrize("name", SINGULAR)
def test_rank_is_lost_where_a_row_is_round_off(name, unit):
    scene, _, found = _near(name, 0.0, unit)
    assert (structure_of(scene).rank, int(found.rank)) == (2, 1)
    assert found.smallest_singular_value < 1e-12


@pytest.mark.parametrize("name", SINGULAR)
def test_the_conditioning_does_not_depend_on_the_unit_of_a_row_and_names_the_configuration(name):
    values = [float(_near(name, 0.2, unit)[2].smallest_singular_value) for unit in UNITS]
    assert_allclose(values, values[0], rtol=1e-6)
    choices = [structure_of(SINGULAR[name][0](unit=unit)) for unit in UNITS]
    assert len({(found.independent, found.ranks, found.rank_losses) for found in choices}) == 1
    assert choices[0].rank_losses
    assert all("1.571" in loss for loss in choices[0].rank_losses)


def test_the_report_warns_where_a_start_has_another_rank():
    scene = Parallelogram()
    singular, regular = (jj.report(scene, start={"a": a, "b": 0.0, "c": a}) for a in (np.pi / 2, 0.4))
    assert (singular.rank_at_start, regular.rank_at_start) == (1, 2)
    assert "WARNING" in str(singular)
    assert "WARNING" not in str(regular)


def test_verifying_at_a_loss_of_rank_raises_no_false_alarm():
    scene, q, _ = _near("parallelogram", 0.0)
    found = jj.verify(scene, jj.consistent(scene, 0.0, q, jnp.array([1.0, 0.0, 1.0])))
    assert found.passed, str(found)
    assert any("lose rank" in check.note for check in found.checks)


class HangingPlate(jj.Scene):
    """A plate that hangs from three equal parallel rods and swings without turning; turned round, the three
    rods would hold it still.
    """

    coordinates = jj.coordinates("x z turned")
    example = {"x": 0.3, "z": -0.4}

    def bodies(self, t, q):
        return {"plate": jj.RigidBody(2.0, 0.1 * jnp.ones(3), [q.x, 0.0, q.z], jj.rot_y(q.turned))}

    def loads(self, motion):
        return jj.gravity(motion, 9.81)

    def geometric_constraints(self, pose):
        hooks = {
            name: jnp.array([x, 0.0, 0.0]) for name, x in {"left": -0.4, "middle": 0.0, "right": 0.4}.items()
        }
        return {name: jj.rod(hook, pose["plate"].place(hook), 0.5) for name, hook in hooks.items()}


class PlateLevel(HangingPlate):
    """The plate, level or nearly so."""

    domain = {"x": (-0.5, 0.5), "z": (-0.5, -0.1), "turned": (-0.3, 0.3)}


def test_a_mechanism_that_moves_where_others_of_its_assemblies_are_stiff_is_not_said_to_lose_digits():
    stiff, level = (jj.report(scene) for scene in (HangingPlate(), PlateLevel()))
    assert (stiff.degrees_of_freedom, stiff.rank_at_start) == (0, 2)
    assert "WARNING: rank 2, not 3" in " ".join(str(stiff).split())
    assert (level.degrees_of_freedom, level.rank_at_start) == (1, None)
    motions = [jj.simulate(scene, t1=1.0, rtol=1e-10, atol=1e-10) for scene in (HangingPlate(), PlateLevel())]
    assert motions[1].warnings == ()
    (warning,) = motions[0].warnings
    assert "constraints have rank 2 on the whole motion, but 3 at generic states" in warning
    assert_allclose(motions[0].q_end, motions[1].q_end, atol=1e-8)


LINKAGES = {
    "Bennett": (bennett(0.7, 1.2), 3),
    "another Bennett": (bennett(1.1, 0.4, 0.8), 3),
    "Bricard": (bricard(1.0, 1.2, 0.8, 0.9, 1.1), 5),
    "another Bricard": (bricard(1.0, 0.9, 1.1, 1.0, 0.8), 5),
    "parallelogram": (Parallelogram(), 2),
    "slider-crank": (SliderCrank(), 2),
    "windows": (Windows(3), 9),
}


@pytest.mark.parametrize("name", LINKAGES)
def test_a_linkage_of_one_freedom_a_loop_has_its_rank_and_freedoms(name):
    scene, rank = LINKAGES[name]
    found = structure_of(scene)
    assert found.rank == rank
    assert found.degrees_of_freedom == len(scene.coordinate_names) - rank


def assert_on_rows_and_in_domain(scene, times, q):
    closures = [position_residual(scene, *state) for state in zip(times[:8], q[:8], strict=True)]
    assert np.max(np.abs(closures)) < 1e-11
    low, high = np.array([scene.domain.get(name, (-3.2, 3.2)) for name in scene.coordinate_names.entries]).T
    assert np.max(np.maximum(low - q, q - high) / (high - low)) <= 0.1


@pytest.mark.parametrize("name", LINKAGES)
def test_probed_configurations_are_on_the_rows_and_in_the_domain(name):
    scene, _ = LINKAGES[name]
    found = structure_of(scene)
    assert found.random >= 4
    assert_on_rows_and_in_domain(scene, found.times, found.coordinates)


def _swinging():
    """Two windows of rods with all speeds in the state, which pass two positions where one freedom becomes
    three.
    """
    return jj.build(FourBars(), jj.Formulation(state="full"))


def _start(rate):
    upright = {f"x{i}": float(i) for i in range(3)} | {f"z{i}": 1.0 for i in range(3)}
    return {name: jnp.broadcast_to(value, jnp.shape(rate)) for name, value in upright.items()} | {
        f"x{i}_rate": rate for i in range(3)
    }


def test_losses_of_rank_are_passed_at_a_tight_tolerance():
    """Saved times lie at all distances from them; `3 a'' = 3.5 g sin a` for the angle of the cranks from
    upright.
    """
    ts, rates = np.linspace(0.0, 2.0, 101), jnp.append(jnp.linspace(0.6, 1.9, 15), 1.0)
    found = jj.rollout(_swinging(), _start(rates), ts=ts, rtol=1e-12, atol=1e-12)
    assert np.all(found.result == 0)
    assert_allclose(found["x0"][-1], np.sin(linkage_angle(ts)), atol=1.03e-10)


def test_derivatives_past_losses_of_rank_are_differences():
    def end(rate):
        return jj.simulate(_swinging(), _start(rate), ts=[0.0, 2.0], rtol=1e-12, atol=1e-12).q_end[0]

    assert_allclose(jax.jit(jax.grad(end))(1.0), slope(end, 1.0), rtol=1e-8)
