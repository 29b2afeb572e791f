"""The unknowns of a fit: shared parameters of the scene, initial values of single runs, and parameters of
sensors and actuators.

    theta = (shared, own of run 0, own of run 1, ...)

Every run has a place for each initial value that is unknown in any run; where the value is known, it is held.
The unknowns of a single run count as shared.

`check_starts` checks that runs start on the constraints, also after changes of the unknowns.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Shaped

from jourdain_jax.calculus.reals import Indices
from jourdain_jax.identification.data.estimate import (
    Correlated,
    Estimate,
    Range,
    positive,
    unbounded,
    whitening,
)
from jourdain_jax.identification.data.experiment import Experiment
from jourdain_jax.identification.data.sensors import UNITS, default_range
from jourdain_jax.identification.solve.body_inertia import (
    BodyInertia,
    PossibleInertia,
    inertia_of_body,
    tied_by,
)
from jourdain_jax.identification.solve.layout import Kind, Layout, Place
from jourdain_jax.motion.start import start as consistent_start
from jourdain_jax.scene.coordinates import Labels, as_names, check_name, parameters_of
from jourdain_jax.scene.scene import Scene

Places = Float[np.ndarray, "*members places"]  # one number for each place


@dataclass(eq=False)
class Unknowns:
    """All unknowns, with first guesses and ranges. A vector theta has one entry for each number of each run.

    Priors are residuals M W (theta - mean), with W one over each standard deviation.
    """

    layout: Layout
    runs: int
    guess: Places
    fixed: Bool[np.ndarray, "places"]  # known values, included so that all runs have the same shape
    ranges: tuple[Range, ...]
    labels: Labels  # of unknowns that are not fixed
    units: Labels
    prior_mean: Places  # zero without prior
    prior_weight: Places  # W; zero without prior
    # M of priors of shared unknowns: see `estimate.whitening`
    whitening: Float[np.ndarray, "shared shared"]
    estimated: np.ndarray = field(init=False)  # places of unknowns that are not fixed
    low: Places = field(init=False)
    high: Places = field(init=False)
    least: Places = field(init=False)  # typical magnitude of each place, used near zero

    def __post_init__(self):
        self.estimated = np.flatnonzero(~self.fixed)
        self.low, self.high = np.array([(r.low, r.high) for r in self.ranges]).T
        self.least = np.array(
            [r.least_size(x) for r, x in zip(self.ranges, self.guess.tolist(), strict=True)]
        )

    @property
    def prior_rows(self) -> Float[np.ndarray, "unknowns unknowns"]:
        """Return M W of the estimated unknowns (all shared)."""
        rows, shared = np.diag(self.prior_weight[self.estimated]), len(self.whitening)
        rows[:shared] = self.whitening @ rows[:shared]
        return rows

    def reached(self, theta: Places) -> Bool[np.ndarray, "members places"]:
        """Return which unknowns lie at a bound."""
        return ((theta <= self.low) | (theta >= self.high)) & ~self.fixed

    def sizes(self, theta: Places) -> Places:
        """Return the size of each unknown, by which its changes are measured: its magnitude or, near zero, a
        typical value.
        """
        return np.asarray(np.maximum(np.abs(theta), self.least))

    def first_guesses(self, count: int) -> Float[np.ndarray, "guesses places"]:
        """Return the first guess, and others on a Latin hypercube over the ranges. Every call returns the
        same guesses.
        """
        theta = np.tile(self.guess, (count, 1))
        if count == 1:
            return theta
        generator = np.random.default_rng(0)
        for place in self.estimated:
            share = (generator.permutation(count - 1) + generator.uniform(size=count - 1)) / (count - 1)
            theta[1:, place] = self.ranges[place].spread(self.guess[place], share)
        return theta

    def split(self, theta: Shaped[np.ndarray, "*members places"]) -> tuple[np.ndarray, np.ndarray]:
        """Return the shared unknowns (*members, shared), and the unknowns of runs (*members, runs, local)."""
        shared, local = self.layout.sizes
        return theta[..., :shared], theta[..., shared:].reshape(*theta.shape[:-1], self.runs, local)


@dataclass(frozen=True)
class _Entry:
    """One unknown quantity, which may consist of several numbers."""

    label: str
    unit: str
    guess: np.ndarray
    range: Range
    fixed: bool = False
    prior: Any = None  # has mean and sigma

    @property
    def labels(self) -> list[str]:
        """Return the name of each number."""
        if self.guess.ndim:
            return [self.label + "".join(f"[{i}]" for i in index) for index in np.ndindex(self.guess.shape)]
        return [self.label]


def unknowns_of(
    scene: Scene,
    runs: Sequence[Experiment],
    free: "Mapping[str, Range | Estimate | PossibleInertia | Callable[..., Any] | None] | Iterable[str]",
    apart: bool = False,
) -> Unknowns:
    """Return the unknowns named in `free` and in `unknown_start`, sensors and actuators of the runs.

    If `free` has a function of the scene for a parameter, this parameter depends on the unknowns (`Tie`). The
    unknowns of a single run count as shared unless `apart`.

    Raises ValueError for unknown names, guesses outside their bounds, parameters with `per_run`, different
    estimates of one shared number, and a fit without unknowns.
    """
    parameters = {name: about for name, _, about in parameters_of(scene)}
    shared: list[tuple[str, Kind, _Entry]] = []
    bodies: list[BodyInertia] = []
    functions = {}
    for name, given in (free if isinstance(free, Mapping) else dict.fromkeys(as_names(free))).items():
        if isinstance(given, PossibleInertia):
            bodies.append(inertia_of_body(scene, name))
            units, ranges = ("kg m^2", ""), (positive(), unbounded(1.0))
            numbers = zip(bodies[-1].labels, units, ranges, bodies[-1].numbers(scene), strict=True)
            shared += [
                (label, "inertia", _entry(label, unit, None, default, np.asarray(guess)))
                for label, unit, default, guess in numbers
            ]
            continue
        check_name(
            name, parameters, f"`free` names `{name}`, which is not a parameter of `{type(scene).__name__}`"
        )
        if isinstance(given, Estimate) and given.per_run:
            raise ValueError(
                f"`free` has a `{name}` for each run, but all runs share the scene; omit `per_run`, or fit "
                "the runs one by one"
            )
        if callable(given):
            functions[name] = given
            continue
        about = parameters[name]
        has_sign = about["positive"] or about["non_negative"]
        default = positive() if has_sign else unbounded()
        entry = _entry(name, about["unit"], given, default, np.asarray(getattr(scene, name)))
        shared.append((name, "scene", _not_negative(entry, about["positive"]) if has_sign else entry))
    of_runs = _of_all_runs(runs)
    shared += [
        (label, "sensor", _of_sensor(label, label, estimate))
        for label, estimate in of_runs.items()
        if not estimate.per_run
    ]
    starts = {name: run.start[name].shape for run in reversed(runs) for name in run.unknown_start}
    own: list[tuple[str, Indices, Kind]] = [
        (name, starts[name], "start")
        for name in dict.fromkeys(name for run in runs for name in run.unknown_start)
    ]
    own += [
        (label, np.shape(estimate.guess), "sensor") for label, estimate in of_runs.items() if estimate.per_run
    ]
    local = _placed(own)
    of_each = [
        _of_run(f"run {index}: {place.name}", place, run) for index, run in enumerate(runs) for place in local
    ]
    if len(runs) == 1 and not apart:
        shared += [(place.name, place.kind, entry) for place, entry in zip(local, of_each, strict=True)]
        local, of_each = (), []
    entries = [*(entry for *_, entry in shared), *of_each]
    if all(entry.fixed for entry in entries):
        raise ValueError(
            "nothing is free; name parameters in `free` "
            f"({', '.join(f'`{name}`' for name in parameters)}), or start values in `unknown_start` of a run"
        )
    each = [entry for entry in entries for _ in range(entry.guess.size)]  # of each number
    guess = np.concatenate([entry.guess.ravel() for entry in entries], dtype=float)
    layout = Layout(
        _placed((name, entry.guess.shape, kind) for name, kind, entry in shared), local, tuple(bodies)
    )
    _check_told_once(layout, functions)
    for name, function in functions.items():
        layout = replace(
            layout,
            ties=(*layout.ties, tied_by(name, function, layout.scene(scene, guess[: layout.sizes[0]]))),
        )
    return Unknowns(
        layout=layout,
        runs=len(runs),
        guess=guess,
        fixed=np.array([entry.fixed for entry in each]),
        ranges=tuple(entry.range for entry in each),
        labels=tuple(label for entry in entries if not entry.fixed for label in entry.labels),
        units=tuple(entry.unit for entry in each if not entry.fixed),
        prior_mean=np.array([0.0 if entry.prior is None else float(entry.prior.mean) for entry in each]),
        prior_weight=np.array(
            [0.0 if entry.prior is None else 1 / float(entry.prior.sigma) for entry in each]
        ),
        whitening=whitening([entry.prior for entry in each[: layout.sizes[0]]]),
    )


def _not_negative(entry: "_Entry", positive: bool) -> "_Entry":
    """Return the unknown with a range that starts at zero, or slightly above zero if `positive`, since the
    scene has no motion below. Raises ValueError for a negative guess.
    """
    if np.any(entry.guess < 0):
        raise ValueError(
            f"first guess of `{entry.label}` is {entry.guess}, but this parameter is declared non-negative; "
            "give zero or more"
        )
    # lower bound of a positive parameter, as a fraction of its first guess
    cut = entry.range.not_below(1e-6 * float(entry.guess.min()) if positive else 0.0)
    return replace(entry, range=cut)


def _placed(parts: Iterable[tuple[str, Indices, Kind]]) -> tuple[Place, ...]:
    """Return the unknowns of `parts` at consecutive places."""
    found: list[Place] = []
    for name, shape, kind in parts:
        found.append(Place(name, shape, found[-1].end if found else 0, kind))
    return tuple(found)


def _check_told_once(layout: Layout, functions: Mapping) -> None:
    """Raise ValueError if a moment of inertia is given twice."""
    told = {place.name: f"`{place.name}`" for place in layout.shared if place.kind == "scene"} | {
        name: f"a function for `{name}`" for name in functions
    }
    for body in layout.bodies:
        for entry in body.entries:
            if entry.name in told:
                raise ValueError(
                    f"`free` has {told[entry.name]} and the possible inertia of `{body.body}`, "
                    f"which determines `{entry.name}`; omit one of them"
                )
        told |= {entry.name: f"the possible inertia of `{body.body}`" for entry in body.entries}


def _of_all_runs(runs: Sequence[Experiment]) -> dict[str, Estimate]:
    """Return estimates of sensors and actuators by name. Raises ValueError if runs give different ones."""
    found: dict[str, tuple[int, Estimate]] = {}
    for index, run in enumerate(runs):
        for label, estimate in run.estimates.items():
            first, known = found.setdefault(label, (index, estimate))
            same = estimate.per_run and known.per_run and np.shape(estimate.guess) == np.shape(known.guess)
            if estimate != known and not same:
                raise ValueError(
                    f"run {first} and run {index} share `{label}` but define it differently ({known} and "
                    f"{estimate}); give both the same, or `per_run=True`"
                )
    return {label: estimate for label, (_, estimate) in found.items()}


def _of_run(label: str, place: Place, run: Experiment) -> _Entry:
    """Return an unknown of one run, held if the run knows it or does not have it."""
    if place.kind == "sensor":
        estimate = run.estimates.get(place.name)
        if estimate is None:
            return _Entry(label, "", np.zeros(place.shape), unbounded(), fixed=True)
        return _of_sensor(label, place.name, estimate)
    guess = np.asarray(run.start.get(place.name, np.zeros(place.shape)))
    if place.name not in run.unknown_start:
        return _Entry(label, "", guess, unbounded(), fixed=True)
    return _entry(label, "", run.unknown_start[place.name], unbounded(), guess)


def _of_sensor(label: str, name: str, estimate: Estimate) -> _Entry:
    number = name.rpartition(".")[2]
    return _entry(label, UNITS[number], estimate, default_range(number), np.asarray(estimate.guess, float))


def _entry(label: str, unit: str, given, default: Range, value: np.ndarray) -> _Entry:
    """Return an unknown from `given`: an `Estimate`, a range, a prior or None. Raises ValueError for an
    invalid first guess.
    """
    guess, found, prior = value, default, None
    if isinstance(given, Estimate):
        guess = value if given.guess is None else np.asarray(given.guess, float)
        found, prior = default if given.range is None else given.range, given.prior
    elif isinstance(given, Range):
        found = given
    elif hasattr(given, "mean") and hasattr(given, "sigma"):
        prior = Estimate(prior=given).prior
    elif given is not None:
        raise ValueError(
            f"`{label}` was given {given!r}; expected `bounds(low, high)`, `positive()`, `unbounded()`, "
            "`Normal(...)`, `Estimate(...)`, None, or a function of the scene that gives its value"
        )
    if guess.shape != value.shape:
        raise ValueError(
            f"first guess of `{label}` has shape {guess.shape}, expected {value.shape}; omit it to begin at "
            "the present value"
        )
    if refusal := found.refusal(guess):
        raise ValueError(f"first guess of `{label}` is {guess}; {refusal}")
    if isinstance(prior, Correlated) and (value.shape or label.startswith("run ")):
        what = f"has {value.size} numbers" if value.shape else "belongs to one run"
        raise ValueError(
            f"`{label}` was given a prior of `joint_normal`, but it {what}; such priors are for shared "
            "parameters of one number"
        )
    return _Entry(label, unit, guess, found, prior=prior)


def check_starts(scene: Scene, runs: Sequence[Experiment], unknowns: Unknowns) -> None:
    """Raise ValueError unless the start of each run satisfies the constraints at the first guess and after
    changes of the unknowns.
    """
    guess, layout = unknowns.guess, unknowns.layout
    change = (
        1e-3 * unknowns.sizes(guess) * np.where(unknowns.fixed, 0.0, np.sin(1.0 + np.arange(guess.size)))
    )  # each unknown changes by another amount
    changes = "violates the constraints when the unknowns change: the values in `start` depend on each other"
    for index, run in enumerate(runs):
        for theta, why in ((guess, "is not admissible"), (guess + change, changes)):
            shared, local = unknowns.split(theta)
            try:
                consistent_start(
                    layout.scene(scene, shared),
                    t0=run.t0,
                    inputs=run.inputs,
                    **layout.start(run.start, shared, local[index]),
                )
            except ValueError as error:
                raise ValueError(f"the start of run {index} {why}. {error}") from None
