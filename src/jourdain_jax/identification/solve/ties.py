"""Ties: parameters that depend on others in a fit, such as two equal wheels.

p = f(scene)      f: plain JAX, of the scene with the unknowns and all previously tied parameters

A function is traced when it is passed. Ties are compared by their operations, so that a new lambda in
every call is the same tie.
"""

from collections.abc import Callable
from dataclasses import dataclass

import jax
import jax.numpy as jnp
from jaxtyping import Array

from jourdain_jax.calculus.reals import described, real_type
from jourdain_jax.program.calls import Call
from jourdain_jax.scene.scene import Scene


@dataclass(frozen=True)
class Tie:
    """A parameter, and its dependence on the leaves of the scene."""

    name: str
    function: Call

    def value(self, leaves: list) -> Array:
        """Return the tied parameter of a scene with these leaves."""
        return self.function.results(*leaves)[0]


def tied_by(name: str, function: Callable, scene: Scene) -> Tie:
    """Return the tie of a parameter by a function of the scene. Raises ValueError unless the function returns
    an allowed value at the first guesses in `scene`.
    """
    leaves, treedef = jax.tree.flatten(scene)
    expected = jnp.shape(getattr(scene, name))

    def of_leaves(*leaves):
        value = function(jax.tree.unflatten(treedef, leaves))
        try:
            found = jnp.asarray(value, real_type())
        except (TypeError, ValueError):
            raise ValueError(
                f"the function in `free` of `{name}` returns {described(value)}, expected a "
                f"number or an array of shape {expected}"
            ) from None
        if found.shape != expected:
            raise ValueError(
                f"the function in `free` of `{name}` returns an array of shape {found.shape}, "
                f"expected {expected}, the shape of the parameter"
            )
        return found

    found = Tie(name, Call(jax.make_jaxpr(of_leaves)(*leaves), ("a tied parameter",)))
    try:
        scene.replace(**{name: found.value(leaves)})
    except ValueError as error:
        raise ValueError(
            f"at the first guess the function in `free` of `{name}` gives a value that is not "
            f"allowed: {error}"
        ) from None
    return found
