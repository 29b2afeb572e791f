"""Random states of a scene's domain, and projection of configurations onto the geometric constraints. NumPy
projects all configurations at once, and keeps them within the domain if possible.

    q <- q - G+ g(q),   G = dg/dq          Gauss-Newton, which stays near its start

A search that does not converge, or ends outside the domain, is repeated by short steps within the domain,
first from the same start and then from random places. In overconstrained linkages, constraints depend on each
other at all assembled configurations. Their rank can be seen only at configurations accurate to round-off, so
the last steps omit directions with small singular values.
"""

from dataclasses import dataclass, fields

import numpy as np
from jaxtyping import Float

from jourdain_jax.calculus.reals import all_finite, eps_of, largest
from jourdain_jax.calculus.roots import Look, nearest_root
from jourdain_jax.calculus.sparse_slopes import Pattern
from jourdain_jax.scene.scene import Scene

ENOUGH = 8  # numerics: this number of random states inside the domain suffices


@dataclass(frozen=True)
class Assembled:
    """Configurations with their errors."""

    q: np.ndarray  # (states, coordinates)
    position_error: np.ndarray  # largest residual of the rows, (states,); infinite for NaN
    error: np.ndarray  # last correction of q, relative to 1 + |q|, (states,); infinite off the constraints
    outside: np.ndarray  # distance from the domain relative to its width, (states,); zero inside

    @property
    def on_rows(self) -> np.ndarray:
        """Return which configurations satisfy the constraints to round-off, (states,)."""
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
    """Return configurations near q on the constraints, between `low` and `high` if possible.

    `look(q[k], k)`: residuals of the constraints, and the entries of their Jacobian with this `pattern`, at
    the states with indices k. `generic`: which states are random. If a random state ends outside the domain,
    its search is repeated from random places, up to `tries` times.
    """
    width, every = np.where(high > low, high - low, 1.0), np.arange(len(q))
    # lengths off the constraints: at assembled configurations a row may have zero length
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
            # converged: residuals below 1e4 eps times the change of a row if a coordinate changes by its size
            arrived = np.all(np.abs(residual) <= 1e4 * np.finfo(float).eps * size, axis=1) & (shift <= 1e-7)
            outside = np.max(np.maximum(np.maximum(low - q, q - high), 0.0) / width, axis=1, initial=0.0)
        nowhere = lambda x, good: np.where(good & np.isfinite(x), x, np.inf)
        return Assembled(q, nowhere(position_error, True), nowhere(shift, arrived), nowhere(outside, True))

    found, generator = judged(*newton(q, every)), np.random.default_rng(2)
    for attempt in range(4 * tries):
        inside = found.on_rows & (found.outside <= 1e-6)
        lost = ~inside & (generic | (attempt == 0))
        if not lost.any() or (attempt >= tries and np.sum(inside & generic) >= ENOUGH):
            break
        begin = generator.uniform(low, high, q.shape) if attempt else np.clip(q, low, high)
        which = np.flatnonzero(lost)
        # steps of at most a quarter of the domain's width, within the domain
        near, _ = newton(begin, which, longest=width / 4, within=(low, high))
        again = judged(*newton(near, which))
        better = lost & again.on_rows & (~found.on_rows | (again.outside < found.outside))
        pairs = [(getattr(found, part.name), getattr(again, part.name)) for part in fields(Assembled)]
        found = Assembled(*(np.where(better if a.ndim == 1 else better[:, None], b, a) for a, b in pairs))
    return found


def typical_lengths(lengths: np.ndarray) -> np.ndarray:
    """Return the typical length of each constraint row: as `usual_lengths_of`, but 1 for a row that always
    vanishes.
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
    """Return the typical length of each row, as `usual_lengths_of`.

    `elsewhere`: the rows at states off the geometric constraints. A row that is mere round-off relative to
    its length there gets that length, and so counts as zero.
    """
    length, beyond = (usual_lengths_of(np.sqrt(np.sum(x**2, axis=2))) for x in (A, elsewhere))
    return np.where(length > np.sqrt(eps_of(A)) * beyond, length, beyond)


def usual_lengths_of(length: Float[np.ndarray, "states rows"]) -> Float[np.ndarray, "rows"]:
    """Return the median length of each row over the states with finite entries. For a row that vanishes at
    half of the states return the largest length, which is 0 if it always vanishes.
    """
    length = length[all_finite(length, axis=1)]
    if not len(length):
        return np.zeros(length.shape[1], length.dtype)
    median = np.median(length, axis=0)
    return np.where(median > 0, median, length.max(axis=0))


# Default domain: angles reach every direction, so that a partition that is singular somewhere is found.
COORDINATE_DOMAIN = (-3.2, 3.2)  # physics
SPEED_DOMAIN = (-1.0, 1.0)  # physics


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
