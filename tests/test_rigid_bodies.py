"""A free rigid body by Jacobi's elliptic functions, and Suslov's problem by hyperbolic ones."""

import jax.numpy as jnp
import numpy as np
import pytest
from oracles import free_rigid_body, suslov
from tolerances import CLOSED_FORM, ROUND_OFF, relative_error

import jourdain_jax as jj
from jourdain_jax.models import FreeRigidBody, Suslov

RUN = free_rigid_body.RUN
MOMENTS = dict(zip(("i1", "i2", "i3"), RUN["inertia"], strict=True))
TOP, HELD = FreeRigidBody(**MOMENTS), Suslov()


def turned(start, end, count, scene=TOP):
    return jj.simulate(scene, start, ts=jnp.linspace(0.0, end, count), rtol=1e-12, atol=1e-12)


@pytest.fixture(scope="module")
def free():
    """20 s, turning and flying off."""
    flying = {"x": 1.0, "x_rate": 0.3, "y_rate": -0.1, "z_rate": 0.2}
    return turned(flying | {"attitude_omega": jnp.asarray(RUN["w0"])}, RUN["t_end"], 21)


def test_a_free_body_turns_by_elliptic_functions(free):
    expected = free_rigid_body.motion(free.ts, **RUN)
    assert relative_error(free["attitude_omega"], expected) <= CLOSED_FORM
    attitudes = free["attitude"], free_rigid_body.attitude(np.asarray(free.ts), **RUN)
    assert relative_error(*map(free_rigid_body.rotation, attitudes)) <= CLOSED_FORM


def test_its_mass_centre_flies_straight(free):
    along = np.asarray(free.ts)[:, None] * [0.3, -0.1, 0.2] + [1.0, 0.0, 0.0]
    assert relative_error(np.stack([free["x"], free["y"], free["z"]], 1), along) <= CLOSED_FORM


def test_momentum_and_angular_momentum_and_energy_are_conserved(free):
    energy = free.energies().balance
    assert relative_error(energy, jnp.full_like(energy, energy[0])) <= CLOSED_FORM
    for k in (5, 20):
        first, later = (TOP.invariants(jj.motion_at(TOP, free.ts[i], free.q[i], free.u[i])) for i in (0, k))
        size = np.linalg.norm(np.array(RUN["w0"]) * RUN["inertia"])
        for name, value in first.items():
            assert abs(later[name] - value) <= CLOSED_FORM * size, name


def test_suslov_motion_ends_in_a_turn_about_the_second_axis():
    motion = turned(None, suslov.RUN["t_end"], 11, HELD)
    times = np.asarray(motion.ts)
    expected = suslov.motion(times, **suslov.RUN)
    for name, right in (("x", expected["w1"]), ("y", expected["w2"]), ("z", 0 * times)):
        assert relative_error(motion[f"attitude_omega_{name}"], right, 1.0) <= CLOSED_FORM, name
    attitude = suslov.attitude(times, **suslov.RUN)
    assert relative_error(motion["attitude"], attitude) <= CLOSED_FORM


def test_suslov_multiplier_is_the_torque_about_the_third_axis():
    q, u, _ = HELD.named(attitude_omega_x=suslov.RUN["w1"], attitude_omega_y=suslov.RUN["w2"])
    found = jj.accelerations(HELD, 0.0, q, u).multipliers[0]
    expected = suslov.motion(np.zeros(1), **suslov.RUN)["torque"][0]
    assert abs(found - expected) <= ROUND_OFF


def test_a_body_held_along_a_principal_axis_turns_steadily():
    principal = HELD.replace(i13=0.0)
    q, u, _ = principal.named(attitude_omega_x=0.6, attitude_omega_y=0.8)
    assert jnp.max(jnp.abs(jj.accelerations(principal, 0.0, q, u).udot)) <= ROUND_OFF
