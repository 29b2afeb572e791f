"""The unknowns of a fit: parameters of the scene, which all runs share, and initial values of single runs.

theta = (shared, own of run 0, own of run 1, ...), every run with a place for each initial value that is unknown in any; where it is known, it is held.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jourdain_jax.analysis.measurements import Measurements
from jourdain_jax.analysis.ranges import Range, positive, unbounded
from jourdain_jax.scene.names import as_names, nearest
from jourdain_jax.scene.parameters import parameters_of
from jourdain_jax.scene.scene import Scene


@dataclass(frozen=True)
class Place:
    """Where the entries of a parameter, or of an initial value, are in a vector of such."""

    name: str
    shape: tuple[int, ...]
    begin: int

    @property
    def end(self) -> int:
        """One past the last."""
        return self.begin + int(np.prod(self.shape, dtype=int))

    def of(self, vector):
        """Its numbers in a vector (or in many, with leading axes), in their own shape."""
        return vector[..., self.begin : self.end].reshape((*vector.shape[:-1], *self.shape))


@dataclass(frozen=True)
class Layout:
    """Names and shapes of the shared unknowns and of those of each run; hashable."""

    shared: tuple[Place, ...]
    local: tuple[Place, ...]

    @property
    def sizes(self) -> tuple[int, int]:
        """How many are shared, and how many each run has."""
        return self.shared[-1].end if self.shared else 0, self.local[-1].end if self.local else 0

    def scene(self, scene: Scene, shared: Float[Array | np.ndarray, "*members shared"]) -> Scene:
        """The scene with these shared unknowns."""
        names = [place.name for place in self.shared]
        values = [jnp.asarray(place.of(shared)) for place in self.shared]
        return eqx.tree_at(lambda s: [getattr(s, name) for name in names], scene, values) if names else scene

    def start(self, start: dict, local: Float[Array | np.ndarray, "*members local"]) -> dict:
        """The start of a run with these unknowns of its own."""
        return start | {place.name: place.of(local) for place in self.local if place.name in start}


@dataclass(frozen=True)
class Unknowns:
    """All unknowns, with their first guesses and ranges; vectors theta have a number for every place of every run."""

    layout: Layout
    runs: int
    guess: Float[np.ndarray, "places"]
    fixed: Bool[np.ndarray, "places"]  # known, and there to give all runs one shape
    ranges: tuple[Range, ...]
    labels: tuple[str, ...]  # of those that are not fixed
    units: tuple[str, ...]

    @cached_property
    def estimated(self) -> np.ndarray:
        """Places of those that are not fixed."""
        return np.flatnonzero(~self.fixed)

    @cached_property
    def ends(self) -> tuple[np.ndarray, np.ndarray]:
        """Bounds of every place."""
        return np.array([r.low for r in self.ranges]), np.array([r.high for r in self.ranges])

    @cached_property
    def _kinds(self) -> list[tuple[Range, np.ndarray]]:
        return [(kind, np.array([i for i, r in enumerate(self.ranges) if r == kind])) for kind in dict.fromkeys(self.ranges)]

    def sizes(self, theta: Float[np.ndarray, "*members places"]) -> Float[np.ndarray, "*members places"]:
        """The magnitude against which changes of each are measured."""
        found = np.ones_like(theta)
        for kind, where in self._kinds:
            found[..., where] = kind.size(theta[..., where], self.guess[where])
        return found

    def split(self, theta: Float[np.ndarray, "*members places"]) -> tuple[np.ndarray, np.ndarray]:
        """Shared unknowns (*members, shared), and those of the runs (*members, runs, local)."""
        shared, local = self.layout.sizes
        return theta[..., :shared], theta[..., shared:].reshape(*theta.shape[:-1], self.runs, local)


def unknowns_of(scene: Scene, runs: Sequence[Measurements], free: "Mapping[str, Range | None] | Iterable[str]") -> Unknowns:
    """The unknowns that `free` and the runs' `unknown_start` name.

    Raises ValueError for unknown names, for guesses outside their bounds, and where nothing is free.
    """
    parameters = {name: (value, about) for name, value, about in parameters_of(scene)}
    entries: list[tuple[str, str, np.ndarray, Range, bool]] = []  # label, unit, guess, range, fixed
    shared: list[Place] = []
    for name, given in (free if isinstance(free, Mapping) else dict.fromkeys(as_names(free))).items():
        if name not in parameters:
            raise ValueError(f"`free` names `{name}`, which is no parameter of `{type(scene).__name__}`; {nearest(name, parameters)}")
        value, about = parameters[name]
        default = positive() if about["positive"] or about["non_negative"] else unbounded()
        guess = np.asarray(value)
        entries.append((name, about["unit"], guess, _chosen(name, given, default, guess), False))
        shared.append(Place(name, guess.shape, shared[-1].end if shared else 0))
    local: list[Place] = []
    for name in dict.fromkeys(name for run in runs for name in run.unknown_start):
        shape = next(run.start[name].shape for run in runs if name in run.unknown_start)
        local.append(Place(name, shape, local[-1].end if local else 0))
    for index, run in enumerate(runs):
        for place in local:
            label, free_here = f"run {index}: {place.name}", place.name in run.unknown_start
            guess = np.asarray(run.start.get(place.name, np.zeros(place.shape)))
            kind = _chosen(label, run.unknown_start[place.name], unbounded(), guess) if free_here else unbounded()
            entries.append((label, "", guess, kind, not free_here))
    if all(entry[-1] for entry in entries):
        raise ValueError(f"nothing is free; name parameters in `free` ({', '.join(f'`{name}`' for name in parameters)}), or `unknown_start` values of a run")
    free_ones = [(label, unit, guess.shape) for label, unit, guess, _, fixed in entries if not fixed]
    return Unknowns(
        layout=Layout(tuple(shared), tuple(local)),
        runs=len(runs),
        guess=np.concatenate([np.ravel(guess) for _, _, guess, _, _ in entries]).astype(float),
        fixed=np.concatenate([np.full(guess.size, fixed) for _, _, guess, _, fixed in entries]),
        ranges=tuple(kind for _, _, guess, kind, _ in entries for _ in range(guess.size)),
        labels=tuple(label + "".join(f"[{i}]" for i in index) for label, _, shape in free_ones for index in np.ndindex(shape)),
        units=tuple(unit for _, unit, shape in free_ones for _ in np.ndindex(shape)),
    )


def _chosen(label: str, given, default: Range, guess: np.ndarray) -> Range:
    """The range of an unknown, after a look at its first guess."""
    found = default if given is None else given
    if not isinstance(found, Range):
        raise ValueError(f"`{label}` was given {given!r}; expected `bounds(low, high)`, `positive()`, `unbounded()`, or None")
    refusal = found.refusal(guess)
    if refusal:
        raise ValueError(f"first guess of `{label}` is {guess}; {refusal}")
    return found
