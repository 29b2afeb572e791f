"""Contacts with friction: a disc with its mass centre off its axle, in a plane, that flies, rolls, slips and
strikes, against SciPy.

SciPy steps from one phase to the next. The equations are written from forces, as Newton and Euler have them;
impacts are Newton's with Coulomb's law on the slip afterwards, or go step by step along the normal impulse.
"""

from functools import partial

import jax.numpy as jnp
import numpy as np

import jourdain_jax as jj
from hunting.family import Ask, Family, G, drawn, either, one_by_one, one_of, piece

MOST = 200
LEAST_REBOUND = 1e-6  # m/s: slower rebounds are left out here; the engine sums them
FLIES, ROLLS, SLIPS = range(3)


class Eccentric(jj.Scene):
    """A disc of unit mass above the plane z = 0, pushed along it and turned."""

    radius: object = jj.parameter(0.3)
    offset: object = jj.parameter(0.05)
    gyration: object = jj.parameter(0.2)
    friction: object = jj.parameter(0.3)
    bounce: object = jj.parameter(0.0)
    push: object = jj.parameter(0.0)
    torque: object = jj.parameter(0.0)
    slope: object = jj.parameter(0.0)
    coordinates = jj.coordinates("x z turn")
    domain = {"x": (-1, 1), "z": (0.2, 1.0)}
    impact = "moreau"

    def bodies(self, t, q):
        R = jj.rot_y(q.turn)
        place = jnp.stack([q.x, 0.0, q.z]) + self.offset * R[:, 2]
        return {"disc": jj.RigidBody(1.0, self.gyration**2 * jnp.array([0.5, 1.0, 0.5]), place, R)}

    def loads(self, motion):
        down = jnp.stack([jnp.sin(self.slope), 0.0, -jnp.cos(self.slope)])
        push = jj.generalized_force(
            motion, x_rate=self.push * jnp.sin(3 * motion.t), turn_rate=self.torque * jnp.cos(2 * motion.t)
        )
        return jj.gravity(motion, G, down), push

    def contacts(self, pose):
        law = {"friction": self.friction, "restitution": self.bounce, "impact": self.impact}
        centre = jnp.stack([0.0, 0.0, -self.offset])
        return {"rim": jj.disc_contact(pose["disc"], self.radius, centre=centre, height="row", **law)}


class _Disc:
    """One case: its equations, and its law of contact."""

    def __init__(self, n, impact):
        self.n, self.impact = n, impact
        self.rows = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, -n.radius]])  # of the gap and of slip

    def equations(self, t, y):
        n, (c, s), w = self.n, (np.cos(y[2]), np.sin(y[2])), y[5]
        M = np.array(
            [
                [1, 0, n.offset * c],
                [0, 1, -n.offset * s],
                [n.offset * c, -n.offset * s, n.offset**2 + n.gyration**2],
            ]
        )
        h = np.array([-n.offset * s * w**2, -n.offset * c * w**2, 0.0])
        gx, gz = G * np.sin(n.slope), -G * np.cos(n.slope)
        Q = np.array(
            [gx + n.push * np.sin(3 * t), gz, n.offset * (gx * c - gz * s) + n.torque * np.cos(2 * t)]
        )
        return M, Q - h

    def forces(self, t, y, mode, side):
        """Accelerations, and the normal and tangential force; `side`: the sign of slip."""
        M, f = self.equations(t, y)
        if mode == FLIES:
            return np.linalg.solve(M, f), 0.0, 0.0
        held = self.rows if mode == ROLLS else self.rows[:1]
        pulls = held.T if mode == ROLLS else self.rows.T @ [[1.0], [-self.n.friction * side]]
        K = np.block([[M, -pulls], [held, np.zeros((len(held), pulls.shape[1]))]])
        a = np.linalg.solve(K, np.concatenate([f, np.zeros(len(held))]))
        normal = a[3]
        return a[:3], normal, a[4] if mode == ROLLS else -self.n.friction * side * normal

    def law(self, G, b, target):
        """Forces or impulses of a closed contact with the response G L + b, and the sign of slip afterwards:
        0 where it sticks, NaN without an answer.
        """
        L = np.linalg.solve(G, np.array([target - b[0], -b[1]]))
        if L[0] >= 0 and abs(L[1]) <= self.n.friction * L[0]:
            return L, 0.0
        for side in (1.0, -1.0):
            normal = (target - b[0]) / (G[0, 0] - self.n.friction * side * G[0, 1])
            L = np.array([normal, -self.n.friction * side * normal])
            if normal >= 0 and side * (b + G @ L)[1] >= 0:
                return L, side
        return L, np.nan

    def along_the_impulse(self, G, w, bounce):
        """Impulses, and the sign of slip at the end: `dw = G (1, -mu sign(w_t)) ds`, or with slip held."""
        mu, w, L, work, spent, compressed = self.n.friction, w.copy(), np.zeros(2), 0.0, None, None
        goal, held = -bounce * w[0], -G[0, 1] / G[1, 1]
        side = np.sign(w[1])
        for _ in range(8):
            if side == 0 or (abs(w[1]) < 1e-14 and G[1] @ [1, -mu * side] * side < 0):  # slip has stopped
                side = 0.0 if abs(held) <= mu else -np.sign(held)
            step = np.array([1.0, held if side == 0 else -mu * side])
            slope = G @ step
            lengths = [-w[1] / slope[1]] if side * slope[1] < 0 and abs(w[1]) > 1e-14 else []
            if spent is None:
                lengths += [-w[0] / slope[0]] if slope[0] > 0 else []
            elif self.impact == "newton":
                lengths.append((goal - w[0]) / slope[0])
            elif self.impact == "poisson":
                lengths.append((1 + bounce) * compressed - L[0])
            else:  # w_n s + slope s^2/2 is the work that is left
                left = bounce**2 * spent - work
                lengths.append((np.sqrt(w[0] ** 2 + 2 * slope[0] * left) - w[0]) / slope[0])
            s = min(lengths)
            done, lasts = (
                spent is not None and s == lengths[-1],
                spent is None and slope[0] > 0 and s == lengths[-1],
            )
            L, work, w = L + s * step, work + s * (w[0] + slope[0] * s / 2), w + s * slope
            if done:
                return L, side if abs(w[1]) > 1e-9 else 0.0
            if lasts:
                w[0], spent, compressed, work = 0.0, -work, L[0], 0.0
            elif s == lengths[0]:
                w[1] = 0.0
        raise FloatingPointError

    def response(self, t, y):
        M, f = self.equations(t, y)
        X = np.linalg.solve(M, self.rows.T)
        return X, self.rows @ X, self.rows @ np.linalg.solve(M, f), self.rows @ y[3:]

    def settled(self, t, y):
        """Mode and side of a closed contact at rest."""
        _, G, b, _ = self.response(t, y)
        if b[0] > 0:
            return FLIES, 0.0
        _, side = self.law(G, b, 0.0)
        return (ROLLS, 0.0) if side == 0 else (SLIPS, side)

    def closed(self, t, y):
        """State, mode and side after the gap has closed."""
        X, G, _, w = self.response(t, y)
        rebounds = -self.n.bounce * w[0] > LEAST_REBOUND
        bounce = self.n.bounce if rebounds else 0.0
        if self.impact == "moreau":
            L, side = self.law(G, w, -bounce * w[0])
        else:
            L, side = self.along_the_impulse(G, w, bounce)
        if np.isnan(side) or L @ (w + G @ L / 2) > 1e-9 * abs(L @ w):  # it gains energy
            raise FloatingPointError
        y = np.concatenate([y[:3], y[3:] + X @ L])
        if rebounds:
            return y, FLIES, 0.0
        slip = w[1] + (G @ L)[1]
        if side != 0 and abs(slip) > 1e-9:
            return y, SLIPS, np.sign(slip)
        return y, *self.settled(t, y)


def _followed(n, ts, impact):
    """States of one case at times; NaN where the law has no answer, or after too many phases."""
    disc, t, found = _Disc(n, impact), 0.0, []
    y = np.array([n.x, n.z, n.turn, n.x_rate, n.z_rate, n.turn_rate])
    mode, side = FLIES, 0.0
    try:
        for _ in range(MOST):
            for run in _phase(disc, t, y, mode, side, ts[-1]):
                t, y = run.t[-1], run.y[:, -1]
                found += [run.sol(at) for at in ts[len(found) :] if at <= t]
                if len(found) == len(ts):
                    return np.array(found)
            if mode == FLIES:
                y, mode, side = disc.closed(t, y)
            elif len(run.t_events[0]):
                mode = FLIES
            elif mode == ROLLS:  # it slips against the force that held it
                mode, side = SLIPS, -np.sign(disc.forces(t, y, ROLLS, 0.0)[2])
            else:
                mode, side = disc.settled(t, y)
    except FloatingPointError:
        pass
    return np.full((len(ts), 6), np.nan)


def _phase(disc, t, y, mode, side, end):
    def rates(t, y):
        return np.concatenate([y[3:], disc.forces(t, y, mode, side)[0]])

    def leaves(t, y):
        return y[1] - disc.n.radius if mode == FLIES else disc.forces(t, y, mode, side)[1]

    def slides(t, y):
        if mode == ROLLS:
            _, normal, tangential = disc.forces(t, y, mode, side)
            return disc.n.friction * normal - abs(tangential)
        return side * (disc.rows[1] @ y[3:]) if mode == SLIPS else 1.0

    leaves.direction = slides.direction = -1
    if (
        mode == FLIES and y[1] - disc.n.radius < 1e-9
    ):  # from the ground: the first half of a flight has no event
        falls = -disc.forces(t, y, FLIES, 0.0)[0][1]
        half = min(y[4] / falls if falls > 0 and y[4] > 0 else 1e-4, 1e-3, end - t)
        yield (first := piece(rates, t, y, t + half))
        t, y = first.t[-1], first.y[:, -1]
    if t < end:
        yield piece(rates, t, y, end, [leaves, slides])


WAYS = ("simulate", "jit", "vmap", "rollout")
WHAT = "a disc with its mass centre off its axle that flies, rolls, slips and strikes"
FAMILIES = tuple(
    Family(
        name="friction" if law == "moreau" else f"friction {law}", what=f"{WHAT}; impacts: {law}",
        scene=type(law, (Eccentric,), {"impact": law}),
        truth=one_by_one(partial(_followed, impact=law)),
        names="x z turn x_rate z_rate turn_rate",
        draw=drawn(
            radius=(0.2, 0.4), offset=one_of(0.0, (0.0, 0.1)), gyration=(0.1, 0.3),
            friction=one_of(0.0, (0.05, 1.0), 2.0), bounce=one_of(0.0, (0.0, 0.9), 1.0),
            push=one_of(0.0, (-6, 6)), torque=one_of(0.0, (-1, 1)), slope=one_of(0.0, (-0.4, 0.4)), x=(-1, 1),
            z=(0.41, 0.8), turn=(-3, 3), x_rate=either(0, 3),
            z_rate=(-2, 1), turn_rate=(-10, 10), t0=0.0, span=one_of(0.5, (0.3, 1.5)),
        ),
        asks=tuple(
            Ask(WAYS[i % 4], (1, 2, 33)[i % 3], (1e-7, 1e-10)[i // 4 % 2], {"max_transitions": MOST})
            for i in range(24)
        ),
        cases=cases, slack=0.1,
    )
    for law, cases in (("moreau", 48), ("newton", 12), ("poisson", 12), ("energetic", 12))
)  # fmt: skip
