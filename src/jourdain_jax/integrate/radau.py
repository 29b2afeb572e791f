"""Radau's method of order 5 for stiff motions: implicit, L-stable, three stages.

    z_i = h sum_j a_ij f(t_0 + c_j h, y_0 + z_j),   y_1 = y_0 + z_3
    e = (1 - h g J)^-1 (g h f(t_0, y_0) + g/3 (-13 - 7 sqrt 6, -13 + 7 sqrt 6, -1) . z)
    J = df/dy,   1/g: the real eigenvalue of A^-1

The stages are collocation at the Radau nodes c = ((4 - sqrt 6)/10, (4 + sqrt 6)/10, 1). The error estimate e
has order 3 and stays small for components that decay within one step.
"""

from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import PyTree

from jourdain_jax.calculus.roots import newton_root
from jourdain_jax.integrate.implicit_steps import ImplicitMethod, Solution, sizes
from jourdain_jax.integrate.integrands import rates

_NODES = np.array([(4 - np.sqrt(6)) / 10, (4 + np.sqrt(6)) / 10, 1.0])
_POWERS = np.arange(1, 4)
# collocation: sum_j a_ij c_j^(k-1) = c_i^k / k for k = 1, 2, 3
_A = np.linalg.solve((_NODES[:, None] ** (_POWERS - 1)).T, (_NODES[:, None] ** _POWERS / _POWERS).T).T
_REAL = 1 / next(
    float(value.real) for value in np.linalg.eigvals(np.linalg.inv(_A)) if abs(value.imag) < 1e-6
)
_ESTIMATE = _REAL / 3 * np.array([-13 - 7 * np.sqrt(6), -13 + 7 * np.sqrt(6), -1.0])


class RadauIIA(ImplicitMethod):
    """Radau's implicit method of order 5, `simulate(..., solver=RadauIIA())`: for stiff springs, dampers and
    drives.

    The method is L-stable: fast decaying modes do not limit the steps. Newton's method solves the equations
    of a step to round-off, and the implicit function theorem differentiates them. If Newton's method fails,
    the step is repeated at a fifth of its length. A step costs some fifty evaluations of the rates and a
    linear system three times the size of the state. This is worthwhile if stability would force an explicit
    method to take many more steps than accuracy requires. With `retry=True`, `simulate` uses this method if
    its default solver runs out of steps on a stiff motion.

    Source: E. Hairer and G. Wanner, Solving Ordinary Differential Equations II (1996), section IV.5 and
    equations (IV.8.17) to (IV.8.19).
    """

    order: ClassVar[int] = 4  # of the embedded estimate

    def solve(self, args: tuple, t, y: PyTree, h) -> Solution:
        """Return the change of the state `y` at `t` in a step `h` (s). The error is infinite if the equations
        were not solved. `args`: as in `integrands.py`.
        """
        x0, unravel = ravel_pytree(y)
        h = jnp.asarray(h, x0.dtype)
        n, A, estimate = x0.shape[0], jnp.asarray(_A, x0.dtype), jnp.asarray(_ESTIMATE, x0.dtype)
        times = t + jnp.asarray(_NODES, jnp.result_type(t)) * h

        def f(t, x):
            return jnp.asarray(ravel_pytree(rates(t, unravel(x), args))[0], x0.dtype)

        def equations(z):
            z = z.reshape(3, n)
            # in a loop, so that the rates are compiled once
            slopes = jax.lax.map(lambda stage: f(stage[0], x0 + stage[1]), (times, z))
            return (z - h * A @ slopes).reshape(-1)

        slope, along = jax.linearize(lambda x: f(t, x), x0)
        found = newton_root(equations, jnp.zeros(3 * n, x0.dtype), sizes(3 * n, x0, h * slope))
        z = found.x.reshape(3, n)
        one = jnp.eye(n, dtype=x0.dtype)
        error = jnp.linalg.solve(
            one - h * _REAL * jax.vmap(along, 1, 1)(one), _REAL * h * slope + estimate @ z
        )
        error = jax.lax.stop_gradient(jnp.where(found.converged, jnp.abs(error), jnp.inf))
        return Solution(unravel(jnp.where(found.converged, z[2], 0.0)), unravel(error), found.converged)
