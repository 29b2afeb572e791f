"""Configurations put on the geometric rows, to round-off and within the domain; on NumPy, all at once.

    q <- q - G+ g(q),   G = dg/dq                                  Gauss-Newton, which keeps what is near
    min |d g(q)|^2  over  low <= q <= high                         Levenberg-Marquardt, for those that did not arrive, or not inside

d: one over the typical lengths of the rows of G. Where rows are dependent on each other at all assembled configurations (overconstrained linkages),
only a configuration on the rows to round-off shows their rank: directions whose singular value is small are left out of the last steps.
Source: J. Nocedal and S. Wright, Numerical Optimization (2006), section 10.3.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from jourdain_jax.calculus.gauss_newton import Look, nearest_root
from jourdain_jax.calculus.sparse_slopes import Pattern


@dataclass(frozen=True)
class Assembled:
    """Configurations, and how good they are."""

    q: np.ndarray  # (states, coordinates)
    position_error: np.ndarray  # largest residual of the rows, (states,); infinite where it is no number
    error: np.ndarray  # of the coordinates: the last correction, relative to their size; infinite for one that is not on the rows, (states,)
    outside: np.ndarray  # how far outside the domain, in widths of it; zero inside, (states,)

    @property
    def on_rows(self) -> np.ndarray:
        """Whether they are on the rows as well as round-off lets them, (states,)."""
        return np.isfinite(self.error)


def without_rows(q: np.ndarray) -> Assembled:
    """Configurations of a scene that has no geometric rows."""
    return Assembled(q, *np.zeros((3, len(q))))


def assemble(look: Look, pattern: Pattern, q: np.ndarray, low: np.ndarray, high: np.ndarray, generic: np.ndarray, far: int = 0) -> Assembled:
    """Configurations near q on the rows: `look(q[k], k)` gives residuals and slopes of the rows at the states numbered k, these by the entries of a pattern.

    Of the `generic` ones those that find no place inside the domain begin anew elsewhere, until half of them have one. The last `far` ones need none.
    """
    rows = _Rows(look, pattern, typical_lengths(pattern.lengths(look(q, np.arange(len(q)))[1])[generic]), low, high)
    found = _judged(rows, *_newton(rows, q, np.arange(len(q))))
    generator = np.random.default_rng(2)
    for attempt in range(4):
        lost = ~(found.on_rows & (found.outside <= 1e-6)) & (np.arange(len(q)) < len(q) - far)
        if attempt:
            lost &= generic
        if not lost.any() or (attempt and lost.sum() <= generic.sum() / 2):
            break
        begin = np.clip(q, low, high) if not attempt else generator.uniform(low, high, q.shape)
        which = np.flatnonzero(lost)
        again = _judged(rows, *_newton(rows, _damped(rows, begin, which), which))
        better = lost & again.on_rows & (~found.on_rows | (again.outside < found.outside))
        pairs = zip(_parts(found), _parts(again), strict=True)
        found = Assembled(*(np.where(better if a.ndim == 1 else better[:, None], b, a) for a, b in pairs))
    return found


@dataclass(frozen=True)
class _Rows:
    """Rows with their typical lengths, where configurations lie anywhere in the domain: on the rows a row may be of no length at all."""

    look: Look
    pattern: Pattern
    typical: np.ndarray  # (rows,)
    low: np.ndarray
    high: np.ndarray

    @property
    def width(self) -> np.ndarray:
        """The width of the domain; 1 for a coordinate that has one value."""
        return np.where(self.high > self.low, self.high - self.low, 1.0)


def _parts(found: Assembled) -> tuple[np.ndarray, ...]:
    return found.q, found.position_error, found.error, found.outside


def _judged(rows: _Rows, q: np.ndarray, shift: np.ndarray) -> Assembled:
    """Configurations with their last corrections, judged."""
    residual, G = rows.look(q, np.arange(len(q)))
    with np.errstate(invalid="ignore"):
        position_error = np.max(np.abs(residual), axis=1, initial=0.0)
        size = np.maximum(rows.pattern.lengths(G), rows.typical) * (1 + np.max(np.abs(q), axis=1, initial=0.0, keepdims=True))
        # on the rows: residuals of 1e4 units of round-off of what a row changes by when a coordinate changes by its own size, coordinates at rest
        arrived = np.all(np.abs(residual) <= 1e4 * np.finfo(float).eps * size, axis=1) & (shift <= 1e-7)
        outside = np.max(np.maximum(np.maximum(rows.low - q, q - rows.high), 0.0) / rows.width, axis=1, initial=0.0)
    nowhere = lambda x, good: np.where(good & np.isfinite(x), x, np.inf)  # noqa: E731
    return Assembled(q, nowhere(position_error, True), nowhere(shift, arrived), nowhere(outside, True))


def typical_lengths(lengths: np.ndarray) -> np.ndarray:
    """What a row's length is at most states: the median, or the largest for a row that vanishes at half of them; 1 for one that always does."""
    typical = usual_lengths_of(lengths)
    return np.where(typical > 0, typical, 1.0)


def _newton(rows: _Rows, q: np.ndarray, which: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Gauss-Newton at the states `which`; also the last corrections, relative to the coordinates."""
    q, last, typical = np.array(q, float), np.full(len(q), np.inf), rows.typical
    solve = lambda G, g: rows.pattern.shortest(G, g, typical)  # noqa: E731
    q[which], last[which] = nearest_root(lambda q, k: rows.look(q, which[k]), solve, q[which])
    return q, last


def _damped(rows: _Rows, q: np.ndarray, which: np.ndarray) -> np.ndarray:
    """Levenberg-Marquardt within the bounds at the states `which`, in coordinates and rows without units."""
    look, pattern, low, high, width = rows.look, rows.pattern, rows.low, rows.high, rows.width
    q, best = np.array(q, float), q[which]
    residual, G = look(best, which)
    widths = width[pattern.columns]
    d = 1 / typical_lengths(pattern.lengths(G * widths))
    scales = d[pattern.rows]
    f, J = d * residual, scales * G * widths
    damping, moving = np.full(len(which), 1e-2), np.all(np.isfinite(f), axis=1) & np.all(np.isfinite(J), axis=1)
    for _ in range(60):
        k = np.flatnonzero(moving)
        if not k.size:
            break
        step = _damped_step(pattern, J[k], f[k], damping[k])
        held = ((best[k] <= low) & (step < 0)) | ((best[k] >= high) & (step > 0))
        if held.any():
            step = _damped_step(pattern, np.where(held[:, pattern.columns], 0.0, J[k]), f[k], damping[k])
        # at most a quarter of the width of the domain in one step
        step *= np.minimum(1.0, 0.25 / np.maximum(np.max(np.abs(step), axis=1, keepdims=True, initial=0.0), 1e-300))
        trial = np.clip(best[k] + width * step, low, high)
        residual, G = look(trial, which[k])
        f_trial = d * residual
        better = np.sum(f_trial**2, axis=1) < np.sum(f[k] ** 2, axis=1)  # never where it is not a number
        better &= np.all(np.isfinite(G), axis=1)
        at = k[better]
        best[at], f[at], J[at] = trial[better], f_trial[better], scales * G[better] * widths
        damping[k] = np.clip(np.where(better, damping[k] / 6, damping[k] * 5), 1e-14, 1e8)
        moving[k] = (np.max(np.abs(f[k]), axis=1) > 1e-9) & (damping[k] < 1e7)
    q[which] = best
    return q


def _damped_step(pattern: Pattern, J: np.ndarray, f: np.ndarray, damping: np.ndarray) -> np.ndarray:
    """`-J' (J J' + damping)^-1 f` at every state."""
    if pattern.is_sparse:
        return -pattern.transposed_times(J, pattern.solved(J, damping, f))
    J = pattern.dense(J)
    system, diagonal = J @ np.swapaxes(J, 1, 2), np.arange(J.shape[1])
    system[:, diagonal, diagonal] += damping[:, None]
    return -np.einsum("smn,sm->sn", J, np.linalg.solve(system, f[..., None])[..., 0])


def speed_scales(M: Float[np.ndarray, "states speeds speeds"]) -> Float[np.ndarray, "states speeds"]:
    """Scales of the speeds (see `speed_scale`) at many states, by NumPy."""
    diagonal = np.diagonal(M, axis1=1, axis2=2)
    return np.where(diagonal > 0, 1 / np.sqrt(np.where(diagonal > 0, diagonal, 1)), 1)


def typical_row_lengths(A: Float[np.ndarray, "states rows speeds"], elsewhere: Float[np.ndarray, "others rows speeds"]) -> Float[np.ndarray, "rows"]:
    """The length of each row at most states: the median, or the largest for a row that vanishes at half of them.

    A row that is round-off at all `A` of what it is `elsewhere`, off the geometric rows, keeps that length, and so counts as zero.
    """
    length, beyond = (usual_lengths_of(np.sqrt(np.sum(x**2, axis=2))) for x in (A, elsewhere))
    return np.where(length > np.sqrt(np.finfo(A.dtype).eps) * beyond, length, beyond)


def usual_lengths_of(length: Float[np.ndarray, "states rows"]) -> Float[np.ndarray, "rows"]:
    """The median over the states at which all are numbers, or the largest for a row that vanishes at half of them; 0 for one that always does."""
    length = length[np.all(np.isfinite(length), axis=1)]
    if not len(length):
        return np.zeros(length.shape[1], length.dtype)
    median = np.median(length, axis=0)
    return np.where(median > 0, median, length.max(axis=0))
