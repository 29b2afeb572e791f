"""Integrator by the discrete Lagrange-d'Alembert principle (DLA), as a map from (q_0, u_0) to (q_1, u_1).

    p^+ = -D_1 L_d(q_0, q_1) - f^-,   p^- = D_2 L_d(q_0, q_1) + f^+

    q_1, lambda_0:   dL/dqdot(q_0, u_0) + A(q_0)' lambda_0 = p^+,   phi_d(q_0, q_1) = 0
    u_1, lambda_1:   dL/dqdot(q_1, u_1) - A(q_1)' lambda_1 = p^-,   A(q_1) u_1 + phi_0 = 0

At a node, the momenta of the adjacent intervals differ only by a constraint impulse, p^+ - p^- = A' lambda.
These are the DLA equations D_1 L_d + D_2 L_d + f^- + f^+ = -A' lambda. Both momenta therefore have the same
projection onto the velocity constraints, which is the state between steps.

    v = (q_1 - q_0)/h,   q_m = (q_0 + q_1)/2
    midpoint:     L_d = h L(t_m, q_m, v),                         f^- = f^+ = h/2 Q(t_m, q_m, v)
    trapezoidal:  L_d = h/2 (L(t_0, q_0, v) + L(t_1, q_1, v)),    f^- = h/2 Q(t_0, q_0, v)
                                                                  f^+ = h/2 Q(t_1, q_1, v)
    constraints:  phi_d = phi at the midpoint, or its mean over both ends; g(t_1, q_1)/h for geometric ones

L = T - V - dS/dt, with S the scene's `gauge`; Q the loads without a potential. Both rules are symmetric:
L_d(q_0, q_1, h) = -L_d(q_1, q_0, -h).
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jourdain_jax.calculus.reals import PerRow, Scalar, Speeds, static
from jourdain_jax.calculus.roots import newton_root
from jourdain_jax.equations.kinematics import motion_at, partial_velocities, pose_at, speeds_are_rates
from jourdain_jax.equations.rows import names_of_position_rows, position_residual, velocity_residual
from jourdain_jax.equations.virtual_power import energies_at, on_speeds, resultants
from jourdain_jax.integrate.implicit_steps import FixedStepMethod, Solution, sizes
from jourdain_jax.integrate.vector_fields.by_matrices import full_without_projection
from jourdain_jax.integrate.vector_fields.field import Instant, Integrated, VectorField
from jourdain_jax.scene.coordinates import nearest
from jourdain_jax.scene.scene import Scene
from jourdain_jax.scene.user_methods import gauge_of, loads_of
from jourdain_jax.structure.structure import Structure, structure_of

RULES = ("midpoint", "trapezoidal")


def lagrangian(scene: Scene, t, q, u, inputs) -> Scalar:
    """Return `L = T - V - dS/dt` in J, for speeds that are the coordinate rates; S is the scene's gauge."""
    T, V = energies_at(scene, motion_at(scene, t, q, u, inputs))
    if gauge_of(scene, pose_at(scene, t, q)) is None:
        return T - V
    return (
        T - V - jax.jvp(lambda t, q: gauge_of(scene, pose_at(scene, t, q)), (t, q), (jnp.ones_like(t), u))[1]
    )


def momentum(scene: Scene, t, q, u, inputs) -> Speeds:
    """Return `dL/dqdot`, kg m/s or kg m^2/s."""
    return jax.grad(lambda u: lagrangian(scene, t, q, u, inputs))(u)


class Interval(eqx.Module):
    """Time interval of one step, and the quadrature rule."""

    t0: Scalar
    h: Scalar  # length, s
    rule: str = static()

    @property
    def t1(self) -> Scalar:
        """Return the end of the interval."""
        return self.t0 + self.h

    def mean(self, f: Callable, q0, q1):
        """Return the mean of `f(t, q, v)` over the interval, by the rule."""
        v = (q1 - q0) / self.h
        if self.rule == "midpoint":
            return f((self.t0 + self.t1) / 2, (q0 + q1) / 2, v)
        return (f(self.t0, q0, v) + f(self.t1, q1, v)) / 2


def discrete_momenta(scene: Scene, over: Interval, q0, q1, inputs: Callable):
    """Return the momenta of the unconstrained motion: `p^+ = -D_1 L_d - f^-` at the beginning of the interval
    and `p^- = D_2 L_d + f^+` at its end.
    """

    def L_d(q0, q1) -> Scalar:  # J s
        return over.h * over.mean(lambda t, q, v: lagrangian(scene, t, q, v, inputs(t)), q0, q1)

    d0, d1 = jax.grad(L_d, argnums=(0, 1))(q0, q1)
    # known even while tracing
    loads = loads_of(scene, motion_at(scene, over.t0, q0, jnp.zeros_like(q0)))
    if all(load.potential is not None for load in loads):
        return -d0, d1
    v, half = (q1 - q0) / over.h, over.h / 2
    if over.rule == "midpoint":
        t, q = (over.t0 + over.t1) / 2, (q0 + q1) / 2
        force = half * _force(scene, t, q, v, inputs(t))
        return -d0 - force, d1 + force
    return -d0 - half * _force(scene, over.t0, q0, v, inputs(over.t0)), d1 + half * _force(
        scene, over.t1, q1, v, inputs(over.t1)
    )


def discrete_rows(scene: Scene, over: Interval, q0, q1, inputs: Callable, geometric: int) -> PerRow:
    """Return all constraint residuals over the interval. The first `geometric` ones are `g(t_1, q_1)/h`, so
    that the geometric constraints hold at every node.
    """
    rows = over.mean(lambda t, q, v: velocity_residual(scene, t, q, v, inputs(t)), q0, q1)
    return rows if geometric == 0 else rows.at[:geometric].set(position_residual(scene, over.t1, q1) / over.h)


def _force(scene: Scene, t, q, u, inputs) -> Speeds:
    """Return `Q = sum beta' F + gamma' L + Q_direct` of the loads without a potential."""
    motion, partial = motion_at(scene, t, q, u, inputs), partial_velocities(scene, t, q, u)
    loads = resultants(scene, motion, conservative=False)
    orientation = jnp.stack([body.orientation for body in motion.bodies.values()])
    torque = jnp.einsum("bji,bj->bi", orientation, loads.torque)  # body axes, as gamma
    return on_speeds(partial, loads.force, torque) + loads.direct


class DiscreteLagrangeDAlembert(FixedStepMethod):
    """Nonholonomic integrator by the discrete Lagrange-d'Alembert principle: `simulate(...,
    solver=DiscreteLagrangeDAlembert(step=h))` with h in s.

    The equations are `D_1 L_d(q_k, q_k+1) + D_2 L_d(q_k-1, q_k) = -A(q_k)' lambda` with discrete constraints
    `phi_d(q_k, q_k+1) = 0`. The discrete Lagrangian L_d follows from the scene's Lagrangian L = T - V - dS/dt
    (S: its `gauge`) by a quadrature `rule`: "midpoint", `L_d = h L((q_0 + q_1)/2, (q_1 - q_0)/h)`, or
    "trapezoidal", `L_d = h/2 (L(q_0, v) + L(q_1, v))`, v = (q_1 - q_0)/h. The same rule applies to velocity
    constraints. Geometric constraints hold at every node. Loads without a potential enter as discrete forces.
    The state between steps is (q, u), where u is the momentum at the node, projected onto the constraints.

    The method has order 2 and is symmetric in time. Without velocity constraints it is variational, hence
    symplectic, and preserves the momenta of symmetries. It needs speeds that are the coordinate rates, and
    constraints linear or affine in them.

    Use it for long motions of reversible scenes whose coordinates suit L: energy errors then stay bounded. If
    the scene is not reversible, the energy drifts. A gauge term does not change the equations of motion, but
    may also make the energy drift. The implicit midpoint rule does not depend on the gauge.

    Source: J. Cortes and S. Martinez, Nonholonomic integrators, Nonlinearity 14 (2001) 1365; R. McLachlan and
    M. Perlmutter, J. Nonlinear Sci. 16 (2006) 283; J. E. Marsden and M. West, Discrete mechanics and
    variational integrators, Acta Numerica 10 (2001) 357, sections 2.1 and 3.2 (forces).
    """

    rule: str = static(default="midpoint")

    def __check_init__(self):
        if self.rule not in RULES:
            raise ValueError(
                f"unknown rule `{self.rule}` of `DiscreteLagrangeDAlembert`; {nearest(str(self.rule), RULES)}"
            )

    def fitted(self, scene: Scene, field: VectorField, asked: str) -> VectorField:
        """Return the field with the full state and without projection, because the method itself satisfies
        the constraints. Raises ValueError if the method does not apply to the scene, or if the minimal state
        was requested (`asked`).
        """
        structure, name = structure_of(scene), type(scene).__name__
        fault = _fault(scene, structure)
        if fault:
            raise ValueError(
                f"`DiscreteLagrangeDAlembert` does not apply to `{name}`: {fault}; use "
                "solver=jj.ImplicitMidpoint(step=...)"
            )
        if asked == "minimal":
            raise ValueError(
                "`DiscreteLagrangeDAlembert` integrates all speeds; leave the `state` of "
                "its `Formulation` at 'auto'"
            )
        equations = f"discrete Lagrange-d'Alembert equations, {self.rule} rule"
        return full_without_projection(field, scene, equations)

    def solve(self, args: tuple, t, y: Integrated, h) -> Solution:
        """Return the change of the state `y` at `t` in a step `h` (s). `args`: as in `integrands.py`."""
        return _solved(args, Interval(args[4] + t, h, self.rule), y)


@eqx.filter_jit  # traced once
def _solved(args, over: Interval, y: Integrated) -> Solution:
    _, scene, inputs, *_ = args
    q0, u0, h = y.q, y.v, over.h
    n = q0.shape[0]
    A0 = jax.jacfwd(lambda u: _kept(scene, velocity_residual(scene, over.t0, q0, u, inputs(over.t0))))(u0)
    p0 = momentum(scene, over.t0, q0, u0, inputs(over.t0))
    guess = jnp.concatenate([h * u0, jnp.zeros(A0.shape[0], q0.dtype)])
    # impulses follow from coordinates, so convergence is tested for coordinates only
    scale = jnp.where(jnp.arange(len(guess)) < n, sizes(len(guess), q0, h * u0), jnp.inf)
    found = newton_root(lambda x: _residual(args, over, q0, p0, A0, x), guess, scale)
    q1 = q0 + found.x[:n]
    u1 = _projected(args, over, q0, q1)
    solved = found.converged & jnp.all(jnp.isfinite(u1))
    change = Integrated(found.x[:n], u1 - u0, _work(args, over, y, q1, u1))
    return Solution(jax.tree.map(lambda x: jnp.where(solved, x, 0.0), change), None, solved)


@eqx.filter_jit  # traced once, and differentiated from that trace
def _residual(args, over: Interval, q0, p0, A0, x) -> Float[Array, "unknowns"]:
    """Return `p^+ - p_0 - A_0' lambda` and the discrete constraints, for x = (q_1 - q_0, lambda)."""
    _, scene, inputs, *_ = args
    n = q0.shape[0]
    q1, impulse = q0 + x[:n], x[n:]
    p, _ = discrete_momenta(scene, over, q0, q1, inputs)
    rows = discrete_rows(scene, over, q0, q1, inputs, len(names_of_position_rows(scene)))
    return jnp.concatenate([p - p0 - A0.T @ impulse, _kept(scene, rows)])


def _projected(args, over: Interval, q0, q1) -> Speeds:
    """Return the speeds at the end of the interval that satisfy the constraints and whose momentum is p^- up
    to a constraint impulse.
    """
    _, scene, inputs, *_ = args
    t1, rest = over.t1, jnp.zeros_like(q1)
    _, p1 = discrete_momenta(scene, over, q0, q1, inputs)

    def level(u):
        here = (
            momentum(scene, t1, q1, u, inputs(t1)),
            _kept(scene, velocity_residual(scene, t1, q1, u, inputs(t1))),
        )
        return here, here

    (M, A), (b, phi) = jax.jacfwd(level, has_aux=True)(rest)
    K = jnp.block([[M, -A.T], [A, jnp.zeros((A.shape[0], A.shape[0]), M.dtype)]])
    return jnp.linalg.solve(K, jnp.concatenate([p1 - b, -phi]))[: q1.shape[0]]


def _kept(scene: Scene, rows: PerRow) -> Float[Array, "kept_rows"]:
    """Return the constraints that are not redundant everywhere."""
    return rows[np.array(structure_of(scene).kept_rows, int)]


def _fault(scene: Scene, structure: Structure) -> str:
    """Return why the principle does not apply; empty if it does."""
    if not speeds_are_rates(scene):
        return "its speeds are quasi-velocities or angular velocities, not the rates of its coordinates"
    if not structure.affine:
        return "its constraints are nonlinear in the speeds"
    if structure.varying_inertia:
        return "its masses or inertias change along the motion, so there is no Lagrangian"
    if structure.dependent_rows:
        return "its constraints are redundant, but no constraint can be omitted everywhere"
    return ""


def _work(args, over: Interval, y: Integrated, q1, u1):
    """Return the work of the step, by the midpoint rule."""
    if y.work is None:
        return None
    field, scene, inputs, fixed, _ = args
    t = (over.t0 + over.t1) / 2
    return (
        over.h
        * field.rates(
            Instant(scene, fixed, t, Integrated((y.q + q1) / 2, (y.v + u1) / 2, y.work), field.now(inputs, t))
        ).work
    )
