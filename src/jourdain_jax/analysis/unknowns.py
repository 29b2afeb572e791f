"""The unknowns of a fit as one flat vector: parameters of the scene, and initial values of its runs."""

from collections.abc import Iterable, Mapping, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jourdain_jax.analysis.bijections import Bijection, positive, unbounded
from jourdain_jax.analysis.measurements import Measurements
from jourdain_jax.motion.start import start as consistent_start
from jourdain_jax.scene.names import as_names, nearest
from jourdain_jax.scene.parameters import parameters_of
from jourdain_jax.scene.scene import Scene


class Unknown(eqx.Module):
    """A parameter (`run` None) or an initial value of a run, with its first guess."""

    name: str = eqx.field(static=True)
    run: int | None = eqx.field(static=True)
    unit: str = eqx.field(static=True)
    guess: Float[Array, "*shape"]
    bijection: Bijection

    @property
    def labels(self) -> tuple[str, ...]:
        """One name per entry: `offset`, `lengths[0]`, `run 0: heading_rate`."""
        name = self.name if self.run is None else f"run {self.run}: {self.name}"
        return tuple(name + "".join(f"[{i}]" for i in index) for index in np.ndindex(self.guess.shape))


class Unknowns(eqx.Module):
    """All unknowns; z is the flat vector of their free coordinates, theta that of their values."""

    entries: tuple[Unknown, ...]

    @property
    def labels(self) -> tuple[str, ...]:
        """A name for each entry of z and theta."""
        return tuple(label for entry in self.entries for label in entry.labels)

    @property
    def units(self) -> tuple[str, ...]:
        """The unit of each entry of theta."""
        return tuple(entry.unit for entry in self.entries for _ in entry.labels)

    def first_guess(self) -> Float[Array, "unknowns"]:
        """z of the first guess."""
        return jnp.concatenate([jnp.ravel(e.bijection.coordinate(e.guess)) for e in self.entries])

    def values(self, z: Float[Array, "unknowns"]) -> Float[Array, "unknowns"]:
        """theta(z)."""
        return jnp.concatenate([jnp.ravel(e.bijection.value(part, e.guess)) for e, part in self._parts(z)])

    def sizes(self, theta: Float[Array, "unknowns"]) -> Float[Array, "unknowns"]:
        """The magnitude against which changes of each entry are measured."""
        return jnp.concatenate([jnp.ravel(e.bijection.size(part, e.guess)) for e, part in self._parts(theta)])

    def at_bound(self, theta: Float[Array, "unknowns"]) -> Bool[Array, "unknowns"]:
        """Which entries lie at a bound."""
        return jnp.concatenate([jnp.ravel(e.bijection.at_bound(part)) for e, part in self._parts(theta)])

    def put_into(self, scene: Scene, runs: Sequence[Measurements], theta: Float[Array, "unknowns"]) -> tuple[Scene, tuple[Measurements, ...]]:
        """The scene and the runs with these values."""
        parameters: dict[str, Array] = {}
        starts: list[dict[str, Array]] = [{} for _ in runs]
        for entry, part in self._parts(theta):
            target = parameters if entry.run is None else starts[entry.run]
            target[entry.name] = part
        if parameters:
            scene = eqx.tree_at(lambda s: [getattr(s, name) for name in parameters], scene, list(parameters.values()))
        return scene, tuple(eqx.tree_at(lambda r: r.start, run, run.start | known) for run, known in zip(runs, starts, strict=True))

    def _parts(self, flat):
        """Each unknown with its part of a flat vector, in its own shape."""
        ends = np.cumsum([entry.guess.size for entry in self.entries])
        return zip(
            self.entries,
            (p.reshape(e.guess.shape) for e, p in zip(self.entries, jnp.split(flat, ends[:-1]), strict=True)),
            strict=True,
        )


def unknowns_of(scene: Scene, runs: Sequence[Measurements], free: "Mapping[str, Bijection | None] | Iterable[str]") -> Unknowns:
    """The unknowns that `free` and the runs' `unknown_start` name.

    Raises ValueError for unknown names, for guesses outside their bounds, and where nothing is free.
    """
    parameters = {name: (value, about) for name, value, about in parameters_of(scene)}
    entries = []
    for name, bijection in (free if isinstance(free, Mapping) else dict.fromkeys(as_names(free))).items():
        if name not in parameters:
            raise ValueError(f"`free` names `{name}`, which is no parameter of `{type(scene).__name__}`; {nearest(name, parameters)}")
        value, about = parameters[name]
        default = positive() if about["positive"] or about["non_negative"] else unbounded()
        entries.append(Unknown(name, None, about["unit"], value, _chosen(name, bijection, default, value)))
    for index, run in enumerate(runs):
        for name, bijection in run.unknown_start.items():
            guess = run.start[name]
            entries.append(Unknown(name, index, "", guess, _chosen(f"run {index}: {name}", bijection, unbounded(), guess)))
    if not entries:
        raise ValueError(f"nothing is free; name parameters in `free` ({', '.join(f'`{name}`' for name in parameters)}), or `unknown_start` values of a run")
    return Unknowns(tuple(entries))


def _chosen(label: str, bijection, default: Bijection, guess: Array) -> Bijection:
    """The bijection of an unknown, after a look at its first guess."""
    bijection = default if bijection is None else bijection
    if not isinstance(bijection, Bijection):
        raise ValueError(f"`{label}` was given {bijection!r}; expected `bounds(low, high)`, `positive()`, `unbounded()`, or None")
    refusal = "" if isinstance(guess, jax.core.Tracer) else bijection.refusal(np.asarray(guess))
    if refusal:
        raise ValueError(f"first guess of `{label}` is {guess}; {refusal}")
    return bijection


def check_starts(scene: Scene, runs: Sequence[Measurements], unknowns: Unknowns) -> None:
    """ValueError unless the start of each run meets the constraints at the first guess, and still does when the unknowns change.

    Traced values are not checked.
    """
    z = unknowns.first_guess()
    elsewhere = z + 1e-3 * jnp.sin(1.0 + jnp.arange(z.size))  # by unequal amounts
    for vector, changed in ((z, False), (elsewhere, True)):
        moved, moved_runs = unknowns.put_into(scene, runs, unknowns.values(vector))
        for index, run in enumerate(moved_runs):
            try:
                consistent_start(moved, t0=run.t0, inputs=run.inputs, **run.start)
            except ValueError as error:
                why = "no longer meets the constraints when the unknowns change: the values in `start` depend on each other" if changed else "is not admissible"
                raise ValueError(f"the start of run {index} {why}. {error}") from None
