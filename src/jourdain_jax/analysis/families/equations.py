"""Equations of steady motions and their derivatives, as one scalar program.

    R(z) = ( g,  phi,  dy/dt,  dq_j/dt ) = 0,      J = dR/dz        z: coordinates, speeds, varying parameters

y: the independent speeds of the scalar program; j: the coordinates that must be constant. Coordinates on
which no equation depends, such as a heading, are omitted. Unknowns are in units of their sizes, rows in SI
units. Small motions about a steady motion:

    x = (dq, dy) = E s,   ds/dt = A s,   A = E' F E        E: basis of C x = 0;   F = d(dq/dt, dy/dt)/d(q, y)

Eigenvalues of small motions are matched along a family, so that each column follows one mode.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Complex, Float, Int

from jourdain_jax.analysis.motion_derivatives import by_program, numbers_of, on_rows, places_of
from jourdain_jax.calculus.lazy_imports import module_on_first_use
from jourdain_jax.calculus.reals import Scalar, largest
from jourdain_jax.integrate.state import State, state_of
from jourdain_jax.lowering.lower import lower
from jourdain_jax.scene.coordinates import Labels, check_name
from jourdain_jax.scene.scene import Scene, state_names
from jourdain_jax.structure.assembly import coordinate_bounds

optimize = module_on_first_use("scipy.optimize")
Modes = Complex[np.ndarray, "modes"]


def null_space(C: Float[np.ndarray, "rows states"]) -> Float[np.ndarray, "states free"]:
    """Return an orthonormal basis of the null space of C."""
    _, sigma, V = np.linalg.svd(C)
    return V[np.sum(sigma > 1e-9 * np.max(sigma, initial=1e-300)) :].T


def matched(before: Modes, now: Modes) -> Modes:
    """Return the eigenvalues in the order of their predecessors: the assignment with the smallest total
    change.
    """
    apart, place = np.abs(before[:, None] - now), np.arange(len(now))
    return now[optimize.linear_sum_assignment(apart - 1e-12 * (1 + largest(now)) * np.outer(place, place))[1]]


def surely_matched(before: Modes, now: Modes) -> bool:
    """Return whether each eigenvalue moved by at most half of its distance to the nearest other eigenvalue.
    Its complex conjugate does not count as another.
    """
    beside = partners(before, now) | np.eye(len(now), dtype=bool)
    apart = np.where(beside, np.inf, np.abs(before[:, None] - before))
    return bool(np.all(np.abs(now - before) <= 0.5 * np.min(apart, axis=1, initial=np.inf)))


def partners(before: Modes, now: Modes) -> Bool[np.ndarray, "modes modes"]:
    """Return which columns are a complex conjugate pair before or now."""
    return np.any([(v[:, None] == np.conj(v)) & (v.imag != 0) for v in (before, now)], axis=0)


def mode_names(scene: Scene, names: Labels | None, values: Modes) -> Labels:
    """Return the names of the columns: `names` if given, otherwise the scene's, otherwise "mode 1", ..."""
    named = getattr(scene, "mode_names", None)
    names = (
        tuple(names)
        if names is not None
        else (named and named(values)) or tuple(f"mode {k + 1}" for k in range(len(values)))
    )
    if len(names) != len(values):
        raise ValueError(f"`names` has {len(names)} names, expected one for each of the {len(values)} modes")
    return names


Vector = Float[np.ndarray, "unknowns"]
PAIR, ZERO, DOUBLE = "pair on the imaginary axis", "zero eigenvalue", "double root"


@dataclass(frozen=True)
class Look:
    """Equations at one point. Rows are in SI units, unknowns in units of their sizes."""

    R: Float[np.ndarray, "rows"]  # the last rows hold values constant
    J: Float[np.ndarray, "rows unknowns"]
    # small motions: F and C for (q, y) in SI units, or the multipliers of a periodic motion
    small: tuple[np.ndarray, ...]


class Motions(ABC):
    """Equations of one kind of motion, steady or periodic, whose solutions form families."""

    what: str  # name of this kind of motion
    modes: str  # name and unit of eigenvalues or multipliers
    growth: Callable[[np.ndarray], np.ndarray]  # growth of modes
    crossing: Callable[[complex], str]  # kind of point at which a mode starts or stops growing
    t: Scalar  # s, at the start
    scene: Scene
    vary: Labels  # parameters among the unknowns
    given: np.ndarray  # all numbers (parameters, t, q, u, inputs) of the guess
    by_name: dict[str, int]  # indices of coordinates, speeds and varying quantities
    places: Int[np.ndarray, "unknowns"]  # indices of the unknowns
    unknowns: Labels
    size: Vector
    start: Vector  # the guess
    held: Int[np.ndarray, "held"]  # indices of unknowns that keep their initial values

    def begin(self, held: Labels) -> None:
        """Name the unknowns, find their values at the guess, and the places of the `held` ones."""
        names = {k: name for name, k in self.by_name.items()}
        self.unknowns = tuple(names[k] for k in self.places)
        self.start = self.given[self.places] / self.size
        self.held = np.array([self.index(name) for name in held], int)

    def index(self, name: str) -> int:
        """Return the index of the unknown `name`. Raises ValueError, with similar names, if there is none."""
        check_name(
            name,
            self.unknowns,
            f"`{name}` is not an unknown of the {self.what} of `{type(self.scene).__name__}`",
        )
        return self.unknowns.index(name)

    def at(self, z: Vector) -> np.ndarray:
        """Return all numbers of the guess, with the unknowns replaced by z."""
        given = self.given.copy()
        given[self.places] = z * self.size
        return given

    def values(self, z: Vector) -> dict[str, float]:
        """Return coordinates, speeds and varying quantities, by name."""
        numbers = self.at(z)
        return {name: float(numbers[k]) for name, k in self.by_name.items()}

    def state(self, numbers, residual=0.0) -> State:
        """Return the state among all numbers."""
        entries = self.scene.coordinate_names.entries, self.scene.speed_names.entries
        q, u = (jnp.asarray(numbers)[np.array([self.by_name[x] for x in names])] for names in entries)
        return state_of(self.scene, self.t, q, u, residual=residual)

    def place(self, point) -> Vector:
        """Return the vector z of the unknowns for the values in `point`."""
        return np.array([point[name] for name in self.unknowns]) / self.size

    @abstractmethod
    def __call__(self, z: Vector) -> Look:
        """Return the equations and their derivatives at z."""

    @abstractmethod
    def eigenvalues(self, look: Look, tangent: Vector) -> Modes:
        """Return the eigenvalues or multipliers of small motions, in any order. Perturbations along the
        family are excluded.
        """

    def with_held(self, R: np.ndarray, J: np.ndarray, z: Vector, small: tuple) -> Look:
        """Return the equations, with an additional row for each unknown that keeps its value."""
        rows = np.eye(len(z))[self.held]
        return Look(np.append(R, rows @ (z - self.start)), np.vstack([J * self.size, rows]), small)


class SteadyEquations(Motions):
    """Equations of the steady motions of one scene: R, J, F and C as functions of z. The `held` unknowns keep
    their values at the guess.
    """

    what, modes = "steady motions", "eigenvalues, 1/s"
    growth, crossing = staticmethod(np.real), staticmethod(lambda mode: PAIR if mode.imag else ZERO)

    def __init__(
        self,
        scene: Scene,
        guess: tuple[float, np.ndarray, np.ndarray],
        inputs: np.ndarray,
        vary: Labels = (),
        held: Labels = (),
    ) -> None:
        self.scene, self.vary, (self.t, q, u) = scene, vary, guess
        names, at, program = state_names(scene), places_of(scene), lower(scene)
        self.given = np.asarray(numbers_of(scene, self.t, q, u, inputs), float)
        varied = [getattr(numbered(scene), name) for name in vary]
        self.instant = by_program(scene, program, (), tuple(varied))
        matters = np.array([name not in program.held for name in program.coordinates], bool)
        bound = on_rows(scene)
        kept, y = np.flatnonzero(matters | bound), np.array(program.independent, int)
        columns = np.concatenate([at.q[kept], at.u])
        self.places = np.concatenate([self.instant.states[0] - 1 + columns, varied]).astype(int)
        self.size = np.append(sizes(scene)[columns - 1], [abs(x) or 1.0 for x in self.given[varied]])
        self.by_name = dict(
            zip((*names, *vary), [*(self.instant.states[0] + np.arange(len(names))), *varied], strict=True)
        )
        self.begin(held)
        self.states_of_z = [*range(len(kept)), *(len(kept) + k for k in y)]
        self.rows = np.concatenate([at.g, at.phi, at.udot[y], at.qdot[matters]])
        self.rates = np.concatenate([at.qdot[kept], at.udot[y]])
        self.states = np.concatenate([at.q[kept], at.u[y]])
        self.of_states = np.concatenate([at.g, at.phi if len(y) == len(at.u) else []]).astype(int)
        columns = np.append(columns, np.arange(-len(vary), 0))
        self.slopes = (
            np.ix_(self.rows, columns),
            np.ix_(self.rates, self.states),
            np.ix_(self.of_states, self.states),
        )

    def __call__(self, z: Vector) -> Look:
        """Return the equations and their derivatives at z."""
        v, D, _ = self.instant.of(self.at(z))
        J, F, C = (D[block] for block in self.slopes)
        return self.with_held(v[self.rows], J, z, (F, C))

    def freedoms(self, look: Look) -> Float[np.ndarray, "states free"]:
        """Return the directions of (q, y) along which other steady motions exist for the same parameters, as
        columns in SI units.
        """
        count, states = 1 + len(self.held) - len(self.vary), len(self.start) - len(self.vary)
        return self._in_states(np.linalg.svd(look.J[: len(self.rows), :states])[2][states - count :].T)

    def _in_states(
        self, directions: Float[np.ndarray, "unknowns directions"]
    ) -> Float[np.ndarray, "states directions"]:
        return (directions * self.size[: len(directions), None])[self.states_of_z]

    def eigenvalues(self, look: Look, tangent: Vector) -> Modes:
        """Return the eigenvalues of small motions (1/s), by ascending real part, without the zero eigenvalues
        of perturbations towards other steady motions.

        The columns of T are the directions of other steady motions for the same parameters. The returned
        eigenvalues are those of `P' A P`, where the columns of P are orthonormal and perpendicular to T.
        """
        freedoms = self.freedoms(look) if len(self.held) or self.vary else self._in_states(tangent[:, None])
        F, C = look.small
        E = null_space(C)
        P = null_space(np.linalg.qr(E.T @ freedoms)[0].T)
        values = np.linalg.eigvals(P.T @ E.T @ F @ E @ P).astype(complex)
        return values[np.lexsort((-values.imag, values.real))]


def numbered(scene: Scene) -> Scene:
    """Return a scene in which each parameter is replaced by the index of its first entry in the vector of all
    numbers.
    """
    leaves, treedef = jax.tree.flatten(scene)
    return jax.tree.unflatten(treedef, np.cumsum([0, *map(np.size, leaves[:-1])]).tolist())


def sizes(scene: Scene) -> np.ndarray:
    """Return the sizes of the coordinates (from their domain) and of the speeds. Sizes are the units of the
    unknowns.
    """
    low, high = coordinate_bounds(scene)
    of_coordinates = np.where(high > low, high - low, 1.0)
    return np.append(of_coordinates, [10.0] * len(scene.speed_names.entries))  # SI units
