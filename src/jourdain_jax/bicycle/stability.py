"""Eigenvalues of the linear bicycle, and the speeds at which its stability changes.

    M q'' + v C1 q' + (g K0 + v^2 K2) q = 0,   q = (lean, steer)
    p(s; v) = det(s^2 M + s v C1 + g K0 + v^2 K2) = a4 s^4 + a3 s^3 + a2 s^2 + a1 s + a0

With x = v^2 the coefficients are a4 = b4, a3 = v b3, a2 = b2(x), a1 = v b1(x), a0 = b0(x), and polynomials in x tell

    where an eigenvalue is zero             b0 = 0
    where two eigenvalues sum to zero       b1 b2 b3 - b4 b1^2 - b0 b3^2 = 0     (+-i omega if omega^2 = b1/b3 > 0)
    where two eigenvalues coincide          4 D0^3 - D1^2 = 0, with
        D0 = b2^2 - 3 x b3 b1 + 12 b4 b0,
        D1 = 2 b2^3 - 9 x b3 b2 b1 + 27 x b3^2 b0 + 27 x b4 b1^2 - 72 b4 b2 b0

All their positive roots are found, the one meant is told by how the eigenvalue moves there, ds/dv = - (dp/dv) / (dp/ds), and polished on its
defining equation by Newton. Coefficients stand highest power first.

Source: Meijaard, Papadopoulos, Ruina & Schwab, Proc. R. Soc. A 463 (2007), sections 6-8; Hurwitz determinant and discriminant of a quartic are textbook.
"""

from functools import reduce
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array
from jax.typing import ArrayLike
from jaxtyping import Bool, Complex, Float

from jourdain_jax.calculus.compiled import RUN_SELDOM, compiled
from jourdain_jax.calculus.newton import newton_root

Scalar = Float[Array, ""]
Polynomial = Float[Array, " coefficients"]


class BicycleMatrices(NamedTuple):
    """The linear bicycle; unpacks into the arguments below: `stability_speeds(*matrices)`."""

    M: Float[Array, "2 2"]  # kg m^2
    C1: Float[Array, "2 2"]  # kg m
    K0: Float[Array, "2 2"]  # kg m
    K2: Float[Array, "2 2"]  # kg
    g: Scalar  # m/s^2


class StabilitySpeeds(eqx.Module):
    """The speeds at which a bicycle's stability changes, m/s; NaN where there is none up to the largest speed."""

    weave_speed: Scalar  # above it the oscillation of lean and steer decays
    capsize_speed: Scalar  # above it a slow fall to one side grows
    double_root_speed: Scalar  # above it the two unstable real eigenvalues are the weave pair
    weave_frequency: Scalar  # rad/s, at the weave speed
    double_root_eigenvalue: Scalar  # 1/s, at the double root speed
    stable_from: Scalar  # the widest range of speeds where all four eigenvalues decay (no derivative)
    stable_to: Scalar  # its end: the largest speed looked at if it is still stable there (no derivative)
    stable_range_exists: Bool[Array, ""]


def eigenvalues(
    M: Float[ArrayLike, "2 2"],
    C1: Float[ArrayLike, "2 2"],
    K0: Float[ArrayLike, "2 2"],
    K2: Float[ArrayLike, "2 2"],
    g: ArrayLike,
    speeds: Float[ArrayLike, " speeds"],
) -> Complex[Array, "speeds 4"]:
    """The four eigenvalues (1/s) at each speed (m/s), in the order castering, capsize, weave, weave.

    Ascending real parts name the modes (at rest: two decaying, then two growing real eigenvalues), except that of two
    real eigenvalues on either side of a pair the lower is castering, the higher capsize, and the pair is weave. A pair
    has its negative frequency first.
    """
    matrices = _as_matrices(M, C1, K0, K2, g)
    speeds = jnp.asarray(speeds, matrices.M.dtype)[:, None, None]
    # d/dt (q, q') = [[0, I], [-M^-1 (g K0 + v^2 K2), -M^-1 v C1]] (q, q')
    stiffness = matrices.g * matrices.K0 + speeds**2 * matrices.K2
    lower = -jnp.linalg.solve(matrices.M, jnp.concatenate([stiffness, speeds * matrices.C1], axis=-1))
    upper = jnp.broadcast_to(jnp.eye(2, 4, 2, dtype=lower.dtype), lower.shape)
    return jax.vmap(_name_modes)(jnp.linalg.eigvals(jnp.concatenate([upper, lower], axis=-2)))


def stability_speeds(
    M: Float[ArrayLike, "2 2"],
    C1: Float[ArrayLike, "2 2"],
    K0: Float[ArrayLike, "2 2"],
    K2: Float[ArrayLike, "2 2"],
    g: ArrayLike,
    *,
    max_speed: ArrayLike = 50.0,
) -> StabilitySpeeds:
    """Weave, capsize and double-root speed of one bicycle, differentiable in the matrices and g.

        speeds = stability_speeds(M, C1, K0, K2, 9.81)
        jax.vmap(stability_speeds)(*many)  # a leading axis on each of the five, g included

    Weave: a pair +-i omega crosses into the left half-plane as v grows. Capsize: the lowest speed at which a real
    eigenvalue crosses zero upwards. Double root: the highest speed, below the weave speed where there is one, at which
    two positive real eigenvalues meet and become a pair.

    **Arguments:** `M`, `C1`, `K0`, `K2`, (2, 2) in the order lean, steer; `g` (m/s^2); `max_speed`, the largest speed
    (m/s) looked at.
    **Returns:** a `StabilitySpeeds`. Derivatives follow from the implicit function theorem; where a speed does not exist
    its value is NaN and its derivative zero.
    """
    matrices = _as_matrices(M, C1, K0, K2, g)
    return _speeds(matrices, jax.lax.stop_gradient(jnp.asarray(max_speed, matrices.M.dtype)))


def _stability_speeds(matrices: BicycleMatrices, top: Scalar) -> StabilitySpeeds:
    fixed = jax.lax.stop_gradient(matrices)
    zero, opposite, coincident = (_speeds_at(polynomial, top) for polynomial in _in_speed(fixed))
    growth = jax.vmap(lambda s, v: _growth(fixed, s, v).real)
    upward = growth(jnp.zeros_like(zero), zero) > 0
    downward = growth(1j * jax.vmap(lambda v: _pair_frequency(fixed, v))(opposite), opposite) < 0

    capsize_speed = _polished(lambda v, m: jnp.polyval(_in_speed(m)[0], v**2), jnp.where(upward, zero, jnp.inf).min(), matrices)
    weave_speed = _polished(lambda v, m: jnp.polyval(_in_speed(m)[1], v**2), jnp.where(downward, opposite, -jnp.inf).max(), matrices)
    has_weave = ~jnp.isnan(weave_speed)
    weave_frequency = _pair_frequency(matrices, jnp.where(has_weave, weave_speed, 1.0))

    below = jnp.where(has_weave, jax.lax.stop_gradient(weave_speed), top)
    double_root_eigenvalue, double_root_speed = _double_root(matrices, fixed, coincident, below)
    stable_from, stable_to = _widest_stable_range(fixed, jnp.concatenate([zero, opposite]), top)
    return StabilitySpeeds(
        weave_speed=weave_speed,
        capsize_speed=capsize_speed,
        double_root_speed=double_root_speed,
        weave_frequency=jnp.where(has_weave, weave_frequency, jnp.nan),
        double_root_eigenvalue=double_root_eigenvalue,
        stable_from=stable_from,
        stable_to=stable_to,
        stable_range_exists=~jnp.isnan(stable_from),
    )


_speeds = compiled(_stability_speeds, options=RUN_SELDOM)  # the first call in 2.5 s of processor time, not in 15; the second in 1 ms, not in 3 s


def _name_modes(values: Complex[Array, " 4"]) -> Complex[Array, " 4"]:
    """The order castering, capsize, weave, weave that `eigenvalues` describes."""
    values = values[jnp.lexsort((values.imag, values.real))]
    is_pair = values.imag != 0
    pair_between = is_pair[1] & is_pair[2] & ~is_pair[0] & ~is_pair[3]
    return jnp.where(pair_between, values[jnp.array([0, 3, 1, 2])], values)


def _as_matrices(M, C1, K0, K2, g) -> BicycleMatrices:
    """The matrices as arrays of one floating-point type."""
    dtype = jnp.result_type(float, *(jnp.asarray(matrix).dtype for matrix in (M, C1, K0, K2)))
    return BicycleMatrices(*(jnp.asarray(value, dtype) for value in (M, C1, K0, K2, g)))


def _coefficients(matrices: BicycleMatrices) -> tuple[Polynomial, ...]:
    """b4, b3, b2(x), b1(x), b0(x) of the module's head."""
    M, C1, K0, K2, g = matrices

    def mixed(A, B):  # det(A + B) - det A - det B
        return A[0, 0] * B[1, 1] + A[1, 1] * B[0, 0] - A[0, 1] * B[1, 0] - A[1, 0] * B[0, 1]

    def det(A):
        return mixed(A, A) / 2

    found = (
        [det(M)],
        [mixed(M, C1)],
        [mixed(M, K2) + det(C1), g * mixed(M, K0)],
        [mixed(C1, K2), g * mixed(C1, K0)],
        [det(K2), g * mixed(K0, K2), g**2 * det(K0)],
    )
    return tuple(map(jnp.stack, found))


def _characteristic(matrices: BicycleMatrices, v: ArrayLike) -> Polynomial:
    """a4, a3, a2, a1, a0 at one speed."""
    b4, b3, b2, b1, b0 = (jnp.polyval(b, jnp.asarray(v) ** 2) for b in _coefficients(matrices))
    return jnp.stack([b4, v * b3, b2, v * b1, b0])


def _in_speed(matrices: BicycleMatrices) -> tuple[Polynomial, ...]:
    """Polynomials in x of the module's head: zero where an eigenvalue is, where two sum to zero, and where two coincide."""
    b4, b3, b2, b1, b0 = _coefficients(matrices)
    x = jnp.array([1.0, 0.0], b0.dtype)

    def combined(*terms):
        """The sum of products, each a factor and polynomials."""
        return reduce(jnp.polyadd, (factor * reduce(jnp.polymul, parts) for factor, *parts in terms))

    opposite = combined((1, b1, b2, b3), (-1, b4, b1, b1), (-1, b0, b3, b3))
    D0 = combined((1, b2, b2), (-3, x, b3, b1), (12, b4, b0))
    D1 = combined((2, b2, b2, b2), (-9, x, b3, b2, b1), (27, x, b3, b3, b0), (27, x, b4, b1, b1), (-72, b4, b2, b0))
    return b0, opposite, combined((4, D0, D0, D0), (-1, D1, D1))


def _speeds_at(polynomial: Polynomial, top: Scalar) -> Float[Array, " degree"]:
    """The speeds (m/s) up to `top` at which a polynomial in v^2 is zero, NaN where there are fewer than its degree; to some digits.

    Found as 1/v^2: coefficients of the highest powers may vanish.
    """
    inverse = jnp.roots(polynomial[::-1], strip_zeros=False)
    there = (inverse.imag == 0) & (inverse.real * top**2 > 1)
    return jnp.where(there, 1 / jnp.sqrt(jnp.where(there, inverse.real, 1.0)), jnp.nan)


def _growth(matrices: BicycleMatrices, s: Array, v: Scalar) -> Array:
    """ds/dv = - (dp/dv) / (dp/ds) of the eigenvalue `s`, real or complex."""
    coefficients, slopes = _with_slopes(matrices, v)
    return -jnp.polyval(slopes, s) / jnp.polyval(jnp.polyder(coefficients), s)


def _with_slopes(matrices: BicycleMatrices, v: Scalar) -> tuple[Polynomial, Polynomial]:
    """Coefficients of p and of dp/dv at speed `v`."""
    return jax.jvp(lambda v: _characteristic(matrices, v), (v,), (jnp.ones_like(v),))


def _pair_frequency(matrices: BicycleMatrices, v: Scalar) -> Scalar:
    """omega = sqrt(a1/a3) where +-i omega are eigenvalues; NaN, without derivative, where the two are real."""
    _, a3, _, a1, _ = _characteristic(matrices, v)
    is_pair = a1 * a3 > 0
    squared = jnp.where(is_pair, a1, 1.0) / jnp.where(is_pair, a3, 1.0)
    return jnp.where(is_pair, jnp.sqrt(squared), jnp.nan)


def _coincident_eigenvalues(s_and_v, matrices):
    """p and dp/ds, both zero at a double root."""
    s, v = s_and_v
    coefficients = _characteristic(matrices, v)
    return jnp.stack([jnp.polyval(coefficients, s), jnp.polyval(jnp.polyder(coefficients), s)])


def _polished(residual, guess: Scalar, matrices: BicycleMatrices) -> Scalar:
    """The root near `guess`, differentiable; NaN where `guess` is not finite."""
    return _root(residual, guess[None], matrices, jnp.isfinite(guess))[0]


def _root(residual, guess: Float[Array, " n"], matrices: BicycleMatrices, present) -> Float[Array, " n"]:
    """x with `residual(x, matrices) = 0` near a bracketed `guess`; NaN where no root is `present`."""
    guess = jnp.where(present, guess, 1.0)
    # where there is no root, another function has one: no division by zero enters a batch's derivatives
    found = newton_root(lambda x: jnp.where(present, residual(x, matrices), x - guess), guess, 1.0 + jnp.abs(guess))
    return jnp.where(present, found.x, jnp.nan)


def _double_root(matrices: BicycleMatrices, fixed: BicycleMatrices, candidates: Float[Array, " speeds"], below: Scalar) -> tuple[Scalar, Scalar]:
    """Eigenvalue (1/s) and speed (m/s) where two positive real eigenvalues last become a pair at a speed < `below`."""

    def examine(v):
        coefficients, slopes = _with_slopes(fixed, jnp.where(jnp.isnan(v), 1.0, v))
        roots = jnp.roots(coefficients, strip_zeros=False)
        i, j = jnp.triu_indices(4, 1)
        pair = jnp.argmin(jnp.abs(roots[i] - roots[j]))
        s = (roots[i[pair]] + roots[j[pair]]).real / 2
        # 0 = p_ss ds^2 / 2 + p_v dv: a pair above v where p_ss and p_v have one sign.
        becomes_pair = jnp.polyval(slopes, s) * jnp.polyval(jnp.polyder(coefficients, 2), s) > 0
        return s, (s > 0) & becomes_pair & (v < below)

    roots, merges = jax.vmap(examine)(candidates)
    chosen = jnp.argmax(jnp.where(merges, candidates, -jnp.inf))
    s, v = _root(_coincident_eigenvalues, jnp.stack([roots[chosen], candidates[chosen]]), matrices, merges[chosen])
    return s, v


def _widest_stable_range(matrices: BicycleMatrices, crossings: Float[Array, " crossings"], top: Scalar) -> tuple[Scalar, Scalar]:
    """The widest interval between neighbouring crossings where all eigenvalues decay; NaN if there is none."""
    ends = jnp.concatenate([jnp.zeros_like(top)[None], crossings, top[None]])
    ends = jnp.sort(jnp.where(jnp.isnan(ends), top, ends))
    middles = 0.5 * (ends[:-1] + ends[1:])
    a4, a3, a2, a1, a0 = jax.vmap(lambda v: _characteristic(matrices, v))(middles).T
    # Lienard & Chipart: a0, a1, a3, a4 and the third Hurwitz determinant positive.
    stable = (a0 > 0) & (a1 > 0) & (a3 > 0) & (a4 > 0) & (a1 * a2 * a3 - a4 * a1**2 - a0 * a3**2 > 0)
    widths = jnp.where(stable, ends[1:] - ends[:-1], 0.0)
    widest = jnp.argmax(widths)
    exists = widths[widest] > 0
    return jnp.where(exists, ends[widest], jnp.nan), jnp.where(exists, ends[widest + 1], jnp.nan)
