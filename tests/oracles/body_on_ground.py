"""One body in space with one contact: it flies, rolls, slips and strikes on a ground that may move.

The equations are written from forces, as Newton and Euler have them: `du/dt = g + push + F`, `J alpha = M -
W x J W + arm x F`; rates of the contact point come from a complex step. Impacts are Newton's with Coulomb's
law on the slip afterwards (J. J. Moreau), or go along the normal impulse (W. J. Stronge, Impact Mechanics,
2000). SciPy steps from one phase to the next; the direction of slip from rest is found by a scan of all.
"""

from functools import partial
from types import SimpleNamespace

import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

G = 9.81  # m/s^2
MOST, EVALUATIONS = 200, 40_000  # phases; of the equations
LEAST_REBOUND = 1e-6  # m/s: slower rebounds are left out
REST, FIRST = 1e-8, 1e-7  # m/s: slip that has stopped, and slip that has just begun
ANGLES = np.linspace(0, 2 * np.pi, 1441)
FLIES, ROLLS, SLIPS = range(3)
I = np.eye(3)


def axes(n, numpy):
    """Upwards, along a belt, and about what the ground turns."""
    s, c = (numpy.sin(n.slope), numpy.cos(n.slope)) if n.ground == "plane" else (0.0, 1.0)
    up, along = numpy.stack([s, 0.0 * c, c]), numpy.stack([c, 0.0 * c, -s])
    return up, along, along if "cylinder" in n.ground else up


def cross(a, b):
    return np.array([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


def size(a):
    return np.sqrt(a @ a)


class Body:
    """One case: its equations, and its law of contact."""

    def __init__(self, n, shape, ground, impact):
        self.n, self.shape, self.impact = n, shape, impact
        n.ground = ground
        self.up, self.along, self.axis = axes(n, np)
        self.left = EVALUATIONS
        self.mu, self.moments = abs(n.friction), np.array([n.i_x, n.i_y, n.i_z])

    def touching(self, t, r, q):
        """Gap, normal, place of the contact point from the mass centre, velocity of the ground there."""
        n, side, R = self.n, -1.0 if self.n.ground.startswith("in") else 1.0, turned(q)
        r = r - n.heave * np.sin(5 * t) * self.up
        point = centre = r + R @ np.array([n.c_x, n.c_y, n.c_z])
        upwards = lambda p: (
            self.up if n.ground == "plane" else side * (p - self.axis * (p @ self.axis) * ("cyl" in n.ground))
        )
        d = upwards(centre)
        ring, tyre = {"disc": (n.a, 0.0), "wheel": (n.a - n.b / 4, n.b / 4)}.get(self.shape, (0.0, n.a))
        if self.shape == "ellipsoid":
            m, S = R.T @ d, np.array([n.a, n.b, n.c]) ** 2
            point, tyre = centre - R @ (S * m) / np.sqrt(m @ (S * m)), 0.0
        elif ring:
            d = d - R[:, 1] * (R[:, 1] @ d)
            point = centre - ring * d / size(d)
        d = upwards(point)
        far, normal = size(d), d / size(d)
        gap = (point @ self.up if n.ground == "plane" else side * (far - 1.0)) - tyre
        point = point - tyre * normal
        moves = 5 * n.heave * np.cos(5 * t) * self.up + n.spin * cross(self.axis, point)
        return gap, normal, point - r, moves + n.belt * self.along * (n.ground == "plane")

    def at(self, t, y):
        """All that the law needs: `dw/dt = G F + b` with the slip w and the force F."""
        r, q, v, omega = np.split(y, [3, 7, 10])
        n, h, self.left = self.n, 1e-30j, self.left - 1
        if self.left < 0:  # slip that nearly stops makes steps short
            raise FloatingPointError
        found = self.touching(t + h, r + h * v, q + h * quaternion_rate(q, omega))
        gap, normal, arm, ground = (x.real for x in found)
        turning, arm_rate, ground_rate = (x.imag / 1e-30 for x in found[1:])
        R, W = (R := turned(q)), R @ omega
        by_torque = R @ np.diag(1 / self.moments) @ R.T
        torque = R[:, 1] * n.torque * np.cos(2 * t) - cross(W, R @ (self.moments * omega))
        alpha, a = by_torque @ torque, np.array([n.push * np.sin(3 * t), 0.0, -G])
        K = np.array([cross(arm, e) for e in I]).T
        response = I - K @ by_torque @ K
        b = a + cross(alpha, arm) + cross(W, arm_rate) - ground_rate
        w = v + cross(W, arm) - ground
        t1 = cross(normal, np.array([0.3, -0.8, 0.52]))
        t1 = t1 / size(t1)
        slip = w - normal * (normal @ w)
        e = slip / size(slip) if size(slip) else t1
        return SimpleNamespace(
            gap=gap, n=normal, arm=arm, G=response, b=b, w=w, e=e, slip=size(slip) if self.mu else 1.0, a=a,
            fall=normal @ b + turning @ w, t1=t1, t2=cross(normal, t1), R=R, alpha=alpha, turn=by_torque,
        )  # fmt: skip

    def force(self, p, mode):
        if mode == FLIES:
            return np.zeros(3)
        if mode == ROLLS:
            return -np.linalg.solve(p.G, p.b)
        bears = p.n @ p.G @ (p.n - self.mu * p.e)
        if bears <= 0:  # Painleve's paradox
            raise FloatingPointError
        return (p.n - self.mu * p.e) * (-p.fall / bears)

    def rates(self, mode, t, y):
        p = self.at(t, y)
        F = self.force(p, mode)
        alpha = p.R.T @ (p.alpha + p.turn @ cross(p.arm, F))
        return np.concatenate([y[7:10], quaternion_rate(y[3:7], y[10:]), p.a + F, alpha])

    def law(self, p, b, target):
        """Forces or impulses of a closed contact with the response G L + b, and the direction of slip
        afterwards: None where it sticks.
        """
        L = np.linalg.solve(p.G, target * p.n - b)
        N = p.n @ L
        if N >= 0 and size(L - N * p.n) <= self.mu * N + 1e-12 * size(b):
            return L, None

        def at(angle):
            e = np.multiply.outer(np.cos(angle), p.t1) + np.multiply.outer(np.sin(angle), p.t2)
            u = p.n - self.mu * e
            L = u * ((target - p.n @ b) / (u @ p.G @ p.n))[..., None]
            after = b + L @ p.G
            return np.sum(after * np.cross(p.n, e), -1), np.sum(after * e, -1), L, e

        turns, found = at(ANGLES)[0], []
        for k in np.flatnonzero(turns[:-1] * turns[1:] <= 0):
            angle = np.asarray(brentq(lambda x: at(np.asarray(x))[0], *ANGLES[k : k + 2], xtol=1e-14))
            off, along, L, e = at(angle)
            if abs(off) < 1e-9 * (1 + size(b)) and along > 0 and p.n @ L >= 0:
                found.append((L, e))
        if len(found) != 1:
            raise FloatingPointError
        return found[0]

    def along_the_impulse(self, p, bounce):
        """Impulses: `dw = G (n - mu e) ds` until slip has stopped, then as for a body at rest."""
        first, rest = p.n - self.mu * p.e, self.law(p, -p.n, 0.0)[0]
        slows = -p.e @ p.G @ first
        stop = p.slip / slows if slows > 0 else np.inf
        if abs(cross(p.n, p.e) @ p.G @ first) > 1e-4:  # slip turns
            raise FloatingPointError
        impulse = lambda s: min(s, stop) * first + max(s - stop, 0.0) * rest / (p.n @ rest)
        speed = lambda s: p.n @ (p.w + p.G @ impulse(s))

        def work(s):
            half = min(s, stop)
            return (half * (speed(0) + speed(half)) + (s - half) * (speed(half) + speed(s))) / 2

        most = 1.0
        while speed(most) < -2 * speed(0):
            most *= 2
        compressed = brentq(speed, 0.0, most, xtol=1e-15)
        left = {
            "newton": lambda s: speed(s) + bounce * speed(0),
            "poisson": lambda s: s - (1 + bounce) * compressed,
            "energetic": lambda s: work(s) - (1 - bounce**2) * work(compressed),
        }[self.impact]
        return impulse(brentq(left, compressed, 4 * most, xtol=1e-15) if bounce else compressed)

    def struck(self, y, p, L):
        turned = p.R.T @ (p.turn @ cross(p.arm, L))
        return np.concatenate([y[:7], y[7:10] + L, y[10:] + turned])

    def slipping(self, y, p, e):
        return self.struck(y, p, np.linalg.solve(p.G, FIRST * e)), SLIPS

    def settled(self, t, y):
        """State and mode of a closed contact after an impact or the end of slip."""
        p = self.at(t, y)
        if p.slip <= 2 * REST:
            y = self.struck(y, p, -np.linalg.solve(p.G, p.w))
            p = self.at(t, y)
        if p.fall > 0:
            return y, FLIES
        if p.slip > 2 * REST:
            return y, SLIPS
        _, e = self.law(p, p.b, 0.0)
        return (y, ROLLS) if e is None else self.slipping(y, p, e)

    def closed(self, t, y):
        """State and mode after the gap has closed."""
        p = self.at(t, y)
        falls = p.n @ p.w
        rebounds = -self.n.bounce * falls > LEAST_REBOUND
        bounce = self.n.bounce if rebounds else 0.0
        L = (
            self.law(p, p.w, -bounce * falls)[0]
            if self.impact == "moreau"
            else self.along_the_impulse(p, bounce)
        )
        if L @ (p.w + p.G @ L / 2) > 1e-9 * abs(L @ p.w):  # it gains energy
            raise FloatingPointError
        y = self.struck(y, p, L)
        return (y, FLIES) if rebounds else self.settled(t, y)


def turned(q):
    w, x, y, z = q
    rows = (w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y)), (
        2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x)
    ), (2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z)  # fmt: skip
    return np.array(rows) / (q @ q)


def quaternion_rate(q, omega):
    w, v = q[0], q[1:]
    return 0.5 * np.append(-(v @ omega), w * omega + cross(v, omega))


def followed(n, ts, shape, ground, impact):
    """States of one case at times; NaN where the law has no answer, or after too many phases."""
    q = np.array([n.attitude_w, n.attitude_x, n.attitude_y, n.attitude_z])
    speeds = [n.x_rate, n.y_rate, n.z_rate, n.attitude_omega_x, n.attitude_omega_y, n.attitude_omega_z]
    body, t, found, mode = Body(n, shape, ground, impact), 0.0, [], FLIES
    y = np.concatenate([[n.x, n.y, n.z], q / size(q), speeds])
    try:
        for _ in range(MOST):
            for run in _phase(body, t, y, mode, ts[-1]):
                t, y = run.t[-1], run.y[:, -1]
                found += [run.sol(at) for at in ts[len(found) :] if at <= t]
                if len(found) == len(ts):
                    return np.array(found)
            if run.status != 1:
                break
            if mode == FLIES:
                y, mode = body.closed(t, y)
            elif len(run.t_events[0]):
                mode = FLIES
            elif mode == ROLLS:  # it slips against the force that held it
                F = body.force(p := body.at(t, y), ROLLS)
                T = F - p.n * (p.n @ F)
                y, mode = body.slipping(y, p, -T / size(T))
            else:
                y, mode = body.settled(t, y)
    except FloatingPointError:
        pass
    return np.full((len(ts), 13), np.nan)


def _phase(body, t, y, mode, end):
    def leaves(t, y):
        p = body.at(t, y)
        return p.gap if mode == FLIES else p.n @ body.force(p, mode)

    def slides(t, y):
        p = body.at(t, y)
        if mode == ROLLS:
            F = body.force(p, mode)
            N = p.n @ F
            return body.mu * N - size(F - p.n * N)
        return p.slip - REST if mode == SLIPS else 1.0

    rates, p = partial(body.rates, mode), body.at(t, y)
    if mode == FLIES and p.gap < 1e-9:  # from the ground: the first half of a flight has no event
        rise = p.n @ p.w
        half = min(-rise / p.fall if p.fall < 0 < rise else 1e-4, 1e-3, end - t)
        yield (first := piece(rates, t, y, t + half))
        t, y = first.t[-1], first.y[:, -1]
    if t < end:
        yield piece(rates, t, y, end, [leaves, slides], "LSODA" if mode == SLIPS else "DOP853")


def piece(rates, t, y, end, events=(), method="DOP853"):
    """A piece of a motion, until the value of one of the events falls through zero."""
    for event in events:
        event.terminal, event.direction = True, -1
    rtol = 1e-12 if method == "DOP853" else 1e-10
    return solve_ivp(
        rates, (t, end), y, method, rtol=rtol, atol=rtol / 10, max_step=0.02, events=events or None,
        dense_output=True,
    )  # fmt: skip
