"""Motions of models against closed forms and reference runs: rolling discs, a ball on a turntable, double
pendulums, chains.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from agreement import admissible_states, disagreement
from closed_form_runs import end_error
from derivatives import derivatives
from oracles import ball_on_turntable, double_pendulum, rolling_disc, trailers, vertical_disc
from refusals import refused
from scipy.special import ellipk
from solved_states import solved_at_random_states, solved_by_every_reduction
from tolerances import CLOSED_FORM, DRIFT, ROUND_OFF, relative_error, tolerance

import jourdain_jax as jj
from jourdain_jax.equations import constraint_rows, unconstrained_equations
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


def _upright_accelerations(x):
    """Of (heading, x', y', heading', roll'), for R = 0.6 and at any speeds."""
    heading, _, _, turn, roll = x
    c, s = jnp.cos(heading), jnp.sin(heading)
    return jnp.stack([-0.6 * s * turn * roll, 0.6 * c * turn * roll, jnp.zeros_like(c), jnp.zeros_like(c)])


def _upright_by(reduction, x):
    scene = VerticalDisc(mass=1.4, radius=0.6, roll_inertia=0.3, turn_inertia=0.2)
    q = jnp.stack([0.1, 0.2, x[0], -0.4])
    return jj.accelerations(scene, 0.0, q, x[1:], reduction=reduction).udot


@pytest.mark.parametrize("name", ["qr", "svd", "kkt", "udwadia-kalaba"])  # those that factorise the rows
def test_derivatives_of_the_upright_discs_accelerations_are_exact(name):
    # two orthogonal rows of one length: their singular values are equal
    reduction = jj.reductions(VerticalDisc())[name]
    weights = jnp.array([0.7, -1.1, 0.4, 0.9])
    directions = jax.random.normal(jax.random.key(2), (2, 5))
    differentiate = jax.jit(
        lambda x: derivatives(lambda x: weights @ _upright_by(reduction, x), x, directions)
    )
    for heading in (0.0, 0.6, np.pi / 2):
        x = jnp.array([heading, 0.3, 0.2, 1.3, 0.8])
        expected = derivatives(lambda x: weights @ _upright_accelerations(x), x, directions)
        for mode, value in differentiate(x).items():
            assert relative_error(value, expected[mode]) <= ROUND_OFF, f"{mode} at heading {heading}"


@pytest.mark.parametrize("turn", [vertical_disc.RUN["phi_rate"], 0.0], ids=["circle", "straight"])
def test_the_upright_disc_rolls_in_a_circle_or_straight(turn):
    run = vertical_disc.RUN | {"phi_rate": turn, "phi0": 0.3, "t_end": 3.0}
    start = {"heading": 0.3, "heading_rate": turn, "roll_rate": run["th_rate"]}
    assert end_error(VerticalDisc(), start, vertical_disc.motion, run, "x y", roll="th") <= CLOSED_FORM


def test_the_multipliers_of_the_upright_disc_are_the_ground_forces():
    run = vertical_disc.RUN | {"phi0": 0.8, "th_rate": 1.7}
    scene = VerticalDisc()
    start = jj.start(scene, heading=0.8, heading_rate=run["phi_rate"], roll_rate=1.7)
    expected = vertical_disc.motion(0.0, **run)
    for name, solved in solved_by_every_reduction(scene, start.q, start.u).items():
        assert relative_error(solved.multipliers, [expected["l1"], expected["l2"]]) <= ROUND_OFF, name


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


def test_the_free_disc_nearly_falls_flat_and_rises_again():
    # 0.02 degrees from flat, at t = 0.154, the contact races half round the rim, where angles would fail
    run, theta, turn = rolling_disc.NEAR_FALL, rolling_disc.NEAR_FALL["theta0"], 1e-3
    yaw_rate = turn / np.sin(theta)
    start = _free_body(0.0, theta - np.pi / 2, 0.0, yaw_rate, 0.0, yaw_rate * np.cos(theta), run["radius"])
    scene = TiltingDiscQuaternion(run["mass"], run["radius"], run["gravity"])
    times = np.array([0.0, 0.25])
    trajectory = jj.simulate(scene, start, ts=jnp.asarray(times), rtol=1e-9, atol=1e-9).raise_if_failed()
    values = {name: run[name] for name in ("mass", "radius", "gravity")}
    expected = rolling_disc.motion(times, **values, theta=theta, w1=0.0, w2=turn, w3=0.0)
    for name in "xyz":
        # round-off in the attitude counts 1/theta^2 = 1e7-fold in the contact's motion while the disc is near
        # flat
        assert abs(trajectory[name][-1] - expected[f"c{name}"][-1]) <= 1e-8


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


SOLID, HOLLOW = 2 / 5, 2 / 3


@pytest.mark.parametrize("kappa", [SOLID, HOLLOW])
@pytest.mark.parametrize("tilt", [0.0, 0.2, -0.3])
def test_the_centre_moves_like_a_charge_in_a_magnetic_field(kappa, tilt):
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


def test_the_attitude_turns_with_the_angular_velocity_of_the_rows():
    # omega of the body, by its orientation's rate, is the one that the speeds name
    scene = BallOnTurntable(tilt=0.3)
    _, q, u = (jnp.asarray(x) for x in jj.sample_states(scene, 1))
    omega = jax.jit(lambda q, u: jj.motion_at(scene, 0.0, q, u)["ball"].angular_velocity)(q[0], u[0])
    c, s = jnp.cos(0.3), jnp.sin(0.3)
    axes = jnp.array([[c, 0.0, -s], [0.0, 1.0, 0.0], [s, 0.0, c]])
    assert relative_error(axes @ omega, u[0, 2:]) <= ROUND_OFF


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


def test_defaults_are_those_of_the_reference_run():
    for scene in (ANGLES, RODS):
        values = {"mass1": "m1", "mass2": "m2", "length1": "l1", "length2": "l2", "gravity": "gravity"}
        assert {name: float(getattr(scene, name)) for name in values} == {
            name: double_pendulum.RUN[key] for name, key in values.items()
        }


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


def test_heavy_trailers_slow_the_car_as_energy_demands():
    scene = TrailerChain(trailers=1, length=LENGTH)
    motion = simulate(scene, scene.towing([0.3, -0.7], forward=SPEED), np.linspace(0.0, 3.0, 7))
    hitch, speed = np.asarray(motion["heading0"]) - motion["heading1"], np.asarray(motion["forward0"])
    # T = v^2 (m0 + m1 cos^2(gamma) + I1 sin^2(gamma)/L^2)/2
    carried = (
        scene.car_mass
        + scene.trailer_mass * np.cos(hitch) ** 2
        + scene.trailer_inertia * (np.sin(hitch) / LENGTH) ** 2
    )
    assert relative_error(carried * speed**2, np.full(7, carried[0] * SPEED**2)) <= CLOSED_FORM
    assert speed[0] - speed[-1] > 0.05
    assert np.max(np.abs(motion["turn0"])) <= ROUND_OFF


def test_a_straight_train_accelerates_as_one_mass():
    scene = TrailerChain()
    q, u, _ = scene.named(**scene.towing([0.4] * 4, forward=SPEED))
    udot = scene.speed_names.view(jj.accelerations(scene, 0.0, q, u, jnp.array([2.0, 0.3])).udot)
    assert relative_error(udot.forward0, 2.0 / (scene.car_mass + 3 * scene.trailer_mass)) <= tolerance(
        "round_off"
    )
    assert relative_error(udot.turn0, 0.3 / scene.car_inertia) <= ROUND_OFF


@pytest.mark.parametrize(
    "scene", [TrailerChain(trailers=5), PendulumChain(links=6)], ids=lambda s: type(s).__name__
)
def test_rows_far_apart_in_the_chain_do_not_meet(scene):
    ((_, q, u),) = admissible_states(scene, 1)
    A = np.asarray(constraint_rows(scene, 0.0, q, u).A)
    M = np.asarray(unconstrained_equations(scene, 0.0, q, u).M)
    names = jj.structure_of(scene).row_names
    place = np.array([int(name.split("[")[0].split()[-1]) for name in names])
    coupling = np.abs(A @ np.linalg.solve(M, A.T))
    far = np.abs(place[:, None] - place) > 1
    assert np.max(coupling[far]) == 0
    assert np.min(np.diagonal(coupling)) > 0


def test_one_link_is_a_pendulum_with_its_elliptic_period():
    scene, angle = PendulumChain(links=1), 1.2
    period = 4 * np.sqrt(float(scene.length / scene.gravity)) * ellipk(np.sin(angle / 2) ** 2)
    motion = simulate(scene, scene.hanging([angle]), period * np.array([0.0, 0.25, 0.5, 1.0]))
    expected = float(scene.length) * np.sin([angle, 0.0, -angle, angle])
    assert relative_error(motion["x1"], expected) <= CLOSED_FORM


def test_a_chain_needs_links():
    refused("`links` of `PendulumChain` is 0", PendulumChain, links=0)
    refused("`trailers` of `TrailerChain` is -1", TrailerChain, trailers=-1)
