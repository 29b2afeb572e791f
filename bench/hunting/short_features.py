"""Features that act in a small part of the way or of the time, and constraints that lose their slope between
two steps.

Motions are free between the features, where nothing bounds a step but the rules for its length.
"""

import jax.numpy as jnp
import numpy as np
from scipy.interpolate import CubicHermiteSpline
from small_scenes import InSpace, OnLine, OnPlane

import jourdain_jax as jj
from hunting.family import Ask, Family, G, drawn, one_by_one, power, stopped
from hunting.pendulums import Weighted


class Strip(OnLine):
    """A mass that slides freely along x, and is braked by `force` N on a strip from `at` to `at + width`
    m.
    """

    force: object = jj.parameter(1.0)
    at: object = jj.parameter(1.0)
    width: object = jj.parameter(0.1)

    def loads(self, motion):
        x = motion.q.x
        inside = (x > self.at) & (x < self.at + self.width)
        return jj.generalized_force(motion, x_rate=jnp.where(inside, -self.force, 0.0))


class Pulse(Strip):
    """A free mass under a force that acts from the time `at` for `width` s."""

    def loads(self, motion):
        since = motion.t - self.at
        push = self.force * jnp.sign(jnp.maximum(since, 0.0)) * jnp.where(since < self.width, 1.0, 0.0)
        return jj.generalized_force(motion, x_rate=push)


class Bump(Strip):
    """A mass on a road that is flat but for a bump of height `force` m with the shape of a cosine."""

    def bodies(self, t, q):
        phase = (q.x - self.at) / self.width
        rise = jnp.where((phase > 0.0) & (phase < 1.0), 1.0 - jnp.cos(2 * jnp.pi * phase), 0.0)
        return {"mass": jj.Particle(1.0, [q.x, 0.0, 0.5 * self.force * rise])}

    def loads(self, motion):
        return jj.gravity(motion, G)


def _strip_truth(n, ts):
    """Speed v before the strip, (v^2 - 2 F w)^(1/2) behind it."""
    v, f, a, w = n.x_rate, n.force, n.at, n.width
    behind, enters = np.sqrt(v * v - 2 * f * w), a / v
    leaves, inside = enters + (v - behind) / f, ts - enters
    x = np.where(
        ts < enters,
        v * ts,
        np.where(ts < leaves, a + v * inside - f / 2 * inside**2, a + w + behind * (ts - leaves)),
    )
    return x, np.where(ts < enters, v, np.where(ts < leaves, v - f * inside, behind))


def _pulse_truth(n, ts):
    during, after = np.clip(ts - n.at, 0.0, n.width), np.maximum(ts - n.at - n.width, 0.0)
    return n.x_rate * ts + n.force * (during**2 / 2 + during * after), n.x_rate + n.force * during


@one_by_one
def _bump_truth(n, ts):
    """xdot^2 (1 + z'^2) + 2 g z = v^2; the time over the bump by quadrature, of order 10 in 400 pieces."""
    v, h, a, w = n.x_rate, n.force, n.at, n.width

    def speed(x):
        phase = 2 * np.pi * (x - a) / w
        z, slope = h / 2 * (1 - np.cos(phase)), h * np.pi / w * np.sin(phase)
        return np.sqrt((v * v - 2 * G * z) / (1 + slope**2))

    nodes, weights = np.polynomial.legendre.leggauss(5)
    grid = np.linspace(a, a + w, 401)
    half = np.diff(grid)[:, None] / 2
    passed = np.sum(weights * half / speed((grid[1:] + grid[:-1])[:, None] / 2 + half * nodes), axis=1)
    at = a / v + np.concatenate([[0.0], np.cumsum(passed)])
    x = np.where(ts < at[0], v * ts, a + w + v * (ts - at[-1]))
    over = (ts >= at[0]) & (ts <= at[-1])
    x[over] = CubicHermiteSpline(at, grid, speed(grid))(ts[over])
    return np.stack([x, np.where(over, speed(x), v)], axis=1)


STRIPS = drawn(
    x_rate=(1.0, 4.0), width=power(-2.2, -0.7),
    force=lambda r, n: r.uniform(0.1, 0.4) * n.x_rate * n.x_rate / (2 * n.width), at=(0.5, 2.0), span=3.0,
)  # fmt: skip
PULSES = drawn(
    width=lambda r, n: 3.0 * 10 ** r.uniform(-2.2, -0.9), x_rate=(-2.0, 2.0),
    force=lambda r, n: r.uniform(-2.0, 2.0) / n.width, at=(0.3, 2.5), span=3.0,
)  # fmt: skip
BUMPS = drawn(
    x_rate=(2.0, 4.0), width=power(-1.5, -0.5),
    force=lambda r, n: r.uniform(0.2, 0.5) * min(n.width, n.x_rate**2 / (2 * G)), at=(0.5, 3.0), span=3.0,
)  # fmt: skip


# Events with a short negative part. -------------------------------------------------------------------------


class Window(Strip):
    """A free mass that stops where it comes within `width` of `at`."""

    def loads(self, motion):
        return ()

    def events(self, motion):
        return {"near": jnp.abs(motion.q.x - self.at) - self.width}


class Gate(Window):
    """A window of `where` in place of the distance."""

    def events(self, motion):
        x = motion.q.x
        return {"near": jnp.where((x > self.at - self.width) & (x < self.at + self.width), -1.0, 1.0)}


def _window_truth(n, ts):
    t_end = (n.at - n.width) / n.x_rate
    return stopped(lambda t: (n.x_rate * t, n.x_rate), t_end, ["near"] * len(t_end), ts)


WINDOWS = drawn(x_rate=(0.7, 4.0), at=(0.5, 2.0), width=power(-4.0, -1.0), span=3.0)


# Speeds and constraints that lose their slope. --------------------------------------------------------------


class TurnedSpeed(jj.Scene):
    """A free turning wheel with the speed w = sin(q) qdot, whose inverse is infinite at q = 0."""

    coordinates = jj.coordinates("q")
    speeds = jj.speeds("w")
    domain = {"q": (0.4, 1.5)}

    def coordinate_rates(self, t, q, u):
        return jnp.stack([u.w / jnp.sin(q.q)])

    def bodies(self, t, q):
        return {"wheel": jj.RigidBody(1.0, jnp.ones(3), jnp.zeros(3), jj.rot_z(q.q))}


class SwingSpeed(TurnedSpeed):
    """A speed by the cosine in place of the sine."""

    domain = {"q": (-1.0, 1.0)}

    def coordinate_rates(self, t, q, u):
        return jnp.stack([u.w / jnp.cos(q.q)])


def _turned(name, scene, weight, weight_of_start, first):
    """q = q0 + r t; it passes the place where the rate of the coordinate is infinite."""
    return Family(
        name=name, what="a quasi-velocity whose coordinate rate is infinite at one place", scene=scene,
        names="q w", cases=40,
        truth=lambda n, ts: (n.q + n.rate * ts, weight(n.q + n.rate * ts) * n.rate),
        start=lambda n: {"w": weight_of_start(n.q) * n.rate},
        draw=drawn(q=first, rate=lambda r, n: -r.uniform(0.5, 2.0), span=(0.3, 3.0)),
    )  # fmt: skip


class EvenPace(Weighted, InSpace):
    """Appell and Hamel's constraint zdot^2 = k^2 (xdot^2 + ydot^2): without slope where the speeds vanish, at
    the top of the throw.
    """

    slope: object = jj.parameter(1.0)

    def velocity_constraints(self, motion):
        u = motion.u
        return {"pace": u.z_rate**2 - self.slope**2 * (u.x_rate**2 + u.y_rate**2)}


def _pace_truth(n, ts):
    """Along its straight line the mass is slowed by g k^2/(1 + k^2) in z; at the top the constraint no longer
    determines the motion, which has no truth.
    """
    k, c, s = n.slope, np.cos(n.turn), np.sin(n.turn)
    pull = G * k * k / (1 + k * k)
    z, up = k * n.v * ts - pull / 2 * ts**2, k * n.v - pull * ts
    return c * z / k, s * z / k, z, c * up / k, s * up / k, up


def _until_top(r, n):
    """A share of the time to the top, or beyond it."""
    k = n.slope
    return r.choice([0.7, r.uniform(1.2, 2.0)]) * (k * n.v / (G * k * k / (1 + k * k)))


class SetPace(OnPlane):
    """A mass whose speed is prescribed by xdot^2 + ydot^2 = (pace cos t)^2: without slope where the pace
    passes zero.
    """

    pace: object = jj.parameter(1.0)

    def velocity_constraints(self, motion):
        return {"pace": motion.u.x_rate**2 + motion.u.y_rate**2 - (self.pace * jnp.cos(motion.t)) ** 2}


def _set_pace_truth(n, ts):
    """Straight ahead, and, without a force, straight back: pace sin t."""
    c, s = n.pace * np.cos(n.turn), n.pace * np.sin(n.turn)
    return c * np.sin(ts), s * np.sin(ts), c * np.cos(ts), s * np.cos(ts)


ASKS = (Ask("simulate"), Ask("jit", 33), Ask("rollout", 9, 1e-6), Ask("vmap", 3), Ask("simulate", 9, 1e-6))
LINE, ROWS = {"names": "x x_rate", "cases": 63}, {"cases": 42, "single": False, "asks": ASKS}
FAMILIES = (
    Family(
        "strip", "a free mass that a strip of 0.6 to 20 cm brakes", Strip, STRIPS, _strip_truth, **LINE,
    ),
    Family("pulse", "a force for 0.6 to 12 % of the span", Pulse, PULSES, _pulse_truth, **LINE),
    Family(
        "bump", "a flat road with a bump of 3 to 30 cm", Bump, BUMPS, _bump_truth,
        **LINE | {"cases": 42, "single": False},
    ),
    Family(
        "window", "an event within 0.1 to 100 mm of a place, by `abs`", Window, WINDOWS, _window_truth,
        **LINE,
    ),
    Family("gate", "the same by `where`", Gate, WINDOWS, _window_truth, **LINE | {"cases": 42}),
    _turned("turned-speed", TurnedSpeed, np.sin, jnp.sin, (0.4, 1.5)),
    _turned("swing-speed", SwingSpeed, np.cos, jnp.cos, (-1.0, 1.0)),
    Family(
        name="even-pace", what="Appell and Hamel's constraint up to the top of the throw, and beyond",
        scene=EvenPace, truth=_pace_truth,
        draw=drawn(slope=(0.5, 2.0), v=(1.0, 3.0), turn=(0.0, 6.0), span=_until_top),
        names="x y z x_rate y_rate z_rate", **ROWS,
        start=lambda n: {
            "x_rate": n.v * jnp.cos(n.turn), "y_rate": n.v * jnp.sin(n.turn), "z_rate": n.slope * n.v,
        },
    ),
    Family(
        name="set-pace", what="a prescribed magnitude of the velocity that passes zero", scene=SetPace,
        truth=_set_pace_truth, names="x y x_rate y_rate",
        draw=drawn(pace=(0.5, 3.0), turn=(0.0, 6.0), span=(1.0, 4.5)), **ROWS,
        start=lambda n: {"x_rate": n.pace * jnp.cos(n.turn), "y_rate": n.pace * jnp.sin(n.turn)},
    ),
)  # fmt: skip
