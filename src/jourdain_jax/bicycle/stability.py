"""Eigenvalues of the linear bicycle, and the speeds at which its stability changes.

    M q'' + v C1 q' + (g K0 + v^2 K2) q = 0,   q = (lean, steer)
    p(s; v) = det(s^2 + M^-1 (s v C1 + g K0 + v^2 K2)) = s^4 + a3 s^3 + a2 s^2 + a1 s + a0

With x = v^2, the coefficients are a3 = v b3, a2 = b2(x), a1 = v b1(x), a0 = b0(x). Stability changes at roots
of polynomials in x (omega^2 = b1/b3):

    where an eigenvalue is zero             b0 = 0
    where two eigenvalues sum to zero       b1 b2 b3 - b1^2 - b0 b3^2 = 0     (+-i omega if b1/b3 > 0)
    where two eigenvalues coincide          4 D0^3 - D1^2 = 0, with
        D0 = b2^2 - 3 x b3 b1 + 12 b0,
        D1 = 2 b2^3 - 9 x b3 b2 b1 + 27 x b3^2 b0 + 27 x b1^2 - 72 b2 b0

All positive roots are found and refined by Newton's method, whose last steps also give derivatives. Counts
of growing modes between neighbouring roots show what changes at a root. Coefficients are ordered from the
lowest power.

M, C1, K0 and K2 come from the nonlinear model, linearised about upright straight running at rest and at one
speed. The tests check that C is proportional to v, and that K is affine in v^2.

Source: Meijaard, Papadopoulos, Ruina & Schwab, Proc. R. Soc. A 463 (2007), sections 6-8; Hurwitz determinant
(Orlando) and discriminant are textbook.

`interval` gives limits of quantities that depend on the parameters, by a Monte Carlo method. Parameters are
drawn from a normal distribution with the measured values and their covariance, or
independently if the covariance is unknown, as from parameter files. If only some samples have a quantity,
such as a capsize speed, their fraction is reported, and the limits refer to them.
"""

from collections.abc import Mapping
from functools import reduce
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike
from jaxtyping import Bool, Complex, Float, Key, UInt32

from jourdain_jax.analysis.linearize import companion, linearize, sorted_eigenvalues
from jourdain_jax.bicycle.parameter_files import MeasuredBicycle
from jourdain_jax.bicycle.parameters import PARAMETER_NAMES, violations
from jourdain_jax.calculus.compilation import compiled_quickly
from jourdain_jax.calculus.reals import Flag, Number, Scalar, real_type
from jourdain_jax.integrate.state import State, state_of
from jourdain_jax.models.whipple_bicycle import WhippleBicycle

_SPEED = 4.0  # physics, m/s: of the second linearisation
_DEPENDENT = ("pitch",)
Given = Float[ArrayLike, "2 2"]
Square = Float[Array, "2 2"]
UnitMass = tuple[Square, Square, Square, Scalar]  # C1, K0, K2 multiplied by M^-1, and g
Polynomial = Float[Array, " coefficients"]


class BicycleMatrices(NamedTuple):
    """The matrices of the linear bicycle, which unpack into arguments: `stability_speeds(*matrices)`."""

    M: Square  # kg m^2
    C1: Square  # kg m
    K0: Square  # kg m
    K2: Square  # kg
    g: Scalar  # m/s^2


class StabilitySpeeds(eqx.Module):
    """The speeds at which a bicycle's stability changes, m/s; NaN for a speed that does not exist up to the
    largest speed examined. For eigenvalues at these speeds use `eigenvalues` or `jj.critical`.
    """

    weave_speed: Scalar  # lean and steer oscillations decay above it
    capsize_speed: Scalar  # a slow fall to one side grows above it
    double_root_speed: Scalar  # the two unstable real eigenvalues are the weave pair above it
    stable_from: Scalar  # start of the widest range of speeds with four decaying modes (no derivative)
    stable_to: Scalar  # end of this range, at most the largest speed examined (no derivative)
    stable_range_exists: Flag


def upright_running(bicycle: WhippleBicycle, speed: Number, lean_rate: Number = 0.0) -> State:
    """Return the state of upright straight running at `speed` (m/s), a steady motion if `lean_rate` (rad/s)
    is zero. The state satisfies the constraints exactly.
    """
    q, u, _ = bicycle.named(**bicycle.upright(speed), lean_rate=lean_rate)
    return state_of(bicycle, 0.0, q, u)


def linear_matrices(values: Mapping[str, float | Scalar]) -> BicycleMatrices:
    """Return M, C1, K0, K2 (2x2, in lean and steer) and g from the 26 parameters by name. Works under jit and
    vmap.
    """
    return _matrices({name: jnp.asarray(value) for name, value in values.items()})


@compiled_quickly  # the first call takes 10 s of processor time instead of 23, and the second 6 ms
def _matrices(values: dict[str, Scalar]) -> BicycleMatrices:
    bicycle = WhippleBicycle.from_values(values)

    def at(speed):
        small = linearize(bicycle, upright_running(bicycle, speed), ("lean", "steer"), dependent=_DEPENDENT)
        return small.M, small.C, small.K

    M, C, K = jax.vmap(at)(jnp.array([0.0, _SPEED]))
    return BicycleMatrices(M[0], C[1] / _SPEED, K[0] / bicycle.g, (K[1] - K[0]) / _SPEED**2, bicycle.g)


def eigenvalues(
    M: Given, C1: Given, K0: Given, K2: Given, g: ArrayLike, speeds: Float[ArrayLike, " speeds"]
) -> Complex[Array, "speeds 4"]:
    """Return the four eigenvalues (1/s) at each speed (m/s), in the order castering, capsize, weave, weave.

    The modes are named in the order of ascending real parts (at rest: two decaying, then two growing real
    eigenvalues). If real eigenvalues lie on both sides of a complex pair, the lower one is castering, the
    higher one capsize, and the pair is weave. The eigenvalue of a pair with negative frequency comes first.
    """
    matrices = _of_unit_mass(M, C1, K0, K2, g)
    values = jax.vmap(lambda v: _eigenvalues(matrices, v))(jnp.asarray(speeds, real_type()))
    lowest, low, high, highest = (values.imag != 0).T
    pair_between = low & high & ~lowest & ~highest
    return jnp.where(pair_between[:, None], values[:, np.array([0, 3, 1, 2])], values)


def _eigenvalues(matrices: UnitMass, v: Scalar) -> Complex[Array, " 4"]:
    C1, K0, K2, g = matrices
    return sorted_eigenvalues(companion(-jnp.concatenate([g * K0 + v**2 * K2, v * C1], axis=1)))


def stability_speeds(
    M: Given, C1: Given, K0: Given, K2: Given, g: ArrayLike, *, max_speed: ArrayLike = 50.0
) -> StabilitySpeeds:
    """Return weave, capsize and double-root speed of one bicycle, differentiable in the matrices and g.

        speeds = stability_speeds(M, C1, K0, K2, 9.81)
        jax.vmap(stability_speeds)(*many)  # a leading axis on each of the five, g included

    As v grows, a complex pair crosses into the left half-plane at the weave speed. The capsize speed is the
    lowest one at which a real eigenvalue becomes positive. The double-root speed is the highest one, below
    the weave speed if there is one, at which two positive real eigenvalues become a complex pair.

    **Arguments:** `M`, `C1`, `K0`, `K2`, (2, 2) in the order lean, steer; `g` (m/s^2); `max_speed`, the
    largest speed (m/s) examined. **Returns:** a `StabilitySpeeds`. Derivatives follow from the implicit
    function theorem; a speed that does not exist is NaN with derivative zero.
    """
    matrices = _of_unit_mass(M, C1, K0, K2, g)
    return _speeds(matrices, jax.lax.stop_gradient(jnp.asarray(max_speed, real_type())))


@compiled_quickly
def _speeds(matrices: UnitMass, top: Scalar) -> StabilitySpeeds:
    # one call for all roots, then one for all eigenvalues: with jaxlib 0.10, two batched LAPACK calls at the
    # same time can wait for each other forever on two threads
    x, there = (found.ravel() for found in jax.vmap(_roots, (0, None))(_in_speed(matrices), top**2))
    v, kind = jnp.sqrt(jnp.where(there, x, top**2)), np.repeat(range(3), len(x) // 3)

    @jax.vmap
    def between(v):
        """Return the ends of the intervals between speeds, and the eigenvalues within each interval."""
        ends = jnp.sort(jnp.hstack([0.0, jax.lax.stop_gradient(v), top]))[:12]  # 0, at most ten speeds, top
        at = lambda v: _eigenvalues(jax.lax.stop_gradient(matrices), v)
        return ends, jax.vmap(at)((ends[:-1] + ends[1:]) / 2)

    (ends, of_range), (values, in_range) = between(jnp.stack([v, jnp.where(kind < 2, v, top)]))
    more_reals, more_pairs = (
        jnp.diff(jnp.sum((values.real > 0) & of_kind, axis=1))[jnp.searchsorted(ends, v) - 1]
        for of_kind in (values.imag == 0, values.imag != 0)
    )
    only = lambda some: jnp.where(there & some, v, jnp.nan)
    weave = jnp.nanmax(only((kind == 1) & (more_pairs < 0)))
    widths = jnp.where(jnp.all(in_range.real < -1e-9, axis=1), jnp.diff(of_range), 0.0)
    k, exists = jnp.argmax(widths), jnp.max(widths) > 0
    return StabilitySpeeds(
        weave_speed=weave,
        capsize_speed=jnp.nanmin(only((kind == 0) & (more_reals > 0))),
        double_root_speed=jnp.nanmax(only((kind == 2) & (more_pairs > 0) & ~(v >= weave))),
        stable_from=jnp.where(exists, of_range[k], jnp.nan),
        stable_to=jnp.where(exists, of_range[k + 1], jnp.nan),
        stable_range_exists=exists,
    )


def _of_unit_mass(M, C1, K0, K2, g) -> UnitMass:
    """Return C1, K0 and K2, multiplied by `M^-1`, and g as arrays."""
    M, *others, g = (jnp.asarray(value, real_type()) for value in (M, C1, K0, K2, g))
    return *jnp.split(jnp.linalg.solve(M, jnp.concatenate(others, axis=1)), 3, axis=1), g


def _in_speed(matrices: UnitMass) -> Float[Array, "3 coefficients"]:
    """Return three polynomials in x (defined in the module docstring), padded to one length. They are zero if
    an eigenvalue is zero, if two eigenvalues sum to zero, and if two coincide.
    """
    one, x = np.eye(2, 7)
    # not `jnp.polymul`: its batch is a convolution with a group for each sample, and on CPUs the work for it
    # grows with the square of their number
    places = np.eye(13)[np.add.outer(range(7), range(7)), :7]
    times = lambda *factors: reduce(lambda a, b: jnp.einsum("i,j,ijk", a, b, places), factors)

    def mixed(A, B):  # det(A + B) - det A - det B
        of = lambda i, j, k, l: times(A[i, j], B[k, l])
        return of(0, 0, 1, 1) + of(1, 1, 0, 0) - of(0, 1, 1, 0) - of(1, 0, 0, 1)

    C1, K0, K2, g = (A[..., None] for A in matrices)
    C, K = C1 * one, g * K0 * one + K2 * x
    b3, b1, b0 = jnp.trace(C), mixed(C, K), mixed(K, K) / 2
    b2 = jnp.trace(K) + times(x, mixed(C, C)) / 2
    opposite = times(b1, b2, b3) - times(b1, b1) - times(b0, b3, b3)
    D0 = times(b2, b2) - 3 * times(x, b3, b1) + 12 * b0
    D1 = 2 * times(b2, b2, b2) - 9 * times(x, b3, b2, b1) - 72 * times(b2, b0)
    D1 += 27 * times(x, times(b3, b3, b0) + times(b1, b1))
    return jnp.stack([b0, opposite, 4 * times(D0, D0, D0) - times(D1, D1)])


def _roots(polynomial: Polynomial, top: Scalar) -> tuple[Float[Array, " degree"], Bool[Array, " degree"]]:
    """Return the positive real roots up to `top`, with first and second derivatives, and a mask of them.
    Entries outside the mask are 1.

    The inverses of the roots are computed, since the leading coefficients may vanish.
    """
    inverse = jnp.roots(jax.lax.stop_gradient(polynomial), strip_zeros=False)
    there = (inverse.imag == 0) & (inverse.real * top > 1)
    x, polynomial = jnp.where(there, 1 / jnp.where(there, inverse.real, 1.0), 1.0), polynomial[::-1]
    for _ in range(3):  # each of the last two steps adds one order of derivatives
        slope = jax.lax.stop_gradient(jnp.polyval(jnp.polyder(polynomial), x))
        x = x - jnp.polyval(polynomial, x) / jnp.where(there & (slope != 0), slope, jnp.inf)
    return x, there


class ParameterSamples(eqx.Module):
    """Sampled parameters of one bicycle, in SI units."""

    values: Float[Array, "samples parameters"]  # columns in the order of `PARAMETER_NAMES`
    physical: Bool[Array, " samples"]  # False for an impossible sample, such as one with a negative radius
    refused: dict[str, Array]  # violated condition, as a sentence -> number of samples

    def by_name(self) -> dict[str, Float[Array, " samples"]]:
        """Return one array of samples per parameter, for `jax.vmap` of a function of parameters by name."""
        return dict(zip(PARAMETER_NAMES, self.values.T, strict=True))


class Interval(eqx.Module):
    """A quantity with limits that contain 95 % of the samples with this quantity."""

    value: Scalar  # NaN if the bicycle lacks the quantity
    low: Scalar  # 2.5 % quantile, NaN if no sample has the quantity
    high: Scalar  # 97.5 % quantile
    fraction: Scalar  # share of the counted samples that have the quantity


def sample_parameters(
    bicycle: MeasuredBicycle, key: Key[Array, ""] | UInt32[Array, "2"], count: int
) -> ParameterSamples:
    """Return `count` bicycles drawn from a normal distribution with the measured values and their covariance.
    If the covariance is unknown, parameters are independent, with their sigmas.

        samples = sample_parameters(bicycle, jax.random.key(0), 2000)
        weave = jax.vmap(lambda parameters: ...)(samples.by_name())

    **Arguments:** `bicycle`; `key`, a JAX random key; `count`, number of samples. **Returns:** all samples.
    Impossible bicycles are marked (`physical`) and counted by violation (`refused`). **Raises** ValueError
    unless `count` is positive.
    """
    if count < 1:
        raise ValueError(
            f"`count` is {count}, expected at least 1 sample; 2000 samples give limits to about 0.1 sigma."
        )
    value = jnp.array([bicycle.values[name] for name in PARAMETER_NAMES])
    standard = jax.random.normal(key, (count, len(PARAMETER_NAMES)), value.dtype)
    values = value + standard @ jnp.asarray(_root(bicycle), value.dtype).T
    broken = violations(dict(zip(PARAMETER_NAMES, values.T, strict=True)))
    return ParameterSamples(
        values=values,
        physical=~jnp.any(jnp.stack(list(broken.values())), axis=0),
        refused={sentence: jnp.sum(where) for sentence, where in broken.items() if jnp.any(where)},
    )


def _root(bicycle: MeasuredBicycle) -> np.ndarray:
    """Return R with R R' the covariance, which may be singular."""
    sigma = np.array([bicycle.sigmas[name] for name in PARAMETER_NAMES])
    if bicycle.covariance is None:
        return np.diag(sigma)
    scale = np.where(sigma > 0, sigma, 1.0)  # correlations do not depend on units
    squares, directions = np.linalg.eigh(bicycle.covariance / np.outer(scale, scale))
    return scale[:, None] * directions * np.sqrt(np.maximum(squares, 0.0))


def interval(
    values: Float[Array, " samples"],
    *,
    nominal: ArrayLike | None = None,
    counted: Bool[Array, " samples"] | None = None,
) -> Interval:
    """Return limits of a sampled quantity over the samples in which it is finite.

    **Arguments:** `values`, one per sample, NaN if a sample lacks the quantity; `nominal`, the quantity of
    the bicycle as measured (default: the median of the samples); `counted`, False for samples to exclude,
    such as impossible ones. **Returns:** `value`, 2.5 % and 97.5 % quantiles, and the fraction of the counted
    samples that have the quantity.
    """
    counted = jnp.ones(values.shape, bool) if counted is None else counted
    has = counted & jnp.isfinite(values)
    present = jnp.where(has, values, jnp.nan)
    low, median, high = jnp.nanquantile(present, jnp.array([0.025, 0.5, 0.975], values.dtype))
    return Interval(
        value=median if nominal is None else jnp.asarray(nominal, values.dtype),
        low=low,
        high=high,
        fraction=jnp.sum(has) / jnp.maximum(jnp.sum(counted), 1),
    )
