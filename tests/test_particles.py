"""Particles under one row: Rosenberg's and Heisenberg's, a spring and a rod, and one of constant speed."""

import numpy as np
import pytest
from closed_form_runs import end_error
from oracles import heisenberg_particle, isokinetic_particle, rosenberg_particle, spring_and_rod
from solved_states import solved_at_random_states
from tolerances import CLOSED_FORM, ROUND_OFF, relative_error

from jourdain_jax.models import HeisenbergParticle, IsokineticParticle, RosenbergParticle, SpringAndRod


@pytest.mark.parametrize("b", [rosenberg_particle.RUN["b"], 0.0])
def test_rosenbergs_particle_follows_its_closed_form(b):
    run = rosenberg_particle.RUN | {"b": b}
    start = {"y": run["y0"], "x_rate": run["c"] / np.sqrt(1 + run["y0"] ** 2), "y_rate": b}
    assert end_error(RosenbergParticle(), start, rosenberg_particle.motion, run, "x y z") <= CLOSED_FORM


def test_heisenbergs_particle_moves_straight_and_not_in_helices():
    run = heisenberg_particle.RUN
    start = {"x": run["x0"], "y": run["y0"], "x_rate": run["xdot"], "y_rate": run["ydot"]}
    assert end_error(HeisenbergParticle(), start, heisenberg_particle.motion, run, "x y z") <= CLOSED_FORM


def _rod_run(**changes):
    """Scene, start and numbers of the spring with the rod."""
    run = spring_and_rod.RUN | changes
    scene = SpringAndRod(
        mass1=run["masses"][0],
        mass2=run["masses"][1],
        stiffness=run["stiffness"],
        natural_length=run["natural_length"],
        damping=run["damping"],
        rod_length=np.hypot(*np.subtract(run["r0"][1], run["r0"][0])),
        gravity=run["gravity"],
    )
    places = dict(zip(("x1", "z1", "x2", "z2"), np.ravel(run["r0"]), strict=True))
    rates = dict(zip(("x1_rate", "z1_rate", "x2_rate", "z2_rate"), np.ravel(run["v0"]), strict=True))
    return scene, places | rates, run


def _places(times, **run):
    """Where both masses of the spring with the rod are."""
    r = spring_and_rod.motion(times, **run)["r"]
    return {"x1": r[:, 0, 0], "z1": r[:, 0, 1], "x2": r[:, 1, 0], "z2": r[:, 1, 1]}


@pytest.mark.parametrize("damping", [0.0, 0.8])
def test_spring_and_rod_follow_newtons_equations(damping):
    # the rod turns through level and upright: no fixed pair of rates stays privileged
    scene, start, run = _rod_run(damping=damping)
    assert end_error(scene, start, _places, run, "x1 z1 x2 z2") <= CLOSED_FORM


def test_the_force_that_keeps_the_speed_lies_along_the_velocity():
    scene = IsokineticParticle(mass=1.4, speed=2.1)
    _, u, _, solved = solved_at_random_states(scene)
    # lambda = m g sin(theta); it has real power, and no virtual power: v . dv = 0
    thrust = scene.mass * scene.gravity * u.z_rate / scene.speed
    assert relative_error(solved.multipliers[:, 0], thrust) <= ROUND_OFF
    assert relative_error(solved.constraint_force, thrust[:, None] * u.array / scene.speed) <= ROUND_OFF


def test_the_particle_of_constant_speed_turns_downwards():
    run = isokinetic_particle.RUN
    scene = IsokineticParticle(speed=run["speed"], gravity=run["gravity"])
    names = {"x": "x", "z": "y", "x_rate": "vx", "z_rate": "vy"}
    start = {"x_rate": run["speed"]}
    assert end_error(scene, start, isokinetic_particle.motion, run, **names) <= CLOSED_FORM
