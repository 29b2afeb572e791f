"""References of the atlas that `tests/oracles` does not hold: each a few lines of extended precision."""

import mpmath
import numpy as np
from oracles.rattleback import RUN as CELT
from oracles.reference import LONG, integrate, solve


def celt_without_angles(ts, mu0, w0):
    """mu (downward vertical in body axes) and w of the rattleback (B15), (times, 6): `mu' = mu x w`,
    `I w' + w x I w = rho x F`.
    """
    squares = np.array([LONG(CELT[name]) ** 2 for name in "abc"])
    inertia = np.array([[CELT["A"], CELT["D"], 0], [CELT["D"], CELT["B"], 0], [0, 0, CELT["C"]]], LONG)
    below = np.array([0, 0, CELT["h"]], LONG)

    def rates(_, y):
        mu, w = y[:3], y[3:]
        mu_rate = np.cross(mu, w)
        size = np.sqrt((squares * mu * mu).sum())
        rho = squares * mu / size - below
        rho_rate = squares * mu_rate / size - squares * mu * (squares * mu * mu_rate).sum() / size**3
        v = np.cross(rho, w)  # of the mass centre: -w x rho
        known = np.cross(rho_rate, w) + np.cross(w, v) - LONG(CELT["gravity"]) * mu
        arm = np.array([[0, -rho[2], rho[1]], [rho[2], 0, -rho[0]], [-rho[1], rho[0], 0]])
        return np.concatenate(
            [mu_rate, solve(inertia - arm @ arm, np.cross(rho, known) - np.cross(w, inertia @ w))]
        )

    return integrate(rates, [*mu0, *w0], ts)


def linkage_angle(ts):
    """Angle of the parallel cranks of the n-four-bar (two windows) from upright: `3 a'' = 3.5 g sin a`, a' =
    1 rad/s at the start.
    """
    return integrate(lambda _, y: [y[1], LONG(35) / 30 * LONG(9.81) * np.sin(y[0])], [0.0, 1.0], ts)[:, 0]


def octahedron_rods(points, edges):
    """Rods (6, 3) of half a line-symmetric octahedron, and their rows (6, 9) on its three vertices; `edges`:
    (i, j, whether the rod ends at the image of j).
    """
    turned, rods, rows = (
        np.diag(np.array([-1, -1, 1], points.dtype)),
        [],
        np.zeros((len(edges), 9), points.dtype),
    )
    for k, (i, j, image) in enumerate(edges):
        S = turned if image else np.eye(3, dtype=points.dtype)
        rods.append(points[i] - S @ points[j])
        rows[k, 3 * i : 3 * i + 3] += rods[k]
        rows[k, 3 * j : 3 * j + 3] -= S.T @ rods[k]
    return np.array(rods), rows


def bricard_accelerations(points, velocities, masses, edges):
    """Accelerations (3, 3) of the three vertices of a line-symmetric octahedron under gravity, images turned
    by half a turn about z.

    Six rods `|P - Q| = l` of full rank, `(P - Q).(P'' - Q'') = -|P' - Q'|^2`; vertices count twice, once for
    their image.
    """
    rows, rates = (
        octahedron_rods(np.asarray(points, LONG), edges)[1],
        octahedron_rods(np.asarray(velocities, LONG), edges)[0],
    )
    force = np.tile(np.array([0, 0, -1], LONG) * LONG("9.81"), 3)  # per mass
    W = rows.T / np.repeat(np.asarray(masses, LONG), 3)[:, None]
    return (force + W @ solve(rows @ W, -np.sum(rates**2, axis=1) - rows @ force)).reshape(3, 3)


def ball_on_switched_turntable(ts, x0, v0):
    """x, y, vx, vy: `R'' = (2/7) (Om' z x R + Om z x R')` with Om = -2 tanh(3 (t - 1))."""

    def rates(t, y):
        bent = np.tanh(3 * (t - 1))
        turn, turn_rate = -2 * bent, -6 * (1 - bent**2)
        part = LONG(2) / 7
        return [y[2], y[3], part * (-turn_rate * y[1] - turn * y[3]), part * (turn_rate * y[0] + turn * y[2])]

    return integrate(rates, [*x0, *v0], ts)


def fall_time_slope(lean, end=1.5, radius=0.5):
    """dt*/dlean of a disc at rest that falls from `lean` to `end`: t* = sqrt(5a/(8g)) int dx / sqrt(cos(lean)
    - cos(x)).
    """

    def fall_time(start):
        # x = start + s^2 takes the root at the start away; cos(start) - cos(x) as a product, so that nothing
        # cancels
        def part(s):
            return 2 * s / mpmath.sqrt(2 * mpmath.sin(start + s * s / 2) * mpmath.sin(s * s / 2))

        return mpmath.sqrt(5 * mpmath.mpf(radius) / (8 * mpmath.mpf(9.81))) * mpmath.quad(
            part, [0, mpmath.sqrt(end - start)]
        )

    with mpmath.workdps(30):
        return float(mpmath.diff(fall_time, mpmath.mpf(lean), h=mpmath.mpf("1e-8")))


def slope(value, x, step=1e-4):
    """Derivative of a smooth closed form: central differences, extrapolated once."""
    wide, narrow = ((value(x + h) - value(x - h)) / (2 * h) for h in (step, step / 2))
    return (4 * narrow - wide) / 3
