"""A problem: a scene, a start, an end, what is compared there and with what."""

import functools
from collections.abc import Callable
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

import jourdain_jax as jj
from jourdain_jax.equations.gibbs_appell import minimal_kinematics


@dataclass(frozen=True)
class Reference:
    """True values at the end, how they were obtained, and how far a second, independent computation is from
    them.
    """

    values: dict
    how: str
    uncertainty: float = float("nan")
    against: str = "nothing else"


@dataclass(frozen=True, eq=False)
class Problem:
    """One chart."""

    name: str
    title: str
    make_scene: Callable
    start: dict
    end: float  # s
    reference: Callable
    compared: str  # names of coordinates and speeds

    @functools.cached_property
    def scene(self) -> jj.Scene:
        """The scene, made when first wanted."""
        return self.make_scene()

    @functools.cached_property
    def state(self) -> jj.State:
        """The consistent start."""
        return jj.start(self.scene, **self.start)

    @functools.cached_property
    def independent(self):
        """Numbers of the privileged speeds."""
        return tuple(jj.structure_of(self.scene).independent)

    @property
    def minimal_names(self):
        """Coordinates and privileged speeds."""
        speeds = self.scene.speed_names.entries
        return (*self.scene.coordinate_names.entries, *(speeds[i] for i in self.independent))

    @functools.cached_property
    def minimal_start(self):
        """The start in coordinates and privileged speeds."""
        return np.concatenate([self.state.q, np.asarray(self.state.u)[list(self.independent)]])

    @functools.cached_property
    def truth(self) -> Reference:
        """The reference, computed when first wanted."""
        return self.reference(self)

    @functools.cached_property
    def completed(self):
        """A function of coordinates and privileged speeds at the end that returns coordinates and all
        speeds.
        """
        scene, n, end = self.scene, len(self.scene.coordinate_names.entries), jnp.asarray(self.end)
        rows = jj.structure_of(scene).kept_rows
        return jax.jit(
            lambda y: (y[:n], minimal_kinematics(scene, self.independent, rows, end, y[:n], y[n:]).u)
        )

    def error(self, q, u):
        """The largest absolute difference of a final state from the reference over the quantities compared,
        SI units.
        """
        return largest_error(self.named(q, u), self.truth.values, self.compared.split())

    def named(self, *values):
        """Coordinates and speeds by name."""
        names = (*self.scene.coordinate_names.entries, *self.scene.speed_names.entries)
        return dict(zip(names, np.concatenate(values), strict=True))


def largest_error(found, expected, names):
    """The largest absolute difference over the quantities named; NaN where one is not finite."""
    return float(np.max([abs(float(found[name]) - float(expected[name])) for name in names]))
