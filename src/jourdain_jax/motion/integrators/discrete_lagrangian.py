"""A scene's discrete Lagrangian, discrete forces and discrete rows over one step, for the discrete Lagrange-d'Alembert principle.

    v = (q_1 - q_0)/h
    midpoint:     L_d = h L(t_m, q_m, v),                               f^-+ = h/2 Q(t_m, q_m, v)           q_m = (q_0 + q_1)/2
    trapezoidal:  L_d = h/2 (L(t_0, q_0, v) + L(t_1, q_1, v)),          f^- = h/2 Q(t_0, q_0, v), f^+ = h/2 Q(t_1, q_1, v)
    rows:         phi at the midpoint, or the mean of phi at both ends; of geometric rows g(t_1, q_1)/h

L = T - V - dS/dt, with S the scene's `gauge`; Q the loads that have no potential. Both rules are symmetric: L_d(q_0, q_1, h) = -L_d(q_1, q_0, -h).
Source: J. Cortes and S. Martinez, Nonholonomic integrators, Nonlinearity 14 (2001) 1365; J. E. Marsden and M. West, Discrete mechanics and
variational integrators, Acta Numerica 10 (2001) 357, sections 2.1 and 3.2 (forces).
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jourdain_jax.equations.kinematics import motion_at, partial_velocities, pose_at
from jourdain_jax.equations.rows import position_residual, velocity_residual
from jourdain_jax.equations.virtual_power import energies_at, resultants
from jourdain_jax.scene.scene import Scene
from jourdain_jax.scene.validated import gauge_of, loads_of

RULES = ("midpoint", "trapezoidal")


def lagrangian(scene: Scene, t, q, u, inputs=None) -> Float[Array, ""]:
    """`L = T - V - dS/dt` in J, for speeds that are the coordinate rates; S is the scene's gauge."""
    T, V = energies_at(scene, motion_at(scene, t, q, u, inputs))
    if gauge_of(scene, pose_at(scene, t, q)) is None:
        return T - V
    return T - V - jax.jvp(lambda t, q: gauge_of(scene, pose_at(scene, t, q)), (t, q), (jnp.ones_like(t), u))[1]


def momentum(scene: Scene, t, q, u, inputs=None) -> Float[Array, "speeds"]:
    """`dL/dqdot`, kg m/s or kg m^2/s."""
    return jax.grad(lambda u: lagrangian(scene, t, q, u, inputs))(u)


class Interval(eqx.Module):
    """The span of one step, and the rule by which it is seen."""

    t0: Float[Array, ""]
    h: Float[Array, ""]  # its length, s
    rule: str = eqx.field(static=True)

    @property
    def t1(self) -> Float[Array, ""]:
        """Its end."""
        return self.t0 + self.h

    def mean(self, f: Callable, q0, q1):
        """The mean of `f(t, q, v)` over the interval, by the rule."""
        v = (q1 - q0) / self.h
        if self.rule == "midpoint":
            return f((self.t0 + self.t1) / 2, (q0 + q1) / 2, v)
        return (f(self.t0, q0, v) + f(self.t1, q1, v)) / 2


def discrete_lagrangian(scene: Scene, over: Interval, q0, q1, inputs: Callable) -> Float[Array, ""]:
    """`L_d(q_0, q_1)` in J s."""
    return over.h * over.mean(lambda t, q, v: lagrangian(scene, t, q, v, inputs(t)), q0, q1)


def discrete_momenta(scene: Scene, over: Interval, q0, q1, inputs: Callable):
    """`p^+ = -D_1 L_d - f^-` at the beginning and `p^- = D_2 L_d + f^+` at the end of the interval: what free motion would leave with."""
    d0, d1 = jax.grad(lambda q0, q1: discrete_lagrangian(scene, over, q0, q1, inputs), argnums=(0, 1))(q0, q1)
    if not _has_forces(scene, over.t0, q0):
        return -d0, d1
    v, half = (q1 - q0) / over.h, over.h / 2
    if over.rule == "midpoint":
        t, q = (over.t0 + over.t1) / 2, (q0 + q1) / 2
        force = half * _force(scene, t, q, v, inputs(t))
        return -d0 - force, d1 + force
    return -d0 - half * _force(scene, over.t0, q0, v, inputs(over.t0)), d1 + half * _force(scene, over.t1, q1, v, inputs(over.t1))


def discrete_rows(scene: Scene, over: Interval, q0, q1, inputs: Callable, geometric: int) -> Float[Array, "rows"]:
    """All rows over the interval; the first `geometric` ones as `g(t_1, q_1)/h`, which so hold at every node."""
    rows = over.mean(lambda t, q, v: velocity_residual(scene, t, q, v, inputs(t)), q0, q1)
    return rows if geometric == 0 else rows.at[:geometric].set(position_residual(scene, over.t1, q1) / over.h)


def _has_forces(scene: Scene, t, q) -> bool:
    """Whether any load has no potential: known while tracing."""
    return any(load.potential is None for load in loads_of(scene, motion_at(scene, t, q, jnp.zeros_like(q))))


def _force(scene: Scene, t, q, u, inputs) -> Float[Array, "speeds"]:
    """`Q = sum beta' F + gamma' L + Q_direct` of the loads without a potential."""
    motion, partial = motion_at(scene, t, q, u, inputs), partial_velocities(scene, t, q, u)
    loads = resultants(scene, motion, conservative=False)
    orientation = jnp.stack([body.orientation for body in motion.bodies.values()])
    torque = jnp.einsum("bji,bj->bi", orientation, loads.torque)  # body axes, as gamma
    return jnp.einsum("bik,bi->k", partial.linear, loads.force) + jnp.einsum("bik,bi->k", partial.angular, torque) + loads.direct
