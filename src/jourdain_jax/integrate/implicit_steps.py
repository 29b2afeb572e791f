"""Implicit methods of this package's loop: base classes, Radau's method and the implicit midpoint rule.
Newton's method solves the equations of a step.

Batches run under `vmap`. Structure-preserving methods preserve an energy, a quadratic integral or a symmetry
under time reversal, exactly or nearly. They need constant steps and have no error estimate, so the user gives
a `step`. Between two times at which a step must end, they take the smallest number of equal steps that are
not longer than `step`.

Radau's method for stiff motions has order 5 and three stages, and is L-stable:

    z_i = h sum_j a_ij f(t_0 + c_j h, y_0 + z_j),   y_1 = y_0 + z_3
    e = (1 - h g J)^-1 (g h f(t_0, y_0) + g/3 (-13 - 7 sqrt 6, -13 + 7 sqrt 6, -1) . z)
    J = df/dy,   1/g: the real eigenvalue of A^-1

The stages are collocation at the Radau nodes c = ((4 - sqrt 6)/10, (4 + sqrt 6)/10, 1). The error estimate e
has order 3 and stays small for components that decay within one step.

The implicit midpoint rule applies to any form of the integrated state.
"""

import abc
from typing import ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, PyTree

from jourdain_jax.calculus.reals import Flag, Number, Scalar, checked_unless_traced
from jourdain_jax.calculus.roots import newton_root
from jourdain_jax.integrate.integrands import rates
from jourdain_jax.integrate.vector_fields.field import VectorField
from jourdain_jax.scene.scene import Scene


class Solution(NamedTuple):
    """Result of an implicit step."""

    change: PyTree  # of the state; zero if the equations of the step were not solved
    error: PyTree | None  # error estimate; None if the method has none
    solved: Flag  # whether the equations of the step were solved


class ImplicitMethod(eqx.Module):
    """Implicit method: each step solves equations for the change of the state."""

    order: ClassVar[int]  # the error of a step h is about h^order
    even: ClassVar[bool] = False  # whether steps have equal length
    needed: ClassVar[int] = 3  # number of stored rates per step: at its start, middle and end
    at_the_end: ClassVar[int] = 2

    @property
    def name(self) -> str:
        """Return the name of the method, as shown in a trajectory."""
        return type(self).__name__

    @abc.abstractmethod
    def solve(self, args: tuple, t: Scalar, y: PyTree, h: Scalar) -> Solution:
        """Return the change of the state `y` at `t` in a step `h` (s, negative if time runs backward).
        `args`: as in `integrands.py`.
        """

    def fitted(self, scene: Scene, field: VectorField, asked: str) -> VectorField:
        """Return the vector field to integrate in place of `field`; by default `field`.

        Raises ValueError if the method does not apply to the `scene`, or to the state that the `Formulation`
        requests (`asked`).
        """
        return field


class FixedStepMethod(ImplicitMethod):
    """Base class of the structure-preserving methods, whose steps have equal length."""

    step: Number | None = eqx.field(kw_only=True)  # longest step, s; None within a compiled program
    order: ClassVar[int] = 2
    even: ClassVar[bool] = True

    def __check_init__(self):
        step = checked_unless_traced(
            self.step, f"`step` of `{self.name}`", (), advice="pass the length of steps in s"
        )
        if isinstance(step, np.ndarray) and not 0 < float(step) < np.inf:
            raise ValueError(
                f"`step` of `{self.name}` is {float(step):g}, expected a positive finite length in s"
            )


def sizes(
    unknowns: int, x: Float[Array, "numbers"], change: Float[Array, "numbers"]
) -> Float[Array, "unknowns"]:
    """Return the size of the unknowns, for comparison with round-off: the largest entry of the state x plus
    the largest entry of its change; 1 if both are zero.
    """
    size = jnp.max(jnp.abs(x)) + jnp.max(jnp.abs(change))
    return jax.lax.stop_gradient(jnp.full(unknowns, jnp.where(size == 0, 1.0, size)))


def even_step(longest: Scalar, rest: Scalar) -> Scalar:
    """Divide `rest` into the smallest number of equal steps that are at most `longest`, and return their
    length. A ratio 1e-9 above an integer counts as that integer.
    """
    return rest / jnp.maximum(jnp.ceil(rest / longest - 1e-9), 1)


_NODES = np.array([(4 - np.sqrt(6)) / 10, (4 + np.sqrt(6)) / 10, 1.0])
_POWERS = np.arange(1, 4)
# collocation: sum_j a_ij c_j^(k-1) = c_i^k / k for k = 1, 2, 3
_A = np.linalg.solve((_NODES[:, None] ** (_POWERS - 1)).T, (_NODES[:, None] ** _POWERS / _POWERS).T).T
_REAL = 1 / next(  # numerics
    float(value.real) for value in np.linalg.eigvals(np.linalg.inv(_A)) if abs(value.imag) < 1e-6
)
_ESTIMATE = _REAL / 3 * np.array([-13 - 7 * np.sqrt(6), -13 + 7 * np.sqrt(6), -1.0])  # numerics


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
