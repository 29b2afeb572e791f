"""Motions of models against closed forms and reference runs: rolling discs, a ball on a turntable, double
pendulums, chains.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from agreement import disagreement
from closed_form_runs import end_error
from oracles import ball_on_turntable, double_pendulum, rolling_disc, trailers, vertical_disc
from refusals import refused
from scipy.special import ellipk
from solved_states import solved_at_random_states
from tolerances import CLOSED_FORM, DRIFT, ROUND_OFF, relative_error, tolerance

import jourdain_jax as jj
from jourdain_jax.models import (
    BallOnTurntable,
    DoublePendulumAngles,
    DoublePendulumRods,
    PendulumChain,
    TiltingDisc,
    TiltingDiscQuaternion,
    TrailerChain,
    VerticalDisc,
)

# Rolling discs: upright, tilting in angles, tilting as a free body with a quaternion.


RUN = rolling_disc.RUN
SIZES = [RUN[name] for name in ("mass", "radius", "gravity")]
TILTING = TiltingDisc(*SIZES)
START = {name: RUN[name] for name in ("lean", "yaw_rate", "lean_rate", "spin_rate")}


@jax.jit
def _free_body(yaw, lean, spin, yaw_rate, lean_rate, spin_rate, radius):
    """The free disc's values by name, from those of the disc in angles; the contact is at the origin."""
    frame = jj.rot_z(yaw) @ jj.rot_x(lean)
    turned = frame @ jj.rot_y(spin)
    omega = frame @ jnp.array([lean_rate, spin_rate, 0.0]) + jnp.array([0.0, 0.0, yaw_rate])
    centre = radius * frame[:, 2]
    rates = jnp.cross(omega, centre)
    axes = jnp.eye(3)
    attitude = jnp.array([1.0, 0.0, 0.0, 0.0])
    for axis, angle in ((axes[1], spin), (axes[0], lean), (axes[2], yaw)):
        attitude = _product(jj.quaternion_from_axis_angle(axis, angle), attitude)
    return {
        **dict(zip("xyz", centre, strict=True)),
        **dict(zip(("x_rate", "y_rate", "z_rate"), rates, strict=True)),
        "attitude": attitude,
        "attitude_omega": turned.T @ omega,
    }


def _product(p, q):
    """Hamilton's product, by its matrix."""
    w, x, y, z = p
    return jnp.array([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]]) @ q


# Upright. ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("turn", [vertical_disc.RUN["phi_rate"], 0.0], ids=["circle", "straight"])
def test_the_upright_disc_rolls_in_a_circle_or_straight(turn):
    run = vertical_disc.RUN | {"phi_rate": turn, "phi0": 0.3, "t_end": 3.0}
    start = {"heading": 0.3, "heading_rate": turn, "roll_rate": run["th_rate"]}
    assert end_error(VerticalDisc(), start, vertical_disc.motion, run, "x y", roll="th") <= CLOSED_FORM


# Tilting. ---------------------------------------------------------------------------------------------------


def test_the_tilting_disc_obeys_eulers_equations_at_random_states():
    scene = TiltingDisc(mass=1.3, radius=0.4)
    q, u, udot, _ = solved_at_random_states(scene)
    # theta = lean + pi/2; w1 = thetadot, w2 = psidot sin(theta), w3 = phidot + psidot cos(theta), phi = -spin
    sine, cosine = np.cos(q.lean), -np.sin(q.lean)
    w1, w2, w3 = u.lean_rate, u.yaw_rate * sine, -u.spin_rate + u.yaw_rate * cosine
    w1_rate, w2_rate = udot.lean_rate, udot.yaw_rate * sine + u.yaw_rate * cosine * w1
    w3_rate = -udot.spin_rate + udot.yaw_rate * cosine - u.yaw_rate * sine * w1
    ring = 1.3 * 0.4**2
    A, C, cot = ring / 4, ring / 2, cosine / sine
    assert (
        relative_error(
            (A + ring) * w1_rate, A * w2**2 * cot - (C + ring) * w2 * w3 - 1.3 * 9.81 * 0.4 * cosine
        )
        <= ROUND_OFF
    )
    assert relative_error(A * w2_rate, w1 * (C * w3 - A * w2 * cot)) <= ROUND_OFF
    assert relative_error((C + ring) * w3_rate, ring * w1 * w2) <= ROUND_OFF


def test_the_tilting_disc_wobbles_along_its_reference_path():
    assert (
        end_error(TILTING, START, rolling_disc.motion_yaw_lean_spin, RUN, "x y yaw lean spin") <= CLOSED_FORM
    )


def test_the_free_disc_wobbles_along_the_same_path():
    scene = TiltingDiscQuaternion(*SIZES)
    start = _free_body(
        0.0, RUN["lean"], 0.0, RUN["yaw_rate"], RUN["lean_rate"], RUN["spin_rate"], RUN["radius"]
    )
    assert (
        end_error(scene, start, rolling_disc.motion_yaw_lean_spin, RUN, x="cx", y="cy", z="cz") <= CLOSED_FORM
    )


def _legendre_constants(trajectory):
    lean, yaw_rate, spin_rate = (np.asarray(trajectory[name]) for name in ("lean", "yaw_rate", "spin_rate"))
    w2, w3 = yaw_rate * np.cos(lean), -spin_rate - yaw_rate * np.sin(lean)
    return rolling_disc.legendre_constants(lean + np.pi / 2, w2, w3, mass=RUN["mass"], radius=RUN["radius"])


def test_the_disc_keeps_its_legendre_integrals_and_its_energy_for_100_s():
    times = jnp.linspace(0.0, 100.0, 41)
    trajectory = jj.simulate(TILTING, START, ts=times, rtol=1e-12, atol=1e-12).raise_if_failed()
    for constant in (*_legendre_constants(trajectory), np.asarray(trajectory.energies().balance)):
        assert np.ptp(constant) <= DRIFT * np.max(np.abs(constant))


# A ball that rolls on a turning plane, flat or tilted.


def test_the_centre_moves_like_a_charge_in_a_magnetic_field():
    kappa, tilt = 2 / 3, -0.3  # a hollow ball
    scene = BallOnTurntable(radius=0.08, inertia_ratio=kappa, turn_rate=1.5, tilt=tilt)
    _, u, udot, _ = solved_at_random_states(scene)
    # R'' = n z x R' + g sin(tilt) x / (1 + kappa)
    n, push = 1.5 * kappa / (1 + kappa), 9.81 * np.sin(tilt) / (1 + kappa)
    expected = np.stack([push - n * u.y_rate, n * u.x_rate], axis=1)
    assert relative_error(udot.array[:, :2], expected) <= ROUND_OFF
    assert np.max(np.abs(udot.spin)) <= ROUND_OFF * np.max(np.abs(udot.array))


RATES = {"x_rate": "vx", "y_rate": "vy", "roll_x": "wx", "roll_y": "wy", "spin": "wz"}


@pytest.mark.parametrize("run", [ball_on_turntable.RUN_FLAT, ball_on_turntable.RUN], ids=["flat", "tilted"])
def test_the_ball_follows_its_closed_form(run):
    scene = BallOnTurntable(
        **{name: run[name] for name in ("radius", "inertia_ratio", "turn_rate", "tilt", "gravity")}
    )
    start = {"x": run["x0"], "y": run["y0"], "x_rate": run["vx0"], "y_rate": run["vy0"], "spin": run["wz"]}
    assert end_error(scene, start, ball_on_turntable.motion, run, "x y", **RATES) <= CLOSED_FORM


# The double pendulum with rods, in angles and as a chain of two: three descriptions of one motion.


ANGLES, RODS = DoublePendulumAngles(), DoublePendulumRods()
CHAIN = PendulumChain(links=2, mass=np.array([1.0, 0.7]), length=np.array([1.0, 0.8]))
TIMES = np.linspace(0.0, double_pendulum.RUN["t_end"], 6)
EXPECTED = double_pendulum.motion(TIMES, **double_pendulum.RUN)
# names of the scene -> of the reference
CARTESIAN = {
    f"{axis}{k}{rate}": f"{speed}{other}{k}"
    for k in (1, 2)
    for axis, other in ("xx", "zy")
    for rate, speed in (("", ""), ("_rate", "v"))
}
HANGING = {name: EXPECTED[key][0] for name, key in CARTESIAN.items()}
SIZE = 1.8  # m, the reach


def test_in_angles_it_follows_the_reference():
    motion = jj.simulate(ANGLES, ts=jnp.asarray(TIMES), rtol=1e-12, atol=1e-12)
    for name in ("theta1", "theta2", "theta1_rate", "theta2_rate"):
        key = name.replace("eta", "")
        assert relative_error(motion[name], EXPECTED[key]) <= CLOSED_FORM, name


@pytest.mark.parametrize("scene", [RODS, CHAIN], ids=lambda s: type(s).__name__)
def test_on_rods_it_follows_the_same_reference(scene):
    motion = jj.simulate(scene, HANGING, ts=jnp.asarray(TIMES), rtol=1e-12, atol=1e-12)
    # no choice of two Cartesian velocities stays independent while the rods turn round
    assert motion.state_form == "full"
    for name, key in CARTESIAN.items():
        assert relative_error(motion[name], EXPECTED[key], SIZE) <= CLOSED_FORM, name
    energy = motion.energies().balance
    assert relative_error(energy, EXPECTED["energy"]) <= CLOSED_FORM


def test_multipliers_are_the_thrusts_in_the_rods():
    names = jj.structure_of(RODS).row_names
    q, u, _ = RODS.named(**HANGING)
    found = dict(zip(names, jj.accelerations(RODS, 0.0, q, u).multipliers, strict=True))
    for row, key in (("upper rod", "tension1"), ("lower rod", "tension2")):
        assert abs(found[row] + EXPECTED[key][0]) <= ROUND_OFF * EXPECTED["tension1"][0]


# Chains of any number of bodies: trailers behind a car, particles on rods.


LENGTH, SPEED, TURN = trailers.RUN["length"], trailers.RUN["v"], trailers.RUN["w"]
WEIGHTLESS = {"trailer_mass": 0.0, "trailer_inertia": 0.0}  # then the car's speed is constant too


def simulate(scene, start, times):
    return jj.simulate(scene, start, ts=jnp.asarray(times), rtol=1e-12, atol=1e-12)


def test_reductions_that_need_a_mass_for_every_coordinate_say_so_for_weightless_trailers():
    apart = disagreement(TrailerChain(trailers=2, **WEIGHTLESS))
    assert set(apart) == {"privileged", "svd", "kkt", "gibbs-appell"}
    assert max(apart.values()) <= ROUND_OFF, apart


def test_on_a_circle_each_trailer_runs_inside_the_one_ahead():
    lengths = [0.7, 0.5, 0.6]
    scene = TrailerChain(trailers=3, length=jnp.array(lengths), **WEIGHTLESS)
    times = np.linspace(0.0, 30.0, 4)
    motion = simulate(scene, scene.towing([0.0, 0.0, 0.0, 0.0], forward=SPEED, turn=TURN), times)
    expected = trailers.chain(
        times, lengths=lengths, speed=lambda t: SPEED, yaw_rate=lambda t: TURN, headings0=[0.0, 0.0, 0.0, 0.0]
    )
    found = np.stack([motion[f"heading{i}"] for i in range(4)], axis=1)
    assert relative_error(found, expected["headings"]) <= CLOSED_FORM
    radii = [np.hypot(motion[f"x{i}"][-1], motion[f"y{i}"][-1] - SPEED / TURN) for i in range(1, 4)]
    assert (
        relative_error(radii, trailers.steady_radii(SPEED / TURN, lengths)) <= 1e-7
    )  # not quite steady after 30 s


def test_a_straight_train_accelerates_as_one_mass():
    scene = TrailerChain()
    q, u, _ = scene.named(**scene.towing([0.4] * 4, forward=SPEED))
    udot = scene.speed_names.view(jj.accelerations(scene, 0.0, q, u, jnp.array([2.0, 0.3])).udot)
    assert relative_error(udot.forward0, 2.0 / (scene.car_mass + 3 * scene.trailer_mass)) <= tolerance(
        "round_off"
    )
    assert relative_error(udot.turn0, 0.3 / scene.car_inertia) <= ROUND_OFF


def test_one_link_is_a_pendulum_with_its_elliptic_period():
    scene, angle = PendulumChain(links=1), 1.2
    period = 4 * np.sqrt(float(scene.length / scene.gravity)) * ellipk(np.sin(angle / 2) ** 2)
    motion = simulate(scene, scene.hanging([angle]), period * np.array([0.0, 0.25, 0.5, 1.0]))
    expected = float(scene.length) * np.sin([angle, 0.0, -angle, angle])
    assert relative_error(motion["x1"], expected) <= CLOSED_FORM


def test_a_chain_needs_links():
    refused("`links` of `PendulumChain` is 0", PendulumChain, links=0)
    refused("`trailers` of `TrailerChain` is -1", TrailerChain, trailers=-1)
