"""Random states of the domain, and configurations projected onto the geometric constraints within the domain,
on NumPy, all at once.

    q <- q - G+ g(q),   G = dg/dq          Gauss-Newton, which stays near its start

Configurations that do not converge, or converge outside the domain, take short steps within the domain
instead, from their start and then from random places. If constraints depend on each other at all assembled
configurations (overconstrained linkages), their rank shows only at configurations accurate to round-off. The
last steps therefore omit directions with small singular values.
"""

from dataclasses import dataclass, fields

import numpy as np
from jaxtyping import Float

from jourdain_jax.calculus.reals import all_finite, eps_of, largest
from jourdain_jax.calculus.roots import Look, nearest_root
from jourdain_jax.calculus.sparse_slopes import Pattern
from jourdain_jax.scene.scene import Scene


@dataclass(frozen=True)
class Assembled:
    """Configurations with their errors."""

    q: np.ndarray  # (states, coordinates)
    position_error: np.ndarray  # largest residual of the rows, (states,); infinite for NaN
    # of the coordinates: the last correction, relative to their size; infinite off the constraints, (states,)
    error: np.ndarray
    outside: np.ndarray  # distance from the domain in its widths; zero inside, (states,)

    @property
    def on_rows(self) -> np.ndarray:
        """Return whether they satisfy the constraints to round-off, (states,)."""
        return np.isfinite(self.error)


def assemble(
    look: Look,
    pattern: Pattern,
    q: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
    generic: np.ndarray,
    tries: int = 4,
) -> Assembled:
    """Return configurations near q on the constraints. `look(q[k], k)` returns residuals and slopes of the
    constraints at the states with indices k; slopes are the nonzero entries of a sparse matrix.

    Configurations of `generic` states that end outside the domain are tried again from random places, up to
    `tries` times.
    """
    width, every = np.where(high > low, high - low, 1.0), np.arange(len(q))
    # off the constraints: at assembled configurations a row may have zero length
    typical = typical_lengths(pattern.lengths(look(q, every)[1])[generic])

    def newton(q: np.ndarray, which: np.ndarray, **limits) -> tuple[np.ndarray, np.ndarray]:
        q, last = np.array(q, float), np.full(len(q), np.inf)
        q[which], last[which] = nearest_root(
            lambda q, k: look(q, which[k]), lambda G, g: pattern.shortest(G, g, typical), q[which], **limits
        )
        return q, last

    def judged(q: np.ndarray, shift: np.ndarray) -> Assembled:
        """Return configurations with their last corrections and errors."""
        residual, G = look(q, every)
        with np.errstate(invalid="ignore"):
            position_error = largest(residual, 1)
            size = np.maximum(pattern.lengths(G), typical) * (1 + largest(q, 1, keepdims=True))
            # converged: residuals below 1e4 units of round-off of the change of a row when a coordinate
            # changes by its own size
            arrived = np.all(np.abs(residual) <= 1e4 * np.finfo(float).eps * size, axis=1) & (shift <= 1e-7)
            outside = np.max(np.maximum(np.maximum(low - q, q - high), 0.0) / width, axis=1, initial=0.0)
        nowhere = lambda x, good: np.where(good & np.isfinite(x), x, np.inf)
        return Assembled(q, nowhere(position_error, True), nowhere(shift, arrived), nowhere(outside, True))

    found, generator = judged(*newton(q, every)), np.random.default_rng(2)
    for attempt in range(tries):
        lost = ~(found.on_rows & (found.outside <= 1e-6)) & (generic | (attempt == 0))
        if not lost.any():
            break
        begin, which = (
            generator.uniform(low, high, q.shape) if attempt else np.clip(q, low, high),
            np.flatnonzero(lost),
        )
        # steps of at most a quarter of the domain's width, within the domain
        near, _ = newton(begin, which, longest=width / 4, within=(low, high))
        again = judged(*newton(near, which))
        better = lost & again.on_rows & (~found.on_rows | (again.outside < found.outside))
        pairs = [(getattr(found, part.name), getattr(again, part.name)) for part in fields(Assembled)]
        found = Assembled(*(np.where(better if a.ndim == 1 else better[:, None], b, a) for a, b in pairs))
    return found


def typical_lengths(lengths: np.ndarray) -> np.ndarray:
    """Return the typical length of each constraint row: the median over states, or the largest if the row
    vanishes at half of them; 1 if it always vanishes.
    """
    typical = usual_lengths_of(lengths)
    return np.where(typical > 0, typical, 1.0)


def speed_scales(M: Float[np.ndarray, "states speeds speeds"]) -> Float[np.ndarray, "states speeds"]:
    """Return scales of the speeds (see `speed_scale`) at many states, by NumPy."""
    diagonal = np.diagonal(M, axis1=1, axis2=2)
    return np.where(diagonal > 0, 1 / np.sqrt(np.where(diagonal > 0, diagonal, 1)), 1)


def typical_row_lengths(
    A: Float[np.ndarray, "states rows speeds"], elsewhere: Float[np.ndarray, "others rows speeds"]
) -> Float[np.ndarray, "rows"]:
    """Return the typical length of each row: the median over states, or the largest if the row vanishes at
    half of them.

    `elsewhere`: rows off the geometric constraints. A row that is only round-off relative to its length there
    gets that length, so that it counts as zero.
    """
    length, beyond = (usual_lengths_of(np.sqrt(np.sum(x**2, axis=2))) for x in (A, elsewhere))
    return np.where(length > np.sqrt(eps_of(A)) * beyond, length, beyond)


def usual_lengths_of(length: Float[np.ndarray, "states rows"]) -> Float[np.ndarray, "rows"]:
    """Return the median over the states with finite entries, or the largest for a row that vanishes at half
    of them; 0 for a row that always vanishes.
    """
    length = length[all_finite(length, axis=1)]
    if not len(length):
        return np.zeros(length.shape[1], length.dtype)
    median = np.median(length, axis=0)
    return np.where(median > 0, median, length.max(axis=0))


# Default domain: wide enough for angles to reach every direction, so that no partition passes by luck.
COORDINATE_DOMAIN = (-3.2, 3.2)
SPEED_DOMAIN = (-1.0, 1.0)


def coordinate_bounds(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Return the lower and upper bound of every coordinate; -1 and 1 for entries of quaternions."""
    low, high = _bounds(scene, scene.coordinate_names.entries, COORDINATE_DOMAIN)
    for first, _ in scene.coordinates.quaternions:
        low[first : first + 4], high[first : first + 4] = -1.0, 1.0
    return low, high


def speed_bounds(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Return the lower and upper bound of every speed."""
    return _bounds(scene, scene.speed_names.entries, SPEED_DOMAIN)


def random_states(
    scene: Scene, count: int, generator: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return states from the domain, not yet projected onto the constraints."""
    q_low, q_high = coordinate_bounds(scene)
    u_low, u_high = speed_bounds(scene)
    q = generator.uniform(q_low, q_high, (count, len(q_low)))
    for first, _ in scene.coordinates.quaternions:
        wxyz = generator.normal(size=(count, 4))
        q[:, first : first + 4] = wxyz / np.linalg.norm(wxyz, axis=1, keepdims=True)
    return generator.uniform(0, 1, count), q, generator.uniform(u_low, u_high, (count, len(u_low)))


def _bounds(scene: Scene, names, default) -> tuple[np.ndarray, np.ndarray]:
    pairs = [scene.domain.get(name, default) for name in names]
    return np.array([p[0] for p in pairs], float), np.array([p[1] for p in pairs], float)
