"""States of a scene's domain, projected onto its constraints: random states, and symmetric configurations
(zero and right angles). A partition of the speeds that is regular at random states may be singular at these.
"""

import itertools
from collections.abc import Iterator
from types import ModuleType

import jax
import numpy as np
from jaxtyping import Float

from jourdain_jax.calculus.reals import Entries, all_finite, array_module, checked_whole
from jourdain_jax.scene.arguments import as_scene, of_known_numbers
from jourdain_jax.scene.scene import Scene, vectors_named
from jourdain_jax.structure.assembly import ENOUGH, Assembled, coordinate_bounds, random_states
from jourdain_jax.structure.probes import Probed, sampled_on_graph

GUESSES = 8  # tuning: guesses of a start, of each kind
NEARLY_INSIDE = 0.05  # numerics: in widths of the domain
NOWHERE_FINITE = (
    "; no constraint is finite anywhere: a contact has no point if a ball is larger than its "
    "hollow cylinder or sphere, or if the gradient of a surface vanishes"
)


class NoStateFoundError(ValueError):
    """Raised if no state of the domain satisfies the geometric constraints and has finite constraints."""


@of_known_numbers
def sample_states(scene: Scene, count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return at most `count` random states (t, q, u) from the scene's domain, on the constraints. Each array
    has a leading axis of states.

    `seed`: seed of the random numbers. Raises ValueError if no state satisfies the geometric constraints, or
    if constraints are NaN at all such states. Raises DifferentiationModeError for traced parameters.
    """
    scene = as_scene(scene)
    checked_whole(count, "`count`", 1, expected="of states, at least 1")
    checked_whole(seed, "`seed`", 0, expected="that is not negative")
    drawn = -(-count // 32) * 32  # a multiple of 32, so that one program serves all small samples
    for t, *begin in drawn_states(scene, drawn, np.random.default_rng(seed)):
        q, u, found = sampled_on_graph(scene, t, *begin)
        numbers = all_finite(u, axis=1)  # projection onto constraints that are NaN gives NaN
        if (found.on_rows & numbers).any():
            break
    good = np.flatnonzero(usable_states(scene, found, np.ones(drawn, bool)) & numbers)[:count]
    if not good.size:
        raise no_numbers(scene, drawn)
    return t[good], q[good], u[good]


def no_numbers(scene: Scene, count: int) -> NoStateFoundError:
    """Return the error for a scene whose constraints are NaN at all of `count` random states."""
    low, high = coordinate_bounds(scene)
    attitude = {first + k for first, _ in scene.coordinates.quaternions for k in range(4)}
    spans = [
        f"`{name}` from {low[i]:.4g} to {high[i]:.4g}"
        for i, name in enumerate(scene.coordinate_names.entries)
        if i not in attitude
    ]
    return NoStateFoundError(
        f"the constraints of `{type(scene).__name__}` are NaN at all of {count} random states, with "
        f"{', '.join(spans)}: a pose, a contact or a constraint is undefined there, such as the square root "
        "of a negative number; state a `domain` in which all are defined, as in `domain = "
        "{'x': (-0.1, 0.1)}`"
    )


def drawn_states(
    scene: Scene, count: int, generator: np.random.Generator
) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Yield states from the domain, not yet projected, and then states near the scene's example, if it
    has one.
    """
    yield random_states(scene, count, generator)
    if scene.example:
        t, q, u = random_states(scene, count, generator)
        low, high = coordinate_bounds(scene)
        # fractions of the domain: constraints may be satisfiable, or defined, only in a small part of it
        near = 10.0 ** -(1.0 + np.arange(count) % 6)
        yield t, vectors_named(scene, scene.example)[0] + near[:, None] * (q - (low + high) / 2), u


def guesses_of(scene: Scene, states: np.ndarray, q, free) -> Float[Entries, "guesses coordinates"]:
    """Return configurations from which to search for a start: some near q; then the `states` on the
    constraints nearest to q, measured in the coordinates that are not `free`; then random ones in the domain.
    """
    low, high = coordinate_bounds(scene)
    elsewhere = np.random.default_rng(3).uniform(low, high, (2 * GUESSES, len(low)))
    near, width = 0.1 * (elsewhere[:GUESSES] - (low + high) / 2), np.where(high > low, high - low, 1.0)
    on, others = array_module(q), (states, near, elsewhere[GUESSES:], free, width)
    if on is np:
        return _guesses(np, np.asarray(q), *others)
    return _traced_guesses(on, jax.lax.stop_gradient(q), *others)


def _guesses(
    on: ModuleType, q, states, near, elsewhere, free, width
) -> Float[Entries, "guesses coordinates"]:
    states = on.asarray(states, q.dtype)
    apart = on.where(free, 0.0, (states - q) / width)
    nearest_first = on.argsort(on.sum(apart**2, axis=1))[:GUESSES]
    return on.concatenate([q + near, states[nearest_first], elsewhere]).astype(q.dtype)


_traced_guesses = jax.jit(_guesses, static_argnums=0)  # one program instead of one per operation


def usable_states(scene: Scene, found: Assembled | Probed, generic: np.ndarray) -> np.ndarray:
    """Return which states are usable: on the geometric constraints to round-off, and inside the domain. If
    few random states are inside, the nearest ones count as well.

    Raises ValueError if no random state satisfies the geometric constraints.
    """
    good = np.isfinite(found.error)
    if not good[generic].any():
        nowhere = "" if np.isfinite(found.position_error[generic]).any() else NOWHERE_FINITE
        raise NoStateFoundError(
            f"no admissible state of `{type(scene).__name__}` was found in its `domain`: positions miss the "
            f"geometric constraints by {np.min(found.position_error[generic]):.1e} or more; state a `domain` "
            "nearer to an assembled configuration, or an `example` on the constraints, or check whether "
            "constraints contradict each other (traced parameters were replaced by numbers near their "
            f"defaults, or near 1 without a default: give defaults near the values in use){nowhere}"
        )
    outside = np.sort(found.outside[good & generic])
    return good & (found.outside <= max(outside[min(ENOUGH, len(outside)) - 1], NEARLY_INSIDE))


def symmetric_configurations(scene: Scene) -> np.ndarray:
    """Return configurations of zeros, with right angles (within the domain) in up to two coordinates. Scenes
    with many coordinates get at most one right angle, and not in all coordinates.
    """
    low, high = coordinate_bounds(scene)
    reference = scene.coordinates.reference()
    attitude = {i + k for i, _ in scene.coordinates.quaternions for k in range(4)}
    turns = [
        (i, a)
        for i in range(len(low))
        if i not in attitude
        for a in (np.pi / 2, -np.pi / 2)
        if low[i] <= a <= high[i]
    ]
    # long chains get fewer configurations: 12,000 coordinates in all, but at least 24 configurations
    most = max(24, min(200, 12_000 // max(1, len(low))))
    if len(turns) < most:
        # pairs of equal angles first, such as the headings of one axle
        pairs = sorted(itertools.combinations(turns, 2), key=lambda pair: pair[0][1] != pair[1][1])
        chosen = [(), *((turn,) for turn in turns), *pairs]
    else:
        chosen = [(), *((turns[k],) for k in np.linspace(0, len(turns) - 1, most - 1).astype(int))]
    still = np.where([i in attitude for i in range(len(low))], reference, np.clip(reference, low, high))
    configurations = np.tile(still, (len(chosen[:most]), 1))
    for q, turned in zip(configurations, chosen, strict=False):
        for i, angle in turned:
            q[i] = angle
    return configurations
