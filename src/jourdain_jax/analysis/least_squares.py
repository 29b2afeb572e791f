"""Levenberg-Marquardt for residuals that are expensive: one simulation with all its derivatives per step tried.

minimise |r(z)|^2 / 2:   (J'J + lambda 1) dz = -J' r,   J = dr/dz by forward mode
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int, PyTree


class LeastSquaresSolution(eqx.Module):
    """Where the minimisation ended."""

    z: Float[Array, "unknowns"]
    residual: Float[Array, "samples"]
    jacobian: Float[Array, "samples unknowns"]  # NaN where the residuals are not finite
    converged: Bool[Array, ""]
    steps: Int[Array, ""]  # tried


def least_squares(
    residual: Callable, z0: Float[Array, "unknowns"], args: PyTree, *, tolerance: float | Float[Array, ""], max_steps: int
) -> LeastSquaresSolution:
    """Minimise `|residual(z, args)|^2` from z0.

    `tolerance`: converged when a step changes z and the residuals by less than `tolerance (1 + largest magnitude)`. A step whose
    residuals are not finite is rejected. No exception is raised inside; `converged` tells.
    """
    solver = optx.LevenbergMarquardt(rtol=tolerance, atol=tolerance, linear_solver=lx.QR())
    solution = optx.least_squares(
        _with_matrix_jacobian(residual),
        eqx.tree_at(lambda s: s.search, solver, _TrustRegion(jnp.asarray(tolerance), optx.ClassicalTrustRegion())),
        z0,
        args,
        options={"jac": "fwd"},
        max_steps=max_steps,
        throw=False,
    )
    at_end = solution.state.f_info  # of the last step that was accepted
    finite = jnp.all(jnp.isfinite(at_end.residual))
    J = jnp.where(finite, at_end.jac.as_matrix(), jnp.nan)
    converged = (solution.result == optx.RESULTS.successful) & finite
    return LeastSquaresSolution(solution.value, at_end.residual, J, converged, solution.stats["num_steps"])


def _with_matrix_jacobian(residual: Callable) -> Callable:
    """`residual(z, args)` whose derivative along any dz is `J dz`, J being evaluated once: no further simulation per product."""

    @jax.custom_jvp
    def wrapped(z, args):
        return residual(z, args)

    @wrapped.defjvp
    def _(primals, tangents):
        (z, args), (dz, _) = primals, tangents

        def twice(z):
            r = residual(z, args)
            return r, r

        J, r = jax.jacfwd(twice, has_aux=True)(z)
        return r, J @ dz

    return wrapped


class _TrustRegion(optx.AbstractSearch):
    """The classical trust region, which also accepts a step that stays at the minimum to within the tolerance.

    The promised reduction of |r|^2 / 2 is half the squared distance to the minimum in standard errors: below tolerance^2 the
    simulation's own noise decides whether |r|^2 falls, and the classical rule would reject some thirty steps before it noticed.
    """

    tolerance: Float[Array, ""]
    classical: optx.ClassicalTrustRegion

    def init(self, y, f_info_struct):
        return self.classical.init(y, f_info_struct)

    def step(self, first_step, y, y_eval, f_info, f_eval_info, state):
        step_size, accept, result, new_state = self.classical.step(first_step, y, y_eval, f_info, f_eval_info, state)
        promised = jnp.abs(self.classical.predict_reduction(y_eval - y, f_info))
        found = jnp.abs(f_eval_info.as_min() - f_info.as_min())
        return step_size, accept | ((promised < self.tolerance**2) & (found < self.tolerance)), result, new_state
