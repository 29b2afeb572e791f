"""The scene whose numbers stand in for a traced one: a compiled function is kept for the decisions that these numbers lead to."""

from collections.abc import Collection, Iterator
from contextlib import contextmanager
from numbers import Real

import jax
import numpy as np

from jourdain_jax.build.reference_parameters import defaults, once_per_values, reference_parameters, with_reference_parameters
from jourdain_jax.build.structure import structure_whatever_its_faults
from jourdain_jax.calculus.reals import real_type
from jourdain_jax.scene.scene import Scene


class Reference:
    """A scene whose numbers stand in for traced parameters of its class; a static argument of what is compiled.

    Two are equal where their scenes lead to the same decisions (`Structure.decisions`): then one program serves both. So what a call runs is decided by its own
    arguments, and not by which call was the first. Of parameters that are traced already, the class's defaults stand in.
    """

    @staticmethod
    def where_free(scene: Scene, free: Collection[str]) -> "Reference":
        """That of a scene some of whose parameters, `free`, are going to change: the defaults of its class stand in for these, where it has states there."""
        leaves, treedef = jax.tree.flatten(scene)
        for place, (name, default) in enumerate(defaults(scene)):
            if name in free and isinstance(default, Real | np.ndarray | jax.Array) and np.shape(default) == np.shape(leaves[place]):
                leaves[place] = np.asarray(default, real_type())
        return _found(jax.tree.unflatten(treedef, leaves)) or Reference(scene)

    def __init__(self, scene: Scene):
        self.scene = with_reference_parameters(scene)
        self._key = jax.tree.structure(scene), structure_whatever_its_faults(self.scene).decisions, jax.config.jax_enable_x64

    @contextmanager
    def stands_in(self) -> Iterator[None]:
        """Inside, its numbers stand in."""
        with reference_parameters(self.scene):
            yield

    def __hash__(self):
        return hash(self._key)

    def __eq__(self, other):
        return isinstance(other, Reference) and self._key == other._key


@once_per_values
def _found(scene: Scene) -> Reference | None:
    """That of a scene; None where no state of it is found."""
    try:
        return Reference(scene)
    except (TypeError, ValueError):
        return None
