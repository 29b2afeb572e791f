"""The layout of a vector of unknowns, and the scene, starts and sensors for such a vector.

Shared unknowns are parameters of the scene, second moments and shears of bodies (`body_inertia`), and numbers
of sensors. Other parameters may depend on them (`Tie`).
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jourdain_jax.calculus.reals import Entries, Shape
from jourdain_jax.identification.solve.body_inertia import BodyInertia, Tie
from jourdain_jax.scene.coordinates import Labels
from jourdain_jax.scene.scene import Scene

# parameter; inertia of a body; initial value; parameter of a sensor or actuator
Kind = Literal["scene", "inertia", "start", "sensor"]


@dataclass(frozen=True)
class Place:
    """The range that a parameter, an initial value, or a sensor or actuator parameter occupies in a vector
    of unknowns.
    """

    name: str  # for a sensor or actuator: "gyro.gain"
    shape: Shape
    begin: int
    kind: Kind

    @property
    def end(self) -> int:
        """Return the end of the range."""
        return self.begin + math.prod(self.shape)

    def of(self, vector):
        """Return the entries of this range of a vector (or of many, with leading axes), in the shape of the
        quantity.
        """
        return vector[..., self.begin : self.end].reshape((*vector.shape[:-1], *self.shape))


@dataclass(frozen=True)
class Layout:
    """Names and shapes of the shared unknowns and of the unknowns of each run, and the dependent parameters;
    hashable.

    A single run has only shared unknowns, unless it is cut into pieces.
    """

    shared: tuple[Place, ...]
    local: tuple[Place, ...]
    bodies: tuple[BodyInertia, ...] = ()
    ties: tuple[Tie, ...] = ()

    @property
    def sizes(self) -> tuple[int, int]:
        """Return the numbers of shared unknowns, and of unknowns of each run."""
        return self.shared[-1].end if self.shared else 0, self.local[-1].end if self.local else 0

    @property
    def parameters(self) -> set[str]:
        """Return the names of the parameters that the unknowns determine."""
        return {place.name for place in self.shared if place.kind == "scene"} | set(self.following)

    @property
    def following(self) -> Labels:
        """Return the names of dependent parameters: entries of free inertias, and tied parameters."""
        names = [entry.name for body in self.bodies for entry in body.entries]
        return tuple(dict.fromkeys([*names, *(tie.name for tie in self.ties)]))

    def scene(self, scene: Scene, shared: Float[Entries, "*members shared"]) -> Scene:
        """Return the scene for these shared unknowns."""
        leaves, treedef = jax.tree.flatten(scene)
        # `names` has the index of each parameter's leaf in place of its value
        found, names = list(leaves), jax.tree.unflatten(treedef, range(treedef.num_leaves))
        for place in self.shared:
            if place.kind == "scene":
                found[getattr(names, place.name)] = place.of(shared)
        of_bodies = {place.name: place.of(shared) for place in self.shared if place.kind == "inertia"}
        for body in self.bodies:
            for entry, value in zip(body.entries, body.values(*map(of_bodies.get, body.labels)), strict=True):
                leaf = getattr(names, entry.name)
                own = jnp.broadcast_to(found[leaf], value.shape + jnp.shape(leaves[leaf]))
                found[leaf] = own.at[(..., *entry.index)].set(value)
        for tie in self.ties:
            # parameters that differ between members have leading axes
            function = tie.value
            axes = [0 if np.ndim(x) > np.ndim(own) else None for x, own in zip(found, leaves, strict=True)]
            for _ in shared.shape[:-1]:
                function = jax.vmap(function, in_axes=(axes,))
            found[getattr(names, tie.name)] = function(found)
        return jax.tree.unflatten(
            treedef, [x if x is own else jnp.asarray(x) for x, own in zip(found, leaves, strict=True)]
        )

    def start(self, start: dict, *vectors: Float[Entries, "*members _"]) -> dict:
        """Return the start of a run for these shared unknowns and unknowns of the run."""
        return start | {name: x for name, x in self._of_kind("start", vectors) if name in start}

    @property
    def numbers(self) -> bool:
        """Return whether sensors or actuators have unknown parameters."""
        return any(place.kind == "sensor" for place in (*self.shared, *self.local))

    def known(self, *vectors) -> dict[str, Array | np.ndarray]:
        """Return the unknown parameters of sensors and actuators of one run, by name."""
        return dict(self._of_kind("sensor", vectors))

    def _of_kind(self, kind: Kind, vectors) -> Iterator:
        """Return names and values of the unknowns of a kind, from the vectors of shared unknowns and of a
        run.
        """
        return (
            (place.name, place.of(x))
            for places, x in zip((self.shared, self.local), vectors, strict=True)
            for place in places
            if place.kind == kind
        )
