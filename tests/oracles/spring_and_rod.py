"""Particles under given forces, some held by rigid rods (S12): Newton's equations with the rods' tensions
solved for.

m r'' = F(t, r, v) + sum of tensions; for a rod between points p and q, d = p - q: d.(p'' - q'') = -|d'|^2. No
symmetry, no coordinates, integrated in extended precision, so rod lengths hold to about 1e-15. y is up where
gravity acts.
"""

from collections.abc import Callable, Sequence

import numpy as np

from .reference import LONG, integrate, solve

# A planar example: anchor - spring - particle 0 - rod - particle 1, gravity along -y.
RUN = {
    "masses": (1.0, 0.6),
    "stiffness": 40.0,
    "natural_length": 0.5,
    "damping": 0.0,
    "gravity": 9.81,
    "anchor": (0.0, 0.0),
    "rods": ((0, 1),),
    "r0": ((0.3, -0.6), (0.9, -0.6)),
    "v0": ((0.4, 0.1), (0.4, 0.7)),
    "t_end": 5.0,
}


def newton(t, *, masses: Sequence, force: Callable, r0, v0, rods: Sequence) -> dict[str, np.ndarray]:
    """Positions `r` and velocities `v` (times, particles, dimensions) and rod `tensions` (times, rods, > 0
    pulls).

    **Arguments:** `force(t, r, v)` -> (particles, dimensions), long double kept; `rods`, pairs of particle
    numbers. The start must fit the rods.
    """
    start, speed = np.asarray(r0, LONG), np.asarray(v0, LONG)
    shape = start.shape
    inverse = 1 / np.asarray(masses, LONG)

    def rod_rows(r, v):
        """Directions (rods, particles, dimensions) and |d'|^2 per rod."""
        rows, squares = np.zeros((len(rods), *shape), LONG), np.zeros(len(rods), LONG)
        for k, (i, j) in enumerate(rods):
            rows[k, i], rows[k, j] = r[i] - r[j], r[j] - r[i]
            squares[k] = ((v[i] - v[j]) ** 2).sum()
        return rows, squares

    def accelerations(time, r, v):
        free = np.asarray(force(time, r, v), LONG) * inverse[:, None]
        rows, squares = rod_rows(r, v)
        matrix = np.einsum("kpd,p,lpd->kl", rows, inverse, rows)
        multipliers = solve(matrix, -squares - np.einsum("kpd,pd->k", rows, free))
        return free + np.einsum("k,kpd->pd", multipliers, rows) * inverse[:, None], multipliers

    def rhs(time, y):
        r, v = y.reshape(2, *shape)
        return np.concatenate([y[start.size :], accelerations(time, r, v)[0].ravel()])

    states = integrate(rhs, np.concatenate([start.ravel(), speed.ravel()]), t).reshape(-1, 2, *shape)
    r, v = states[:, 0], states[:, 1]
    tensions = []
    for time, place, velocity in zip(t, r, v, strict=True):
        multipliers = accelerations(time, place.astype(LONG), velocity.astype(LONG))[1]
        lengths = [np.linalg.norm(place[i] - place[j]) for i, j in rods]
        tensions.append(-multipliers.astype(float) * np.array(lengths))
    return {"r": r, "v": v, "tensions": np.array(tensions)}


def spring(p, q, stiffness, natural_length, relative_velocity, damping):
    """Force on the particle at p from a spring (and damper along it) to q."""
    d = p - q
    length = np.sqrt((d * d).sum())
    pull = stiffness * (length - natural_length) + damping * (relative_velocity * d).sum() / length
    return -pull * d / length


def motion(
    t, *, masses, stiffness, natural_length, damping, gravity, anchor, rods, r0, v0, t_end=None
) -> dict[str, np.ndarray]:
    """The example of RUN: particle 0 on a spring to the anchor, the rods between the particles."""
    down = np.zeros(len(anchor), LONG)
    down[1] = -gravity
    fixed = np.asarray(anchor, LONG)

    def force(_, r, v):
        total = np.asarray(masses, LONG)[:, None] * down
        total[0] += spring(r[0], fixed, stiffness, natural_length, v[0], damping)
        return total

    return newton(t, masses=masses, force=force, r0=r0, v0=v0, rods=rods)
