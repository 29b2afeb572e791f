"""Implicit midpoint rule, for any form of the integrated state."""

import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import PyTree

from jourdain_jax.calculus.roots import newton_root
from jourdain_jax.integrate.implicit_steps import FixedStepMethod, Solution, sizes
from jourdain_jax.integrate.integrands import rates


class ImplicitMidpoint(FixedStepMethod):
    """Implicit midpoint rule, `y_1 = y_0 + h f(t_0 + h/2, (y_0 + y_1)/2)`: `simulate(...,
    solver=ImplicitMidpoint(step=h))` with h in s.

    The method has order 2 and is symmetric in time. If the motion is stable, so is the method, for any step.
    It preserves to round-off all integrals that are quadratic in the integrated state (with the minimal
    state: in the coordinates and independent speeds), and is symplectic for unconstrained holonomic scenes in
    canonical coordinates. Velocity constraints hold exactly with the minimal state. With the full state, a
    projection after each step restores them, which breaks the symmetry.

    Use it for long motions of reversible scenes, where its energy error stays bounded, for stiff scenes, or
    if a quadratic integral matters. Otherwise the default solvers reach the same accuracy much faster.
    Newton's method solves the equations of a step to round-off, and the implicit function theorem
    differentiates them. Between saved times, steps are equal and at most `step` (s) long.

    Source: Hairer, Lubich and Wanner, Geometric Numerical Integration (2006), sections II.1.2 and IV.2.
    """

    def solve(self, args: tuple, t, y: PyTree, h) -> Solution:
        """Return the change of the state `y` at `t` in a step `h` (s). `args`: as in `integrands.py`."""
        y0, unravel = ravel_pytree(y)
        middle, h = t + h / 2, jnp.asarray(h, y0.dtype)

        def f(t, x):
            return ravel_pytree(rates(t, unravel(x), args))[0]

        # solve for the change, which keeps more digits than the new state
        guess = h * f(t, y0)
        found = newton_root(lambda d: d - h * f(middle, y0 + d / 2), guess, sizes(len(y0), y0, guess))
        return Solution(unravel(jnp.where(found.converged, found.x, 0.0)), None, found.converged)
