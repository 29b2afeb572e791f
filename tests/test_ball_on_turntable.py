"""A ball that rolls on a turning plane, flat or tilted."""

import jax
import jax.numpy as jnp
import pytest
from closed_form_runs import end_error
from oracles import ball_on_turntable
from solved_states import solved_at_random_states
from tolerances import relative_error, tolerance

import jourdain_jax as jj
from jourdain_jax.models import BallOnTurntable

SOLID, HOLLOW = 2 / 5, 2 / 3


@pytest.mark.parametrize("kappa", [SOLID, HOLLOW])
@pytest.mark.parametrize("tilt", [0.0, 0.2, -0.3])
def test_the_centre_moves_like_a_charge_in_a_magnetic_field(kappa, tilt):
    scene = BallOnTurntable(radius=0.08, inertia_ratio=kappa, turn_rate=1.5, tilt=tilt)
    _, u, udot, _ = solved_at_random_states(scene)
    # R'' = n z x R' + g sin(tilt) x / (1 + kappa)
    n, push = 1.5 * kappa / (1 + kappa), 9.81 * jnp.sin(tilt) / (1 + kappa)
    expected = jnp.stack([push - n * u.y_rate, n * u.x_rate], axis=1)
    assert relative_error(udot.array[:, :2], expected) <= tolerance("round_off")
    assert jnp.max(jnp.abs(udot.spin)) <= tolerance("round_off") * jnp.max(jnp.abs(udot.array))


RATES = {"x_rate": "vx", "y_rate": "vy", "roll_x": "wx", "roll_y": "wy", "spin": "wz"}


@pytest.mark.parametrize("run", [ball_on_turntable.RUN_FLAT, ball_on_turntable.RUN], ids=["flat", "tilted"])
def test_the_ball_follows_its_closed_form(run):
    scene = BallOnTurntable(**{name: run[name] for name in ("radius", "inertia_ratio", "turn_rate", "tilt", "gravity")})
    start = {"x": run["x0"], "y": run["y0"], "x_rate": run["vx0"], "y_rate": run["vy0"], "spin": run["wz"]}
    assert end_error(scene, start, ball_on_turntable.motion, run, "x y", **RATES) <= tolerance("closed_form")


def test_on_a_table_at_rest_the_ball_rolls_straight():
    run = ball_on_turntable.RUN_FLAT | {"turn_rate": 0.0, "t_end": 2.0}
    start = {"x": run["x0"], "x_rate": run["vx0"], "y_rate": run["vy0"], "spin": run["wz"]}
    assert end_error(BallOnTurntable(turn_rate=0.0), start, ball_on_turntable.motion, run, "x y", **RATES) <= tolerance("closed_form")


def test_the_attitude_turns_with_the_angular_velocity_of_the_rows():
    # omega of the body, by its orientation's rate, is the one that the speeds name
    scene = BallOnTurntable(tilt=0.3)
    _, q, u = (jnp.asarray(x) for x in jj.sample_states(scene, 1))
    omega = jax.jit(lambda q, u: jj.motion_at(scene, 0.0, q, u)["ball"].angular_velocity)(q[0], u[0])
    c, s = jnp.cos(0.3), jnp.sin(0.3)
    axes = jnp.array([[c, 0.0, -s], [0.0, 1.0, 0.0], [s, 0.0, c]])
    assert relative_error(axes @ omega, u[0, 2:]) <= tolerance("round_off")
