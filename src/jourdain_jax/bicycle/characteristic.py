"""The characteristic polynomial of the linear bicycle, in the eigenvalue s and in the speed v.

    M q'' + v C1 q' + (g K0 + v^2 K2) q = 0,   q = (lean, steer)
    p(s; v) = det(s^2 M + s v C1 + g K0 + v^2 K2) = a4 s^4 + a3 s^3 + a2 s^2 + a1 s + a0

With x = v^2 the coefficients are a4 = b4, a3 = v b3, a2 = b2(x), a1 = v b1(x), a0 = b0(x), and polynomials in x tell

    where an eigenvalue is zero             b0 = 0
    where two eigenvalues sum to zero       b1 b2 b3 - b4 b1^2 - b0 b3^2 = 0     (+-i omega if omega^2 = b1/b3 > 0)
    where two eigenvalues coincide          4 D0^3 - D1^2 = 0, with
        D0 = b2^2 - 3 x b3 b1 + 12 b4 b0,
        D1 = 2 b2^3 - 9 x b3 b2 b1 + 27 x b3^2 b0 + 27 x b4 b1^2 - 72 b4 b2 b0

Source: Meijaard, Papadopoulos, Ruina & Schwab, Proc. R. Soc. A 463 (2007), section 6; Hurwitz determinant and
discriminant of a quartic are textbook.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array
from jax.typing import ArrayLike
from jaxtyping import Float

from .polynomial_roots import add, evaluate, multiply, scale

Scalar = Float[Array, ""]


class BicycleMatrices(NamedTuple):
    """The linear bicycle; unpacks into the arguments below: `stability_speeds(*matrices)`."""

    M: Float[Array, "2 2"]  # kg m^2
    C1: Float[Array, "2 2"]  # kg m
    K0: Float[Array, "2 2"]  # kg m
    K2: Float[Array, "2 2"]  # kg
    g: Scalar  # m/s^2


def bicycle_matrices(M, C1, K0, K2, g) -> BicycleMatrices:
    """The matrices as arrays of one floating-point type."""
    dtype = jnp.result_type(float, *(jnp.asarray(matrix).dtype for matrix in (M, C1, K0, K2)))
    return BicycleMatrices(*(jnp.asarray(value, dtype) for value in (M, C1, K0, K2, g)))


def characteristic_polynomial(matrices: BicycleMatrices, v: ArrayLike) -> Float[Array, " 5"]:
    """Coefficients (a0, a1, a2, a3, a4) of p(s; v), lowest power of s first.

    **Arguments:** `matrices`, of one bicycle; `v`, forward speed (m/s).
    """
    b0, b1, b2, b3, b4 = speed_polynomials(matrices)
    v = jnp.asarray(v, matrices.M.dtype)
    x = v**2
    return jnp.stack([evaluate(b0, x), v * evaluate(b1, x), evaluate(b2, x), v * b3[0], b4[0]])


def speed_polynomials(matrices: BicycleMatrices) -> tuple[list[Scalar], ...]:
    """b0(x), b1(x), b2(x), b3, b4 of the module's head, each as coefficients, lowest power of x first."""
    M, C1, K0, K2, g = matrices

    def det(A):
        return A[0, 0] * A[1, 1] - A[0, 1] * A[1, 0]

    def mixed(A, B):  # det(A + B) - det A - det B
        return A[0, 0] * B[1, 1] + A[1, 1] * B[0, 0] - A[0, 1] * B[1, 0] - A[1, 0] * B[0, 1]

    return (
        [g**2 * det(K0), g * mixed(K0, K2), det(K2)],
        [g * mixed(C1, K0), mixed(C1, K2)],
        [g * mixed(M, K0), mixed(M, K2) + det(C1)],
        [mixed(M, C1)],
        [det(M)],
    )


def hurwitz_polynomial(polynomials) -> list[Scalar]:
    """b1 b2 b3 - b4 b1^2 - b0 b3^2: the third Hurwitz determinant over x, zero where two eigenvalues sum to zero."""
    b0, b1, b2, b3, b4 = polynomials
    return add(multiply(b1, b2, b3), scale(-1.0, multiply(b4, b1, b1)), scale(-1.0, multiply(b0, b3, b3)))


def discriminant_polynomial(polynomials) -> list[Scalar]:
    """4 D0^3 - D1^2 of the module's head: zero where two eigenvalues coincide."""
    b0, b1, b2, b3, b4 = polynomials
    xb1 = [jnp.zeros_like(b1[0]), *b1]
    xb3 = [jnp.zeros_like(b3[0]), *b3]
    D0 = add(multiply(b2, b2), scale(-3.0, multiply(xb3, b1)), scale(12.0, multiply(b4, b0)))
    D1 = add(
        scale(2.0, multiply(b2, b2, b2)),
        scale(-9.0, multiply(xb3, b2, b1)),
        scale(27.0, multiply(xb3, b3, b0)),
        scale(27.0, multiply(b4, xb1, b1)),
        scale(-72.0, multiply(b4, b2, b0)),
    )
    return add(scale(4.0, multiply(D0, D0, D0)), scale(-1.0, multiply(D1, D1)))
