"""Rows and coordinate rates as linear functions of the speeds, and how they change with time and coordinates; at many points, on NumPy.

    A u + d = 0,   qdot = N u + nu,          and their derivatives in x = (t, q)

From the scene's scalar graph, on which derivatives are sparse: nothing is compiled for it.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from jourdain_jax.build.trace import named_values, traced_scene
from jourdain_jax.program.derivative import jacobian
from jourdain_jax.program.evaluate import Probes
from jourdain_jax.scene.scene import Scene


@dataclass(frozen=True)
class LinearRows:
    """Rows and coordinate rates at many points; or the derivatives of these along one direction for each point."""

    A: np.ndarray  # (points, rows, speeds)
    d: np.ndarray  # (points, rows)
    N: np.ndarray  # (points, coordinates, speeds)
    nu: np.ndarray  # (points, coordinates)


class RowsOverStates:
    """The rows and rates of a scene as functions of points x = (t, q)."""

    def __init__(self, scene: Scene):
        self.scene, self.traced = scene, traced_scene(scene)
        g, at, u = self.traced.graph, self.traced.at, self.traced.u.tolist()
        flat = [*at.phi.tolist(), *at.qdot.tolist()]
        slopes = jacobian(g, flat, u)
        self.shape = len(flat), len(u)
        self.places = [(i, u.index(n)) for i, row in enumerate(slopes) for n in row]
        self.values = [*flat, *g.substituted(at.qdot.tolist(), dict.fromkeys(u, g.zero)), *(node for row in slopes for node in row.values())]
        variables = [self.traced.t, *self.traced.q.tolist()]
        changes = jacobian(g, self.values, variables)
        self.changes = [(i, variables.index(n), node) for i, row in enumerate(changes) for n, node in row.items()]

    def __call__(self, x: np.ndarray, u: np.ndarray) -> tuple[LinearRows, Callable[[np.ndarray], LinearRows]]:
        """Values at the points, taken at the speeds u (which matter where rows are nonlinear in them), and derivatives as a function of directions.

        `x`, `u` and what that function takes have a leading axis of points.
        """
        named = named_values(self.scene, x[:, 0], x[:, 1:], u, np.zeros((len(x), len(self.scene.inputs))))
        probes = Probes(self.traced.graph, {name: np.asarray(value, float) for name, value in named.items()})
        found = probes([*self.values, *(node for _, _, node in self.changes)])
        value, change = found[: len(self.values)], found[len(self.values) :]
        place, variable = (np.array([c[k] for c in self.changes], int) for k in (0, 1))

        def along(direction: np.ndarray) -> LinearRows:
            rate = np.zeros_like(value)
            np.add.at(rate, place, change * direction.T[variable])
            return self._arranged(rate, u)

        return self._arranged(value, u), along

    def _arranged(self, flat: np.ndarray, u: np.ndarray) -> LinearRows:
        """The rows and coordinate rates in values with a last axis of points."""
        count, rows = self.shape[0], len(self.traced.at.phi)
        slopes = np.zeros((flat.shape[-1], *self.shape))
        if self.places:
            i, j = zip(*self.places, strict=True)
            slopes[:, i, j] = flat[count + len(self.traced.q) :].T
        A, N = slopes[:, :rows], slopes[:, rows:]
        return LinearRows(A, flat[:rows].T - np.einsum("pij,pj->pi", A, u), N, flat[count : count + len(self.traced.q)].T)
