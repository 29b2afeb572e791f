"""Energy-preserving integrator: a discrete gradient in the reduced, almost-Poisson form of a nonholonomic
scene.

The state is minimal: z = (q, y) with y the independent speeds; H(z) = T + V = y' m(q) y/2 + V(q);
qdot = W(q) y. The rates are a skew matrix S times grad H:

    qdot =  W m^-1 H_y                                        m = H_yy
    ydot = -m^-1 W' H_q + m^-1 G m^-1 H_y                     G(q, y) skew: G y = r,  r = m ydot + W' H_q

r is quadratic in y and does no work, y.r = 0, so G = (r_y - r_y')/3. S follows from the rates by automatic
differentiation, whatever the reduction. One step uses S at the midpoint and Gonzalez's discrete gradient
instead of grad H, so that H(z_1) - H(z_0) = gbar.(z_1 - z_0) = 0:

    z_1 - z_0 = h S(z_m) gbar,   z_m = (z_0 + z_1)/2
    gbar = grad H(z_m) + (H(z_1) - H(z_0) - grad H(z_m).(z_1 - z_0)) (z_1 - z_0)/|z_1 - z_0|^2
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jourdain_jax.calculus.roots import newton_root
from jourdain_jax.dynamics.reactions import needs_work
from jourdain_jax.equations.rows import names_of_position_rows
from jourdain_jax.equations.virtual_power import energies_at
from jourdain_jax.integrate.implicit_steps import FixedStepMethod, Solution, sizes
from jourdain_jax.integrate.vector_fields.field import Instant, Integrated, VectorField
from jourdain_jax.scene.scene import Scene
from jourdain_jax.structure.structure import structure_of


class DiscreteGradient(FixedStepMethod):
    """Energy-preserving discrete-gradient method in reduced form: `simulate(...,
    solver=DiscreteGradient(step=h))` with h in s.

    Let z = (q, y) with y the independent speeds, and write the rates as `zdot = S(z) grad H(z)` with S skew
    and H = T + V. A step is `z_1 - z_0 = h S(z_m) gbar`, where z_m = (z_0 + z_1)/2 and gbar is Gonzalez's
    discrete gradient of H. The method has order 2 and is symmetric in time. T + V is constant to round-off,
    and velocity constraints hold exactly. Unlike a projection onto constant energy after each step, the
    method is symmetric and does not disturb other integrals.

    It needs a minimal state and a constant T + V: constraints linear and homogeneous in the speeds, loads
    with potentials, no explicit time dependence, and no geometric constraints.

    Use it for long motions of conservative scenes in which a drift of the energy would change the result.
    Other integrals are preserved only to the order of the method, and a step costs more than with other
    methods.

    Source: E. Celledoni, M. Farre Puiggali, E. H. Hoiseth and D. Martin de Diego, Energy-preserving
    integrators applied to nonholonomic systems, J. Nonlinear Sci. 29 (2019) 1523, arXiv 1605.02845; O.
    Gonzalez, Time integration and discrete Hamiltonian systems, J. Nonlinear Sci. 6 (1996) 449.
    """

    def fitted(self, scene: Scene, field: VectorField, asked: str) -> VectorField:
        """Return `field`. Raises ValueError if the scene has no constant energy, or if the field has no
        minimal state. `asked`: the requested state.
        """
        fault = _fault(scene, field, asked)
        if fault:
            raise ValueError(
                f"`DiscreteGradient` does not apply to `{type(scene).__name__}`: {fault}; use "
                "solver=jj.ImplicitMidpoint(step=...)"
            )
        return field

    def solve(self, args: tuple, t, y: Integrated, h) -> Solution:
        """Return the change of the state `y` at `t` in a step `h` (s). `args`: as in `integrands.py`."""
        return _solved(args, args[4] + t + h / 2, jnp.asarray(h, y.q.dtype), y)


@eqx.filter_jit  # traced once
def _solved(args, t, h, y: Integrated) -> Solution:
    n, z0 = y.q.shape[0], jnp.concatenate([y.q, y.v])
    H0 = _energy(args, t, z0, n)
    guess = h * jnp.concatenate(_rates(args, t, y.q, y.v))
    found = newton_root(lambda d: _residual(args, t, h, n, z0, H0, d), guess, sizes(len(z0), z0, guess))
    change = jnp.where(found.converged, found.x, 0.0)
    return Solution(
        Integrated(change[:n], change[n:], jax.tree.map(jnp.zeros_like, y.work)), None, found.converged
    )


@eqx.filter_jit  # traced once, and differentiated from that trace
def _residual(args, t, h, n: int, z0, H0, d) -> Float[Array, "state"]:
    """Return `d - h S(z_m) gbar`, d = z_1 - z_0."""
    z = z0 + d / 2
    gradient, squared = jax.grad(lambda z: _energy(args, t, z, n))(z), d @ d
    excess = _energy(args, t, z0 + d, n) - H0 - gradient @ d
    gbar = gradient + jnp.where(squared > 0, excess / jnp.where(squared > 0, squared, 1.0), 0.0) * d
    return d - h * _skew_times(args, t, z[:n], z[n:], gbar)


def _skew_times(args, t, q, v, gbar) -> Float[Array, "state"]:
    """Return `S(q, v) gbar`."""
    n = q.shape[0]
    W = jax.jacfwd(lambda v: _rates(args, t, q, v)[0])(v)

    def H_v(v):
        return jax.grad(lambda v: _energy(args, t, jnp.concatenate([q, v]), n))(v)

    m = jax.jacfwd(H_v)(v)

    def r(v):
        # m ydot + W' H_q, in which the potential cancels
        return m @ _rates(args, t, q, v)[1] + W.T @ jax.grad(
            lambda q: _energy(args, t, jnp.concatenate([q, v]), n)
        )(q)

    velocity = jnp.linalg.solve(m, gbar[n:])  # m^-1 gbar_y
    J = jax.jacfwd(r)(v)
    turning = (J - J.T) @ velocity / 3  # G m^-1 gbar_y
    return jnp.concatenate([W @ velocity, jnp.linalg.solve(m, turning - W.T @ gbar[:n])])


@eqx.filter_jit
def _rates(args, t, q, v):
    field, scene, inputs, fixed, _ = args
    found = field.rates(Instant(scene, fixed, t, Integrated(q, v, None), field.now(inputs, t)))
    return found.q, found.v


@eqx.filter_jit
def _energy(args, t, z, n: int) -> Float[Array, ""]:
    """Return `H = T + V` in J."""
    field, scene, inputs, fixed, _ = args
    return sum(
        energies_at(scene, field.motion(Instant(scene, fixed, t, Integrated(z[:n], z[n:], None), inputs(t))))
    )


def _fault(scene: Scene, field: VectorField, asked: str) -> str:
    """Return why the method does not apply; empty if it does."""
    structure = structure_of(scene)
    if needs_work(scene, structure):
        return (
            "its T + V is not constant (loads without a potential, constraints that do work, or explicit time"
            " dependence)"
        )
    if names_of_position_rows(scene):
        return "its geometric constraints would need a projection after each step, which changes the energy"
    if field.independent is None:
        way_out = (
            ""
            if asked == "full" or not structure.affine
            else " (`jj.Formulation('minimal')` uses the independent speeds if the motion permits it)"
        )
        return f"all its speeds are integrated, but the method needs the minimal state{way_out}"
    return ""
