"""Base classes of the implicit methods of this package's loop. Newton's method solves the equations of a
step.

Batches run under `vmap`. Structure-preserving methods preserve an energy, a quadratic integral or a symmetry
under time reversal, exactly or nearly. They need constant steps and have no error estimate, so the user gives
a `step`. Between two times at which a step must end, they take the smallest number of equal steps that are
not longer than `step`.
"""

import abc
from typing import ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from jourdain_jax.calculus.reals import Flag, Number, Scalar, checked_unless_traced
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
