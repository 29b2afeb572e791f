"""The reduced Appell equations give the accelerations that all coordinates together give (row S9)."""

import jax
import jax.numpy as jnp
import numpy as np
from refusals import refused
from tolerances import ROUND_OFF

import jourdain_jax as jj
from jourdain_jax.dynamics.reduced import reduced_accelerations, reduced_coordinates
from jourdain_jax.models import (
    BallOnTurntable,
    ChaplyginSleigh,
    IsokineticParticle,
    TiltingDisc,
    TwoWheelAxleFree,
)


def test_what_is_found_by_quadrature_is_not_kept():
    axle, disc, ball, sleigh = map(
        reduced_coordinates, (TwoWheelAxleFree(), TiltingDisc(), BallOnTurntable(), ChaplyginSleigh())
    )
    # theta is held by its row, phi2 equals phi1 by its row: both appear, neither moves by itself
    assert axle.kept == ("phi1", "theta1", "phi2", "theta2")
    assert set(axle.recovered) == {"x1", "y1", "z1", "psi1", "x2", "y2", "z2", "psi2"}
    assert disc.kept == ("lean",)
    assert disc.dropped == (("yaw", "spin"), ("x", "y"))  # the yaw before the place
    # the attitude of a ball, and with it the place, on which the rolling on a turning table depends
    assert {"attitude_w", "attitude_x", "x", "y"} <= set(ball.kept)
    assert sleigh.kept == ("heading",)


def test_the_reduced_accelerations_of_the_axle_are_equations_64():
    scene = TwoWheelAxleFree()
    phi = 0.7
    psi1, phi_acceleration = reduced_accelerations(
        scene, 0.0, jnp.array([phi, 0.0, phi, 0.0]), jnp.array([1.3, 0.9])
    )
    expected = 1.2 * 9.81 * np.sin(0.2) * np.cos(phi) / (0.3 * (1.2 + 0.5))
    assert np.isclose(psi1, expected, rtol=ROUND_OFF)
    assert abs(phi_acceleration) <= ROUND_OFF * expected


def test_reduced_accelerations_are_those_of_the_whole_scene():
    scene = TiltingDisc()
    independent = list(jj.structure_of(scene).independent)

    def both(t, q, u):
        y = u[jnp.array(independent)]
        return (
            reduced_accelerations(scene, t, q[3:4], y),
            jj.accelerations(scene, t, q, u).udot[jnp.array(independent)],
        )

    reduced, whole = jax.jit(jax.vmap(both))(*jj.sample_states(scene, 20))
    assert jnp.max(jnp.abs(reduced - whole)) <= ROUND_OFF * jnp.max(jnp.abs(whole))


def test_rows_nonlinear_in_the_speeds_have_no_reduced_equations():
    refused("IsokineticParticle", reduced_coordinates, IsokineticParticle())
