"""A problem: a scene, a start, an end, what is compared there and with what; and the judge of a final state."""

import functools
from collections.abc import Callable
from dataclasses import dataclass, field

import jax
import jax.numpy as jnp
import numpy as np

import jourdain_jax as jj
from jourdain_jax.equations.minimal import minimal_kinematics


@dataclass(frozen=True)
class Reference:
    """True values at the end, how they were obtained, and how far a second, independent computation is from them."""

    values: dict[str, float]
    how: str
    uncertainty: float = float("nan")
    against: str = "nothing else"


@dataclass(frozen=True, eq=False)
class Problem:
    """One chart."""

    name: str
    title: str
    make_scene: Callable[[], jj.Scene]
    start: dict
    end: float  # s
    reference: Callable[["Problem"], Reference]
    compared: tuple[str, ...]  # names of coordinates and speeds
    conserves_energy: bool = True
    steps: tuple[float, ...] = field(default=(0.1, 0.03, 0.01, 0.003, 0.001))  # s, of methods with a constant step
    large: bool = False  # implicit solvers, whose inner solves take minutes to compile, and most reductions are left out
    structure_preserving: bool = False  # whether the costly solvers of that kind are run

    @functools.cached_property
    def scene(self) -> jj.Scene:
        """The scene, made when first wanted."""
        return self.make_scene()

    @functools.cached_property
    def state(self) -> jj.State:
        """The consistent start."""
        return jj.start(self.scene, **self.start)

    @functools.cached_property
    def independent(self) -> tuple[int, ...]:
        """Numbers of the privileged speeds."""
        return tuple(jj.structure_of(self.scene).independent)

    @property
    def minimal_names(self) -> tuple[str, ...]:
        """Coordinates and privileged speeds."""
        speeds = self.scene.speed_names.entries
        return (*self.scene.coordinate_names.entries, *(speeds[i] for i in self.independent))

    @functools.cached_property
    def minimal_start(self) -> np.ndarray:
        """The start in coordinates and privileged speeds."""
        return np.concatenate([self.state.q, np.asarray(self.state.u)[list(self.independent)]])

    @functools.cached_property
    def judge(self) -> "Judge":
        """The judge of final states, with the reference computed."""
        return Judge(self)


@dataclass(frozen=True)
class Judged:
    """What a final state is worth; see `record.record`."""

    error: float
    energy_drift: float | None
    slip: float


class Judge:
    """Error, energy drift and slip of final states of a problem."""

    def __init__(self, problem: Problem):
        self.problem = problem
        self.reference = problem.reference(problem)
        scene = problem.scene
        self._names = (*scene.coordinate_names.entries, *scene.speed_names.entries)
        self._complete = jax.jit(lambda y: self._all_speeds(y))
        self._energy_and_slip = jax.jit(self._measured)
        self._energy_at_start = float(self._energy_and_slip(problem.state.t, problem.state.q, problem.state.u)[0])

    def _all_speeds(self, y):
        q = y[: len(self.problem.scene.coordinate_names.entries)]
        scene, end = self.problem.scene, jnp.asarray(self.problem.end)
        return q, minimal_kinematics(scene, self.problem.independent, jj.structure_of(scene).kept_rows, end, q, y[len(q) :]).u

    def _measured(self, t, q, u):
        scene = self.problem.scene
        rows = jj.velocity_residual(scene, t, q, u)
        return jj.kinetic_energy(scene, t, q, u) + jj.potential_energy(scene, jj.motion_at(scene, t, q, u)), jnp.max(jnp.abs(rows), initial=0.0)

    def error(self, q, u) -> float:
        """The largest absolute difference from the reference over the quantities compared, SI units."""
        return largest_error(dict(zip(self._names, (*np.asarray(q), *np.asarray(u)), strict=True)), self.reference.values, self.problem.compared)

    def full(self, q, u) -> Judged:
        """Of coordinates and all speeds."""
        energy, slip = map(float, self._energy_and_slip(self.problem.end, jnp.asarray(q), jnp.asarray(u)))
        drift = abs(energy - self._energy_at_start) / abs(self._energy_at_start) if self.problem.conserves_energy else None
        return Judged(self.error(q, u), drift, slip)

    def minimal(self, y) -> Judged:
        """Of coordinates and privileged speeds: the others follow from the rows."""
        return self.full(*self._complete(jnp.asarray(y)))


def largest_error(found: dict, expected: dict[str, float], names: tuple[str, ...]) -> float:
    """The largest absolute difference over the quantities named; NaN where one is not finite."""
    return float(np.max([abs(float(found[name]) - float(expected[name])) for name in names]))
