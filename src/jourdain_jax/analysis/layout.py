"""Where every unknown is in a vector of them, and the scene, starts and sensors that such a vector makes.

Shared unknowns are parameters of the scene, second moments and shears of bodies (`body_inertia`), and numbers of sensors. Parameters may follow from them
(`ties`).
"""

import math
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jourdain_jax.analysis.body_inertia import BodyInertia
from jourdain_jax.analysis.ties import Tie
from jourdain_jax.scene.scene import Scene

Kind = Literal["scene", "sensor", "inertia"]


@dataclass(frozen=True)
class Place:
    """Where the entries of a parameter, of an initial value, or of a number of a sensor or actuator, are in a vector of such."""

    name: str  # of a sensor's or actuator's: "gyro.gain"
    shape: tuple[int, ...]
    begin: int
    kind: Kind = "scene"  # a parameter or an initial value; a number of a sensor or an actuator; of a body's inertia

    @cached_property
    def end(self) -> int:
        """One past the last."""
        return self.begin + math.prod(self.shape)

    @property
    def of_sensor(self) -> bool:
        """Whether it is a number of a sensor or an actuator."""
        return self.kind == "sensor"

    def of(self, vector):
        """Its numbers in a vector (or in many, with leading axes), in their own shape."""
        return vector[..., self.begin : self.end].reshape((*vector.shape[:-1], *self.shape))


@dataclass(frozen=True)
class Layout:
    """Names and shapes of the shared unknowns and of those of each run, and the parameters that follow from them; hashable."""

    shared: tuple[Place, ...]
    local: tuple[Place, ...]
    bodies: tuple[BodyInertia, ...] = ()
    ties: tuple[Tie, ...] = ()

    @cached_property
    def sizes(self) -> tuple[int, int]:
        """How many are shared, and how many each run has."""
        return self.shared[-1].end if self.shared else 0, self.local[-1].end if self.local else 0

    @cached_property
    def parameters(self) -> set[str]:
        """Names of the parameters that differ from those of the scene."""
        return {place.name for place in self.shared if place.kind == "scene"} | set(self.following)

    @cached_property
    def following(self) -> tuple[str, ...]:
        """Names of the parameters that follow from unknowns: moments of inertia of bodies, and what is tied to others."""
        return tuple(dict.fromkeys([*(entry.name for body in self.bodies for entry in body.entries), *(tie.name for tie in self.ties)]))

    def scene(self, scene: Scene, shared: Float[Array | np.ndarray, "*members shared"]) -> Scene:
        """The scene with these shared unknowns."""
        leaves, treedef = jax.tree.flatten(scene)
        return jax.tree.unflatten(treedef, [x if x is own else jnp.asarray(x) for x, own in zip(self.leaves(leaves, treedef, shared), leaves, strict=True)])

    def leaves(self, leaves: list, treedef, shared: Float[Array | np.ndarray, "*members shared"]) -> list:
        """The leaves of a scene, with these shared unknowns in their places."""
        found = list(leaves)
        for place in self.shared:
            if place.kind == "scene":
                found[_leaf(treedef, place.name)] = place.of(shared)
        of_bodies = {place.name: place.of(shared) for place in self.shared if place.kind == "inertia"}
        for body in self.bodies:
            for entry, value in zip(body.entries, body.values(*map(of_bodies.get, body.labels)), strict=True):
                leaf = _leaf(treedef, entry.name)
                own = jnp.broadcast_to(found[leaf], value.shape + jnp.shape(leaves[leaf]))
                found[leaf] = own.at[(..., *entry.index)].set(value)
        for tie in self.ties:
            # a member's parameters have its axes in front, those that all share have none
            function, axes = tie.value, [0 if np.ndim(x) > np.ndim(own) else None for x, own in zip(found, leaves, strict=True)]
            for _ in shared.shape[:-1]:
                function = jax.vmap(function, in_axes=(axes,))
            found[_leaf(treedef, tie.name)] = function(found)
        return found

    def start(self, start: dict, local: Float[Array | np.ndarray, "*members local"]) -> dict:
        """The start of a run with these unknowns of its own."""
        return start | {place.name: place.of(local) for place in self.local if place.name in start}

    @cached_property
    def numbers(self) -> bool:
        """Whether sensors or actuators have any."""
        return any(place.of_sensor for place in (*self.shared, *self.local))

    def known(self, shared, local) -> dict[str, Array | np.ndarray]:
        """Numbers of sensors and actuators by name, of one run."""
        return {place.name: place.of(vector) for places, vector in ((self.shared, shared), (self.local, local)) for place in places if place.of_sensor}


@lru_cache(maxsize=256)
def _leaf(treedef, name: str) -> int:
    """Which leaf of a scene the parameter of this name is."""
    return getattr(jax.tree.unflatten(treedef, range(treedef.num_leaves)), name)
