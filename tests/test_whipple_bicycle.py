"""The nonlinear Whipple bicycle against the published linear one, statics, geometry and symmetry."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from agreement import admissible_states
from oracles import whipple_bicycle as oracle
from refusals import refused
from tolerances import DRIFT, LINEARIZATION, ROUND_OFF, relative_error

import jourdain_jax as jj
from jourdain_jax.bicycle import linear_matrices
from jourdain_jax.dynamics.reactions import contact_forces
from jourdain_jax.equations import position_residual, velocity_residual
from jourdain_jax.equations.gibbs_appell import minimal_kinematics
from jourdain_jax.equations.projection import project_positions
from jourdain_jax.models import WhippleBicycle

BICYCLE = WhippleBicycle()
NAMES = WhippleBicycle.coordinates.names.entries
LEAN, STEER = NAMES.index("lean"), NAMES.index("steer")


def state(bicycle, lean, steer, lean_rate, steer_rate, speed):
    """The admissible state with the front wheel rolling at `speed`; the front contact gives the pitch."""
    q = project_positions(
        bicycle, 0.0, bicycle.named(lean=lean, steer=steer)[0], free=jnp.array([n == "pitch" for n in NAMES])
    )
    y = jnp.stack([lean_rate, steer_rate, speed / bicycle.rF])
    structure = jj.structure_of(BICYCLE)
    return q, minimal_kinematics(bicycle, structure.independent, structure.kept_rows, 0.0, q, y).u


def other_bicycle():
    """Parameters 5 to 20 % from the benchmark's, so that nothing cancels by chance."""
    factors = 1 + np.random.default_rng(7).uniform(0.05, 0.2, len(oracle.BENCHMARK))
    return {
        name: value * factor for (name, value), factor in zip(oracle.BENCHMARK.items(), factors, strict=True)
    }


def test_defaults_are_the_benchmark_bicycle():
    for name, value in oracle.BENCHMARK.items():
        assert getattr(BICYCLE, name) == value


@pytest.mark.parametrize("speed", [0.0, 4.6, 10.0])
def test_running_straight_and_upright_is_an_exact_steady_motion(speed):
    q, u, _ = BICYCLE.named(**BICYCLE.upright(speed))
    assert jnp.max(jnp.abs(position_residual(BICYCLE, 0.0, q))) <= 1e-13
    assert jnp.max(jnp.abs(velocity_residual(BICYCLE, 0.0, q, u))) <= 1e-13
    assert jnp.max(jnp.abs(jj.accelerations(BICYCLE, 0.0, q, u).udot)) <= 1e-13


def test_any_other_bicycle_obeys_them_too():
    values = other_bicycle()
    for name, matrix in zip(("M", "C1", "K0", "K2"), linear_matrices(values), strict=False):
        assert relative_error(matrix, oracle.matrices(values)[name]) <= LINEARIZATION, name


def test_wheels_carry_the_published_loads_at_rest():
    q, u, _ = BICYCLE.named()
    forces = contact_forces(BICYCLE, 0.0, q, u, jj.accelerations(BICYCLE, 0.0, q, u))
    for wheel, load in oracle.WHEEL_LOADS.items():
        assert abs(forces[wheel].normal - load) <= LINEARIZATION


def test_the_front_contact_is_the_lowest_point_of_the_wheel_at_any_lean_and_steer():
    _, configurations, _ = jj.sample_states(BICYCLE, 30)
    assert np.max(np.abs(configurations[:, LEAN])) > 0.6
    assert np.max(np.abs(configurations[:, STEER])) > 0.8
    angle = np.linspace(0, 2 * np.pi, 20001)
    rim = float(BICYCLE.rF) * np.stack([np.cos(angle), 0 * angle, np.sin(angle)], axis=1)
    for q in configurations:
        wheel = jj.pose_at(BICYCLE, jnp.zeros(()), jnp.asarray(q))["front wheel"]
        heights = np.asarray(wheel.position)[2] + rim @ np.asarray(wheel.orientation)[2]
        # between two points of the rim, 3e-4 rad apart, the circle sags by less than 1e-8 of its radius
        assert -ROUND_OFF <= heights.min() <= 1e-8


def test_rear_wheel_and_front_wheel_roll_without_slip():
    for t, q, u in admissible_states(BICYCLE, 10):
        motion = jj.motion_at(BICYCLE, t, q, u)
        for name, radius in (("rear wheel", BICYCLE.rR), ("front wheel", BICYCLE.rF)):
            wheel = motion[name]
            heading = jnp.cross(wheel.orientation[:, 1], jnp.array([0.0, 0.0, 1.0]))
            down = jnp.cross(heading / jnp.linalg.norm(heading), wheel.orientation[:, 1])
            slip = wheel.velocity_at(wheel.position - jnp.sign(down[2]) * radius * down)
            assert jnp.max(jnp.abs(slip)) <= ROUND_OFF, name


def test_a_mirrored_bicycle_moves_as_the_mirror_image():
    mirror = np.array([-1.0 if name in ("y", "yaw", "lean", "steer") else 1.0 for name in NAMES])

    @eqx.filter_jit
    def udot(q, u, torques):
        return jj.accelerations(BICYCLE, 0.0, q, u, torques).udot

    torques = jnp.array([3.0, 0.5])
    for _, q, u in admissible_states(BICYCLE, 5):
        there, mirrored = udot(q, u, torques), udot(mirror * q, mirror * u, -torques)
        assert relative_error(mirrored, mirror * there) <= ROUND_OFF


def test_a_hands_free_ride_keeps_its_energy_and_its_contacts():
    ride = jj.simulate(BICYCLE, t1=3.0, rtol=1e-10, atol=1e-10)
    ride.raise_if_failed()
    energy = ride.energies().balance
    assert relative_error(energy, jnp.full_like(energy, energy[0])) <= DRIFT
    # inside the stable range 4.29 to 6.02 m/s a kick of 0.2 rad/s dies out
    assert jnp.max(jnp.abs(ride["lean"])) < 0.1


def test_parameters_come_by_name_and_only_by_name():
    values = other_bicycle()
    bicycle = WhippleBicycle.from_values(values)
    assert {name: float(getattr(bicycle, name)) for name in values} == values
    refused(
        r"unknown bicycle parameter `lambda`; did you mean `lam`",
        WhippleBicycle.from_values,
        values | {"lambda": 0.3},
    )
    refused(
        r"missing: `lam`; give all 26",
        WhippleBicycle.from_values,
        {name: value for name, value in values.items() if name != "lam"},
    )
