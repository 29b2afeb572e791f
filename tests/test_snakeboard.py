"""The snakeboard through the configuration where its two rows are parallel."""

import jax.numpy as jnp
import numpy as np
import pytest
import result_codes as results
from oracles import snakeboard as oracle
from tolerances import CLOSED_FORM, ROUND_OFF, relative_error

import jourdain_jax as jj
from jourdain_jax.models import Snakeboard

BOARD = Snakeboard()
START = {
    "steer": oracle.RUN["phi0"],
    "steer_rate": oracle.RUN["phi_rate"],
    "x_rate": oracle.RUN["u0"],
    "rotor_rate": oracle.RUN["psi_rate"],
}


@pytest.mark.parametrize("reduction", ["qr", "svd", "kkt", "udwadia-kalaba"])
def test_it_passes_smoothly_where_the_wheel_rows_are_parallel(reduction):
    times = np.linspace(0.0, oracle.RUN["t_end"], 10)  # steer is 90 degrees between the fifth and the sixth
    motion = jj.simulate(
        BOARD, START, ts=times, rtol=1e-12, atol=1e-12, formulation=jj.Formulation(reduction=reduction)
    )
    expected = oracle.motion(times, **oracle.RUN)
    pairs = {
        "x": "x",
        "y": "y",
        "heading": "th",
        "rotor": "psi",
        "steer": "phi",
        "heading_rate": "th_rate",
        "rotor_rate": "psi_rate",
    }
    travelled = times[-1] * np.mean(
        np.abs(oracle.velocities(np.linspace(0.0, times[-1], 101), **oracle.RUN)["u"])
    )  # m, on curls
    for name, key in pairs.items():
        size = travelled if name in ("x", "y") else None
        assert relative_error(motion[name], expected[key], size) <= CLOSED_FORM, name


def test_a_retry_passes_wherever_a_step_ends_near_the_loss_of_rank():
    # a step that ends within round-off of parallel rows once met a jump of v/(1 - steer) in the accelerations
    # and shrank to nothing; the scalar program, whose pivot vanishes there, ends and says how to go on
    times = np.linspace(0.0, oracle.RUN["t_end"], 9)
    for beyond in (0.0, 1e-15, 3e-15, 1e-14, 1e-13, 1e-12, 1e-11, 1e-10, -1e-13, -1e-11):
        shifted = times + beyond * (np.arange(9) == 4)
        motion = jj.simulate(BOARD, START, ts=shifted, rtol=1e-12, atol=1e-12, retry=True)
        assert motion.result == results.SUCCESS, beyond
        assert "cutoff 1e-08" in str(motion.reduction)
        assert relative_error(motion["heading"], oracle.motion(shifted, **oracle.RUN)["th"]) <= CLOSED_FORM, (
            beyond
        )

    alone = jj.simulate(BOARD, START, ts=times, rtol=1e-6, atol=1e-6)
    assert alone.result == results.STEP_TOO_SMALL
    assert alone["steer"][4 - 1] < np.pi / 2
    with pytest.raises(jj.SimulationError, match="where constraints lose rank, pass retry=True"):
        alone.raise_if_failed()


def test_the_loss_of_rank_is_reported_not_hidden():
    q, u, _ = BOARD.named(steer=jnp.pi / 2, heading_rate=1.0)
    for name, reduction in jj.reductions(BOARD).items():
        found = jj.accelerations(BOARD, 0.0, q, u, reduction=reduction)
        if name in ("privileged", "gibbs-appell"):
            assert not found.applicable, name
        else:
            assert found.rank == 1, name
            assert jnp.all(jnp.isfinite(found.udot)), name
            assert jnp.all(jnp.isfinite(found.multipliers)), name


def test_a_torque_on_the_rotor_turns_the_board_the_other_way():
    # steer 90 degrees: wheels on a circle about the middle; the board turns freely about it
    q, u, _ = BOARD.named(steer=jnp.pi / 2)
    udot = BOARD.speed_names.view(jj.accelerations(BOARD, 0.0, q, u, jnp.array([0.3, 0.0])).udot)
    board = BOARD.board_inertia + 2 * BOARD.wheel_inertia
    assert relative_error(udot.heading_rate, -0.3 / board) <= ROUND_OFF
    assert relative_error(udot.rotor_rate, 0.3 / board + 0.3 / BOARD.rotor_inertia) <= ROUND_OFF


def test_a_torque_on_the_wheels_opens_both_pairs():
    q, u, _ = BOARD.named(steer=0.4)
    udot = BOARD.speed_names.view(jj.accelerations(BOARD, 0.0, q, u, jnp.array([0.0, 0.3])).udot)
    assert relative_error(udot.steer_rate, 0.3 / (2 * BOARD.wheel_inertia)) <= ROUND_OFF
    assert abs(udot.heading_rate) <= ROUND_OFF
