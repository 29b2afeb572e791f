"""Chains of any number of bodies: trailers behind a car, particles on rods."""

import jax.numpy as jnp
import numpy as np
import pytest
from agreement import admissible_states, disagreement
from oracles import trailers as oracle
from scipy.special import ellipk
from tolerances import relative_error, tolerance

import jourdain_jax as jj
from jourdain_jax.models import PendulumChain, TrailerChain

LENGTH, SPEED, TURN = oracle.RUN["length"], oracle.RUN["v"], oracle.RUN["w"]
WEIGHTLESS = {"trailer_mass": 0.0, "trailer_inertia": 0.0}  # then the car's speed is constant too


def simulate(scene, start, times):
    return jj.simulate(scene, start, ts=jnp.asarray(times), rtol=1e-12, atol=1e-12)


def test_reductions_that_need_a_mass_for_every_coordinate_say_so_for_weightless_trailers():
    apart = disagreement(TrailerChain(trailers=2, **WEIGHTLESS))
    assert set(apart) == {"privileged", "svd", "kkt", "gibbs-appell"}
    assert max(apart.values()) <= tolerance("round_off"), apart


@pytest.mark.parametrize("turn", [0.0, TURN])
def test_a_trailer_straightens_behind_a_car_at_constant_speed(turn):
    scene = TrailerChain(trailers=1, length=LENGTH, **WEIGHTLESS)
    times = np.linspace(0.0, oracle.RUN["t_end"], 11)
    motion = simulate(scene, scene.towing([0.0, -oracle.RUN["gamma0"]], forward=SPEED, turn=turn), times)
    expected = oracle.hitch_angle(times, **{**oracle.RUN, "w": turn})
    assert relative_error(motion["heading0"] - motion["heading1"], expected) <= tolerance("closed_form")


def test_on_a_circle_each_trailer_runs_inside_the_one_ahead():
    lengths = [0.7, 0.5, 0.6]
    scene = TrailerChain(trailers=3, length=jnp.array(lengths), **WEIGHTLESS)
    times = np.linspace(0.0, 30.0, 4)
    motion = simulate(scene, scene.towing([0.0, 0.0, 0.0, 0.0], forward=SPEED, turn=TURN), times)
    expected = oracle.chain(times, lengths=lengths, speed=lambda t: SPEED, yaw_rate=lambda t: TURN, headings0=[0.0, 0.0, 0.0, 0.0])
    found = np.stack([motion[f"heading{i}"] for i in range(4)], axis=1)
    assert relative_error(found, expected["headings"]) <= tolerance("closed_form")
    radii = [np.hypot(motion[f"x{i}"][-1], motion[f"y{i}"][-1] - SPEED / TURN) for i in range(1, 4)]
    assert relative_error(radii, oracle.steady_radii(SPEED / TURN, lengths)) <= 1e-7  # not quite steady after 30 s


def test_heavy_trailers_slow_the_car_as_energy_demands():
    scene = TrailerChain(trailers=1, length=LENGTH)
    motion = simulate(scene, scene.towing([0.3, -0.7], forward=SPEED), np.linspace(0.0, 3.0, 7))
    hitch, speed = motion["heading0"] - motion["heading1"], motion["forward0"]
    # T = v^2 (m0 + m1 cos^2(gamma) + I1 sin^2(gamma)/L^2)/2
    carried = scene.car_mass + scene.trailer_mass * jnp.cos(hitch) ** 2 + scene.trailer_inertia * (jnp.sin(hitch) / LENGTH) ** 2
    assert relative_error(carried * speed**2, jnp.full(7, carried[0] * SPEED**2)) <= tolerance("closed_form")
    assert float(speed[0] - speed[-1]) > 0.05
    assert jnp.max(jnp.abs(motion["turn0"])) <= tolerance("round_off")


def test_a_straight_train_accelerates_as_one_mass():
    scene = TrailerChain()
    q, u, _ = scene.named(**scene.towing([0.4] * 4, forward=SPEED))
    udot = scene.speed_names.view(jj.accelerations(scene, 0.0, q, u, jnp.array([2.0, 0.3])).udot)
    assert relative_error(udot.forward0, 2.0 / (scene.car_mass + 3 * scene.trailer_mass)) <= tolerance("round_off")
    assert relative_error(udot.turn0, 0.3 / scene.car_inertia) <= tolerance("round_off")


@pytest.mark.parametrize("scene", [TrailerChain(trailers=5), PendulumChain(links=6)], ids=lambda s: type(s).__name__)
def test_rows_far_apart_in_the_chain_do_not_meet(scene):
    ((_, q, u),) = admissible_states(scene, 1)
    A = np.asarray(jj.constraint_rows(scene, 0.0, q, u).A)
    M = np.asarray(jj.unconstrained_equations(scene, 0.0, q, u).M)
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
    assert relative_error(motion["x1"], expected) <= tolerance("closed_form")


def test_a_chain_needs_links():
    with pytest.raises(ValueError, match="`links` of `PendulumChain` is 0"):
        PendulumChain(links=0)
    with pytest.raises(ValueError, match="`trailers` of `TrailerChain` is -1"):
        TrailerChain(trailers=-1)
