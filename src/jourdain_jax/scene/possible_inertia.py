"""Possible moments of inertia as functions of unconstrained numbers d, s. The matrix I is positive definite,
and each principal moment is at most the sum of the other two.

    I = tr(S) 1 - S,      S = A A'       A = [exp(d1) s12 s13; 0 exp(d2) s23; 0 0 exp(d3)]

S is the second moment of the mass about the mass centre, positive definite for every body that is not flat. A
is its upper triangular Cholesky factor. Mass and mass centre are the other parts of the body's pseudo-inertia
and do not affect S. Source: C. Rucker and P. M. Wensing, IEEE Robotics and Automation Letters 7 (2022) 2700,
eqs. (10)-(13).
"""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jourdain_jax.calculus.reals import Matrix3, Numbers, checked_real, known_numbers, largest


def inertia_from_log_cholesky(numbers: Numbers) -> Matrix3:
    """Return an inertia matrix (3, 3) about the mass centre, in kg m^2, that is physically possible for all
    `numbers`. It is differentiable at all numbers.

    **Arguments:** `numbers`, (d1, d2, d3, s12, s23, s13), of a triangular factor in sqrt(kg) m: the
    logarithms d of its diagonal entries, and its other entries s. For a body that is symmetric about its x-z
    plane, where Ixy = Iyz = 0: (d1, d2, d3, s13).

        moments = jj.identification.log_cholesky([0.5, 1.0, 0.7])

        class Frame(jj.Scene):
            inertia: jax.Array = jj.parameter(moments)  # free={"inertia"} in a fit
            ...
                inertia = jj.identification.inertia_from_log_cholesky(self.inertia)
                jj.RigidBody(self.mass, inertia, position, orientation)

    **Raises** ValueError for another shape.
    """
    numbers = checked_real(
        numbers,
        "`numbers` of `inertia_from_log_cholesky`",
        advice="give (d1, d2, d3, s12, s23, s13), or (d1, d2, d3, s13)",
    )
    if numbers.shape not in ((6,), (4,)):
        raise ValueError(
            f"`numbers` of `inertia_from_log_cholesky` has shape {numbers.shape}, expected (6,), or (4,) for "
            "a body that is symmetric about its x-z plane; make them from an inertia matrix by `log_cholesky`"
        )
    zero = jnp.zeros((), numbers.dtype)
    d1, d2, d3 = jnp.exp(numbers[:3])
    s12, s23, s13 = (zero, zero, numbers[3]) if numbers.shape == (4,) else numbers[3:]
    A = jnp.stack([jnp.stack([d1, s12, s13]), jnp.stack([zero, d2, s23]), jnp.stack([zero, zero, d3])])
    # S = A A',   I = tr(S) 1 - S
    S = A @ A.T
    return jnp.trace(S) * jnp.eye(3, dtype=S.dtype) - S


def log_cholesky(inertia: Any, *, symmetric: bool = False) -> Float[Array, "numbers"]:
    """Return the numbers (6,) from which `inertia_from_log_cholesky` computes this `inertia`: a matrix (3, 3)
    or three principal moments, in kg m^2, about the mass centre.

    `symmetric`: return four numbers, for a body that is symmetric about its x-z plane. **Raises** ValueError
    for another shape, an asymmetric matrix, nonzero Ixy or Iyz with `symmetric`, and moments of a flat or
    impossible body. For a traced matrix of such a body the result is NaN.
    """
    I = checked_real(
        inertia, "`inertia` of `log_cholesky`", advice="give a 3x3 matrix or three principal moments, kg m^2"
    )
    I = jnp.diag(I) if I.shape == (3,) else I
    if I.shape != (3, 3):
        raise ValueError(
            f"`inertia` of `log_cholesky` has shape {I.shape}, expected (3, 3) or (3,): a "
            "matrix or three principal moments, kg m^2"
        )
    S = jnp.trace(I) / 2 * jnp.eye(3, dtype=I.dtype) - I
    if known_numbers(I).size:
        _check(np.asarray(I), np.asarray(S), symmetric)
    # A is upper triangular: reverse rows and columns of S, take the lower factor, reverse it back
    A = jnp.linalg.cholesky(S[::-1, ::-1])[::-1, ::-1]
    d = jnp.log(jnp.diag(A))
    return jnp.concatenate([d, A[0, 2:] if symmetric else jnp.stack([A[0, 1], A[1, 2], A[0, 2]])])


def _check(I: np.ndarray, S: np.ndarray, symmetric: bool) -> None:
    size = largest(I)
    if not np.all(np.abs(I - I.T) <= 1e-9 * size):
        raise ValueError("`inertia` of `log_cholesky` is not symmetric; give Ixy = Iyx, Ixz = Izx, Iyz = Izy")
    if symmetric and max(abs(I[0, 1]), abs(I[1, 2])) > 1e-9 * size:
        raise ValueError(
            f"`inertia` of `log_cholesky` has Ixy = {I[0, 1]:g} and Iyz = {I[1, 2]:g}, but "
            "`symmetric` excludes them; omit `symmetric`"
        )
    if not np.all(np.linalg.eigvalsh(S) > 0):
        raise ValueError(
            f"no body of nonzero thickness has the principal moments of inertia {np.linalg.eigvalsh(I)} kg "
            "m^2 (`inertia` of `log_cholesky`), expected positive ones, each less than the sum of the other "
            "two; for a flat body, reduce the largest slightly"
        )
