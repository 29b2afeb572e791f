"""The exponential map of rotations, for unit quaternions, and the inverse of its derivative.

    exp(sigma) = (cos(theta/2), sin(theta/2) sigma/theta),   theta = |sigma|           (a turn by the rotation vector sigma)
    p(t) = p_0 exp(sigma(t)),  pdot = 1/2 p (0, omega)   =>   sigmadot = omega + 1/2 sigma x omega + k sigma x (sigma x omega)
    k = (1 - (theta/2) cot(theta/2)) / theta^2

All coefficients are smooth functions of theta^2, by series where it is small: sigma = 0 is where every step begins.
Source: A. Iserles, H. Munthe-Kaas, S. P. Norsett and A. Zanna, Lie-group methods, Acta Numerica 9 (2000) 215, section 2 and appendix B.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

_SMALL_EXP, _SMALL_INVERSE = 1e-3, 1e-2  # of theta^2; below, the first term left out is under round-off


def quaternion_exponential(rotation_vector: Float[Array, "3"]) -> Float[Array, "4"]:
    """The unit quaternion (w, x, y, z) of a turn by `rotation_vector` (rad), of norm 1 to round-off."""
    squared = rotation_vector @ rotation_vector
    small = squared < _SMALL_EXP
    theta = jnp.sqrt(jnp.where(small, 1.0, squared))
    w = jnp.where(small, 1 - squared / 8 * (1 - squared / 48 * (1 - squared / 120)), jnp.cos(theta / 2))
    half_sinc = jnp.where(small, 0.5 - squared / 48 * (1 - squared / 80 * (1 - squared / 168)), jnp.sin(theta / 2) / theta)
    return jnp.concatenate([w[None], half_sinc * rotation_vector])


def rotation_vector_rate(rotation_vector: Float[Array, "3"], omega_body: Float[Array, "3"]) -> Float[Array, "3"]:
    """Rate (rad/s) of the rotation vector of `p_0 exp(rotation_vector)` that turns with body angular velocity `omega_body` (rad/s).

    Singular after a whole turn, `|rotation_vector| = 2 pi`.
    """
    squared = rotation_vector @ rotation_vector
    small = squared < _SMALL_INVERSE
    usual = jnp.where(small, 1.0, squared)
    half = jnp.sqrt(usual) / 2
    k = jnp.where(small, (1 + squared / 60 * (1 + squared / 42 * (1 + squared / 40))) / 12, (1 - half / jnp.tan(half)) / usual)
    turned = jnp.cross(rotation_vector, omega_body)
    return omega_body + 0.5 * turned + k * jnp.cross(rotation_vector, turned)
