"""Parameters that follow from others in a fit: two equal wheels, an inertia that a shape and a mass give.

    p = f(scene)      f: plain JAX, of the scene with the unknowns in their places and the parameters tied before this one

A function is traced when it is handed over, and ties are compared by what they compute: a new lambda in every call is the same tie.
"""

from collections.abc import Callable
from dataclasses import dataclass

import jax
import jax.numpy as jnp
from jaxtyping import Array

from jourdain_jax.calculus.reals import described
from jourdain_jax.program.calls import Call
from jourdain_jax.scene.scene import Scene


@dataclass(frozen=True)
class Tie:
    """A parameter, and what it is of the leaves of the scene."""

    name: str
    function: Call

    def value(self, leaves: list) -> Array:
        """The parameter of a scene with these leaves."""
        return self.function.results(*leaves)[0]


def tied_by(name: str, function: Callable, scene: Scene) -> Tie:
    """A parameter as a function of the scene, which has the first guesses. ValueError where the function gives no value that the parameter may have."""
    leaves, treedef = jax.tree.flatten(scene)
    expected = jnp.shape(getattr(scene, name))

    def of_leaves(*leaves):
        value = function(jax.tree.unflatten(treedef, leaves))
        try:
            found = jnp.asarray(value, jnp.result_type(float))
        except (TypeError, ValueError):
            raise ValueError(f"the function in `free` of `{name}` returns {described(value)}, expected a number or an array of shape {expected}") from None
        if found.shape != expected:
            raise ValueError(f"the function in `free` of `{name}` returns an array of shape {found.shape}, expected {expected}, that of the parameter")
        return found

    found = Tie(name, Call(jax.make_jaxpr(of_leaves)(*leaves), ("a tied parameter",)))
    try:
        scene.replace(**{name: found.value(leaves)})
    except ValueError as error:
        raise ValueError(f"at the first guess the function in `free` of `{name}` gives a value that is not allowed: {error}") from None
    return found
