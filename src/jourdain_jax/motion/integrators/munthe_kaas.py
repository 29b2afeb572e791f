"""Runge-Kutta-Munthe-Kaas: any Runge-Kutta method, with attitudes advanced by the exponential map of unit quaternions.

    exp(sigma) = (cos(theta/2), sin(theta/2) sigma/theta),   theta = |sigma|           (a turn by the rotation vector sigma)
    p(t) = p_0 exp(sigma(t)),  pdot = 1/2 p (0, omega)   =>   sigmadot = omega + 1/2 sigma x omega + k sigma x (sigma x omega)
    k = (1 - (theta/2) cot(theta/2)) / theta^2

The method sees rotation vectors in place of quaternions, so that order and error estimate are its own. All coefficients are smooth functions of theta^2, by
series where it is small: sigma = 0 is where every step begins.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import ClassVar

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jourdain_jax.calculus.rotations import quaternion_product, quaternion_rate
from jourdain_jax.equations.listed import names_of_position_rows
from jourdain_jax.motion.integrators.implicit_midpoint import ImplicitMidpoint
from jourdain_jax.motion.integrators.wrapping_solver import WrappingSolver
from jourdain_jax.motion.vector_fields.field import Integrated, VectorField
from jourdain_jax.scene.scene import Scene


class MuntheKaas(WrappingSolver):
    """A Runge-Kutta `solver` with attitudes (quaternion coordinates) advanced by the exponential map: `simulate(..., solver=MuntheKaas())`.

    Within a step the attitude is `p_0 exp(sigma)`, a turn by the rotation vector sigma (rad), and the method integrates
    `sigmadot = omega + 1/2 sigma x omega + k sigma x (sigma x omega)`, `k = (1 - (theta/2) cot(theta/2))/theta^2`, theta = |sigma|; all other
    states as usual. Order and error estimate are those of `solver` (default: `diffrax.Tsit5()`; `diffrax.Dopri8()` below 1e-6), which may be any
    Runge-Kutta method of diffrax, or `ImplicitMidpoint()` for the symmetric Lie midpoint rule, which takes constant steps `dt0` (s).

    Norms stay 1 to round-off with no renormalisation, and a turn about a fixed axis is exact whatever the step. Worth it for fast spinning bodies,
    and where a projection after each step would spoil what a method keeps; otherwise the default, which renormalises, is faster.

    Source: H. Munthe-Kaas, High order Runge-Kutta methods on manifolds, Applied Numerical Mathematics 29 (1999) 115; A. Iserles, H. Munthe-Kaas, S. P.
    Norsett and A. Zanna, Lie-group methods, Acta Numerica 9 (2000) 215, section 2 and appendix B.
    """

    solver: diffrax.AbstractSolver = eqx.field(default_factory=diffrax.Tsit5)

    interpolation_cls: ClassVar[Callable] = diffrax.LocalLinearInterpolation  # states are saved at ends of steps only

    def __check_init__(self):
        if not isinstance(self.solver, diffrax.AbstractRungeKutta | ImplicitMidpoint):
            raise ValueError(
                f"`solver` of `MuntheKaas` is {type(self.solver).__name__}, expected a Runge-Kutta method; give diffrax.Tsit5(), diffrax.Dopri8() "
                "or jj.ImplicitMidpoint()"
            )

    def fitted(self, scene: Scene, field: VectorField, asked: str) -> VectorField:
        """The given `field` of the state, without a projection where there would be only norms to keep; whatever was `asked` for.

        ValueError where the `scene` has no attitude.
        """
        if not scene.coordinates.quaternions:
            raise ValueError(
                f"`MuntheKaas` advances attitudes, and `{type(scene).__name__}` has no quaternion among its coordinates; use "
                f"solver={type(self.solver).__name__}() by itself, or state the attitude with jj.quaternion(...)"
            )
        return replace(field, projects_positions=field.projects_positions and bool(names_of_position_rows(scene)))

    def init(self, terms, t0, t1, y0, args):
        """Nothing is carried from step to step: slopes belong to the rotation vectors of one step. `terms`, `t0`, `t1`, `y0`, `args`: as in diffrax."""
        return None

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        """One step of the wrapped solver in rotation vectors, then the exponential.

        `terms`, `t0`, `t1`, `y0`, `args`, `solver_state`, `made_jump`: as in diffrax.
        """
        chart = _Chart(y0.q, tuple(first for first, _ in args[1].coordinates.quaternions))
        direction = jnp.sign(terms.contr(t0, t1))

        def rates(t, local, args):
            there = terms.vf(t, Integrated(chart.coordinates(local.q), local.v, local.work), args)
            turning = Integrated(chart.rates(local.q, there.q), there.v, there.work)
            return jax.tree.map(lambda rate: direction.astype(rate.dtype) * rate, turning)

        local_terms, local0 = diffrax.ODETerm(rates), Integrated(chart.origin(), y0.v, y0.work)
        state = self.solver.init(local_terms, t0, t1, local0, args)
        local1, error, _, _, result = self.solver.step(local_terms, t0, t1, local0, args, state, False)
        y1 = Integrated(chart.coordinates(local1.q), local1.v, local1.work)
        error = None if error is None else Integrated(_Chart(y1.q, chart.firsts).pushed(error.q), error.v, error.work)
        return y1, error, {"y0": y0, "y1": y1}, None, result


class _Chart(eqx.Module):
    """Coordinates near `base`: those of each quaternion, from `firsts` on, by a rotation vector, which takes the first three of its four places."""

    base: Float[Array, "coordinates"]
    firsts: tuple[int, ...] = eqx.field(static=True)

    def origin(self) -> Float[Array, "coordinates"]:
        """The base itself: rotation vectors zero."""
        q = self.base
        for i in self.firsts:
            q = q.at[i : i + 4].set(0.0)
        return q

    def coordinates(self, local: Float[Array, "coordinates"]) -> Float[Array, "coordinates"]:
        """Quaternions in place of rotation vectors."""
        q = local
        for i in self.firsts:
            q = q.at[i : i + 4].set(quaternion_product(self.base[i : i + 4], quaternion_exponential(local[i : i + 3])))
        return q

    def rates(self, local: Float[Array, "coordinates"], qdot: Float[Array, "coordinates"]) -> Float[Array, "coordinates"]:
        """Rates of the local coordinates, given those of all coordinates."""
        q, rates = self.coordinates(local), qdot
        for i in self.firsts:
            backwards = q[i : i + 4] * jnp.array([1.0, -1.0, -1.0, -1.0], q.dtype)
            omega = 2 * quaternion_product(backwards, qdot[i : i + 4])[1:]  # pdot = 1/2 p (0, omega)
            rates = rates.at[i : i + 4].set(jnp.append(rotation_vector_rate(local[i : i + 3], omega), 0.0))
        return rates

    def pushed(self, small: Float[Array, "coordinates"]) -> Float[Array, "coordinates"]:
        """A small displacement of the local coordinates as one of the coordinates at the base."""
        q = small
        for i in self.firsts:
            q = q.at[i : i + 4].set(quaternion_rate(self.base[i : i + 4], small[i : i + 3]))
        return q


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
