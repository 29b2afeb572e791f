"""One blade: the skate on an incline and the Chaplygin sleigh."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from closed_form_runs import end_error
from derivatives import derivatives
from oracles import chaplygin_sleigh, skate
from solved_states import solved_by_every_reduction
from tolerances import CLOSED_FORM, ROUND_OFF, relative_error

import jourdain_jax as jj
from jourdain_jax.models import ChaplyginSleigh, Skate


def _skate_accelerations(x):
    """Of (slope, heading, x', y', heading'), at any speeds: x', y' need not obey the row."""
    slope, heading, vx, vy, w = x
    c, s = jnp.cos(heading), jnp.sin(heading)
    v, push = vx * c + vy * s, 9.81 * jnp.sin(slope) * jnp.cos(heading)
    # along the blade: x'' c + y'' s = push;   the row's rate: x'' s - y'' c = -w v
    return jnp.stack([push * c - w * v * s, push * s + w * v * c, jnp.zeros_like(w)])


def _skate_by(reduction, x):
    slope, heading, vx, vy, w = x
    q, u = jnp.stack([0.3, -0.2, heading]), jnp.stack([vx, vy, w])
    return jj.accelerations(Skate(slope=slope), 0.0, q, u, reduction=reduction).udot


def _applies(name, heading):
    """x' and heading' are privileged: not across the slope, where x' is held."""
    return not (name in ("privileged", "gibbs-appell") and abs(np.cos(heading)) < 1e-9)


# those that are slow here factorise the rows of an upright disc in `test_discs_and_chains.py`; those of the
# Gibbs function take longest to compile
SKATES = ["privileged", "qr", "svd", "kkt", "udwadia-kalaba", "gibbs-appell"]


@pytest.mark.parametrize("name", SKATES)
def test_derivatives_of_the_skates_accelerations_are_exact_at_any_heading(name):
    # heading 0 puts the row along a leading coordinate, where a plain QR differentiates to NaN
    reduction = jj.reductions(Skate())[name]
    weights = jnp.array([0.7, -1.1, 0.4])
    directions = jax.random.normal(jax.random.key(1), (2, 5))
    differentiate = jax.jit(lambda x: derivatives(lambda x: weights @ _skate_by(reduction, x), x, directions))
    for heading in (0.0, 0.6, np.pi / 2, np.pi):
        if _applies(name, heading):
            x = jnp.array([0.3, heading, 0.8, 0.1, 1.3])
            expected = derivatives(lambda x: weights @ _skate_accelerations(x), x, directions)
            for mode, value in differentiate(x).items():
                assert relative_error(value, expected[mode]) <= ROUND_OFF, f"{mode} at heading {heading}"


def test_privileged_velocities_say_that_they_do_not_apply_across_the_slope():
    scene = Skate()
    q, u, _ = scene.named(heading=np.pi / 2, y_rate=1.0, heading_rate=0.5)
    for name, solved in solved_by_every_reduction(scene, q, u).items():
        assert solved.applicable == _applies(name, np.pi / 2), name


@pytest.mark.parametrize("moving", [{}, {"u0": 0.9, "th0": 0.4, "th_rate": -0.7}])
def test_the_skate_drifts_across_the_slope_as_by_its_closed_form(moving):
    run = skate.RUN | moving  # passes heading 90 degrees, where x' is no privileged speed
    scene = Skate(run["mass"], run["inertia"], run["slope"], run["gravity"])
    u, th = run["u0"], run["th0"]
    start = {
        "heading": th,
        "x_rate": u * np.cos(th),
        "y_rate": u * np.sin(th),
        "heading_rate": run["th_rate"],
    }
    assert end_error(scene, start, skate.motion, run, "x y", heading="th") <= CLOSED_FORM


@pytest.mark.parametrize("turn", [0.9, -0.9])
def test_the_sleigh_turns_round_and_runs_straight(turn):
    run = chaplygin_sleigh.RUN | {"w0": turn}
    scene = ChaplyginSleigh(run["mass"], run["inertia"], run["a"])
    start = {"x_rate": run["v0"], "y_rate": run["a"] * turn, "heading_rate": turn}
    assert (
        end_error(scene, start, chaplygin_sleigh.motion, run, "x y", heading="th", heading_rate="w")
        <= CLOSED_FORM
    )
