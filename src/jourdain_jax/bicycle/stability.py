"""Eigenvalues of the linear bicycle, and the speeds at which its stability changes.

    M q'' + v C1 q' + (g K0 + v^2 K2) q = 0,   q = (lean, steer),   p(s; v) its characteristic polynomial

Each event is a root of a polynomial in v^2 (`characteristic.py`). All its positive roots are found, the one meant is told
by how the eigenvalue moves there, ds/dv = - (dp/dv) / (dp/ds), and polished on its defining equation by Newton.

Source: Meijaard, Papadopoulos, Ruina & Schwab, Proc. R. Soc. A 463 (2007), sections 6-8.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array
from jax.typing import ArrayLike
from jaxtyping import Bool, Complex, Float

from jourdain_jax.calculus.compiled import RUN_SELDOM, compiled
from jourdain_jax.calculus.newton import newton_root

from .characteristic import (
    BicycleMatrices,
    bicycle_matrices,
    characteristic_polynomial,
    discriminant_polynomial,
    hurwitz_polynomial,
    speed_polynomials,
)
from .polynomial_roots import evaluate, real_roots

Scalar = Float[Array, ""]


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
    matrices = bicycle_matrices(M, C1, K0, K2, g)
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
    matrices = bicycle_matrices(M, C1, K0, K2, g)
    return _speeds(matrices, jax.lax.stop_gradient(jnp.asarray(max_speed, matrices.M.dtype)))


def _stability_speeds(matrices: BicycleMatrices, top: Scalar) -> StabilitySpeeds:
    fixed = jax.lax.stop_gradient(matrices)
    polynomials = speed_polynomials(fixed)
    zero_crossings = _roots_in_speed(polynomials[0], top)
    pair_crossings = _roots_in_speed(hurwitz_polynomial(polynomials), top)

    capsize_speed = _polished(_zero_eigenvalue, _lowest_upward(fixed, zero_crossings), matrices)
    weave_speed = _polished(_opposite_eigenvalues, _highest_downward(fixed, pair_crossings), matrices)
    has_weave = ~jnp.isnan(weave_speed)
    weave_frequency = _pair_frequency(matrices, jnp.where(has_weave, weave_speed, 1.0))

    below = jnp.where(has_weave, jax.lax.stop_gradient(weave_speed), top)
    double_root_eigenvalue, double_root_speed = _double_root(matrices, fixed, below, top)
    stable_from, stable_to = _widest_stable_range(fixed, jnp.concatenate([zero_crossings, pair_crossings]), top)
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


def _roots_in_speed(polynomial: list[Scalar], top: Scalar) -> Float[Array, " degree"]:
    """The speeds (m/s) up to `top` at which a polynomial in v^2 is zero, NaN where there are fewer than its degree."""
    return jnp.sqrt(real_roots(polynomial, jnp.zeros_like(top), top**2))


def _first_derivative(coefficients: Float[Array, " n"]) -> Float[Array, " n-1"]:
    return coefficients[1:] * jnp.arange(1, coefficients.size)


def _expand(matrices: BicycleMatrices, v: Scalar) -> tuple[Float[Array, " 5"], Float[Array, " 5"]]:
    """Coefficients of p and of dp/dv at speed `v`."""
    return jax.jvp(lambda v: characteristic_polynomial(matrices, v), (v,), (jnp.ones_like(v),))


def _growth(matrices: BicycleMatrices, s: Array, v: Scalar) -> Array:
    """ds/dv = - (dp/dv) / (dp/ds) of the eigenvalue `s`, real or complex."""
    coefficients, slopes = _expand(matrices, v)
    return -evaluate(slopes, s) / evaluate(_first_derivative(coefficients), s)


def _lowest_upward(matrices: BicycleMatrices, speeds: Float[Array, " crossings"]) -> Scalar:
    """The lowest of the speeds with a zero eigenvalue at which it grows; infinite if there is none."""
    growth = jax.vmap(lambda v: _growth(matrices, jnp.zeros_like(v), v))(speeds)
    return jnp.where((speeds > 0) & (growth > 0), speeds, jnp.inf).min()


def _highest_downward(matrices: BicycleMatrices, speeds: Float[Array, " crossings"]) -> Scalar:
    """The highest of the speeds with two opposite eigenvalues where these are +-i omega and their real part falls."""
    frequencies = jax.vmap(lambda v: _pair_frequency(matrices, v))(speeds)
    growth = jax.vmap(lambda s, v: _growth(matrices, s, v))(1j * frequencies, speeds).real
    return jnp.where((speeds > 0) & (growth < 0), speeds, -jnp.inf).max()


def _pair_frequency(matrices: BicycleMatrices, v: Scalar) -> Scalar:
    """omega = sqrt(a1/a3) where +-i omega are eigenvalues; NaN, without derivative, where the two are real."""
    coefficients = characteristic_polynomial(matrices, v)
    a1, a3 = coefficients[1], coefficients[3]
    is_pair = a1 * a3 > 0
    squared = jnp.where(is_pair, a1, 1.0) / jnp.where(is_pair, a3, 1.0)
    return jnp.where(is_pair, jnp.sqrt(squared), jnp.nan)


def _zero_eigenvalue(v, matrices):
    return evaluate(speed_polynomials(matrices)[0], v**2)


def _opposite_eigenvalues(v, matrices):
    return evaluate(hurwitz_polynomial(speed_polynomials(matrices)), v**2)


def _coincident_eigenvalues(s_and_v, matrices):
    """p and dp/ds, both zero at a double root."""
    coefficients = characteristic_polynomial(matrices, s_and_v[1])
    return jnp.stack([evaluate(coefficients, s_and_v[0]), evaluate(_first_derivative(coefficients), s_and_v[0])])


def _polished(residual, guess: Scalar, matrices: BicycleMatrices) -> Scalar:
    """The root near `guess`, differentiable; NaN where `guess` is not finite."""
    return _root(residual, guess[None], matrices, jnp.isfinite(guess))[0]


def _root(residual, guess: Float[Array, " n"], matrices: BicycleMatrices, present) -> Float[Array, " n"]:
    """x with `residual(x, matrices) = 0` near a bracketed `guess`; NaN where no root is `present`."""
    guess = jnp.where(present, guess, 1.0)
    # where there is no root, another function has one: no division by zero enters a batch's derivatives
    found = newton_root(lambda x: jnp.where(present, residual(x, matrices), x - guess), guess, 1.0 + jnp.abs(guess))
    return jnp.where(present, found.x, jnp.nan)


def _double_root(matrices: BicycleMatrices, fixed: BicycleMatrices, below: Scalar, top: Scalar) -> tuple[Scalar, Scalar]:
    """Eigenvalue (1/s) and speed (m/s) where two positive real eigenvalues last become a pair at a speed < `below`."""
    candidates = _roots_in_speed(discriminant_polynomial(speed_polynomials(fixed)), top)
    small = 64 * jnp.sqrt(jnp.finfo(top.dtype).eps)  # 1e-6 in float64

    def examine(v):
        coefficients, slopes = _expand(fixed, v)
        first = _first_derivative(coefficients)
        bound = 1.0 + jnp.max(jnp.abs(first[:-1])) / jnp.abs(first[-1])  # Cauchy: no root of dp/ds lies beyond it
        extrema = real_roots(list(first), jnp.zeros_like(v), bound)
        # |p| over the sum of its terms: at a double root an extremum of p touches the axis.
        height = jnp.abs(evaluate(coefficients, extrema)) / evaluate(jnp.abs(coefficients), extrema)
        height = jnp.where(extrema > 0, height, jnp.inf)
        s = extrema[jnp.argmin(height)]
        # 0 = p_ss ds^2 / 2 + p_v dv: a pair above v where p_ss and p_v have one sign.
        becomes_pair = evaluate(slopes, s) * evaluate(_first_derivative(first), s) > 0
        return s, (height.min() < small) & becomes_pair & (v > 0) & (v < below)

    roots, merges = jax.vmap(examine)(candidates)
    chosen = jnp.argmax(jnp.where(merges, candidates, -jnp.inf))
    present = merges[chosen]
    s, v = _root(_coincident_eigenvalues, jnp.stack([roots[chosen], candidates[chosen]]), matrices, present)
    return s, v


def _widest_stable_range(matrices: BicycleMatrices, crossings: Float[Array, " crossings"], top: Scalar) -> tuple[Scalar, Scalar]:
    """The widest interval between neighbouring crossings where all eigenvalues decay; NaN if there is none."""
    ends = jnp.concatenate([jnp.zeros_like(top)[None], crossings, top[None]])
    ends = jnp.sort(jnp.where(jnp.isnan(ends), top, ends))
    middles = 0.5 * (ends[:-1] + ends[1:])
    a0, a1, a2, a3, a4 = jax.vmap(lambda v: characteristic_polynomial(matrices, v))(middles).T
    # Lienard & Chipart: a0, a1, a3, a4 and the third Hurwitz determinant positive.
    stable = (a0 > 0) & (a1 > 0) & (a3 > 0) & (a4 > 0) & (a1 * a2 * a3 - a4 * a1**2 - a0 * a3**2 > 0)
    widths = jnp.where(stable, ends[1:] - ends[:-1], 0.0)
    widest = jnp.argmax(widths)
    exists = widths[widest] > 0
    return jnp.where(exists, ends[widest], jnp.nan), jnp.where(exists, ends[widest + 1], jnp.nan)
