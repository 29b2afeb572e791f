"""Particles and blades whose scenes state narrow domains, which the motions leave: the chosen independent speeds then stop determining the others."""

import jax.numpy as jnp
import numpy as np
from scipy.special import ellipk

import jourdain_jax as jj
from hunting.family import Ask, Family, Truth
from hunting.reference import integrate

G = 9.81


class RodPendulum(jj.Scene):
    """A particle on a massless rod, in x and z."""

    length: object = jj.parameter(1.0, unit="m", positive=True)
    mass: object = jj.parameter(1.0, unit="kg", positive=True)
    coordinates = jj.coordinates("x z")
    domain = {"x": (-0.6, 0.6), "z": (-1.0, -0.8)}

    def bodies(self, t, q):
        return {"bob": jj.Particle(self.mass, jnp.stack([q.x, 0.0 * q.x, q.z]))}

    def geometric_constraints(self, pose):
        return {"rod": jj.rod(jnp.zeros(3), pose["bob"].position, self.length)}

    def loads(self, motion):
        return (jj.gravity(motion, G),)


def _swing(n, ts):
    """Angle from the vertical and its rate, from the lowest position at t0."""
    t0 = n.get("t0", 0.0 * n["v"])
    rates = lambda t, y: np.stack([y[:, 1], -G / n["l"] * np.sin(y[:, 0])], axis=1)  # noqa: E731
    return np.moveaxis(integrate(rates, np.stack([n.get("angle", 0.0 * n["v"]), n["v"] / n["l"]], axis=1), ts, t0=t0, width=0.03), -1, 0)


def _rod_truth(n, ts):
    angle, rate = _swing(n, ts)
    l = n["l"][:, None]
    s, c = np.sin(angle), np.cos(angle)
    return Truth(np.stack([l * s, -l * c, l * c * rate, l * s * rate], axis=-1))


def _full_turns(n, count):
    """One time per turn, or per half turn."""
    period = 4 * n["l"] / n["v"] * ellipk(4 * G * n["l"] / n["v"] ** 2)
    return period * np.arange(1, count + 1) * (1.0 if n["whole"] else 0.5)


def _swing_drawn(r):
    l = float(r.choice([1.0, r.uniform(0.7, 1.4)]))
    return {"l": l, "m": r.uniform(0.2, 4.0), "v": float(r.choice([-1.0, 1.0])) * r.uniform(5.0, 10.0), "span": float(r.choice([2.0, r.uniform(0.5, 4.0)]))}


def _turning_drawn(r):
    return _swing_drawn(r) | {"v": r.uniform(6.8, 11.0), "l": r.uniform(0.7, 1.0), "whole": float(r.uniform() < 0.5)}


ROD = {
    "scene": RodPendulum,
    "start": lambda n: {"x": 0.0 * n["v"], "z": -n["l"], "x_rate": n["v"], "z_rate": 0.0 * n["v"]},
    "truth": _rod_truth,
    "names": ("x", "z", "x_rate", "z_rate"),
    "parameters": lambda n: {"length": n["l"], "mass": n["m"]},
}


class SphericalPendulum(RodPendulum):
    """A rod pendulum in space."""

    coordinates = jj.coordinates("x y z")
    domain = {"x": (-0.4, 0.4), "y": (-0.4, 0.4), "z": (-1.0, -0.8)}

    def bodies(self, t, q):
        return {"bob": jj.Particle(self.mass, jnp.stack([q.x, q.y, q.z]))}


def _spherical_truth(n, ts):
    """r'' = -g k + (g.r-terms) so that |r| stays: r'' = -g k - r (v.v - g z)/l^2."""

    def rates(_, y):
        r, v = y[:, :3], y[:, 3:]
        push = -(np.sum(v * v, axis=1) - G * r[:, 2]) / n["l"] ** 2
        return np.concatenate([v, r * push[:, None] - np.array([0.0, 0.0, G])], axis=1)

    o = 0.0 * n["l"]
    return Truth(integrate(rates, np.stack([o, o, -n["l"], n["vx"], n["vy"], o], axis=1), ts, width=0.03))


class BeadOnRing(jj.Scene):
    """A bead in a plane on a ring, and the arc that it has gone: `arc: x ydot - y xdot - sdot`."""

    domain = {"x": (0.7, 1.0), "y": (-0.5, 0.5), "s": (-0.5, 0.5)}
    coordinates = jj.coordinates("x y s")
    weight: object = jj.parameter(0.0, unit="m/s^2")

    def bodies(self, t, q):
        return {"bead": jj.Particle(1.0, jnp.stack([q.x, q.y, 0.0 * q.x]))}

    def geometric_constraints(self, pose):
        return {"ring": jj.rod(jnp.zeros(3), pose["bead"].position, 1.0)}

    def velocity_constraints(self, motion):
        q, u = motion.q, motion.u
        return {"arc": q.x * u.y_rate - q.y * u.x_rate - u.s_rate}

    def loads(self, motion):
        return (jj.gravity(motion, self.weight, (0.0, -1.0, 0.0)),)


class BeadOnWideRing(BeadOnRing):
    """A bead on a ring, its domain all around."""

    domain = {"x": (-1.0, 1.0), "y": (-1.0, 1.0), "s": (-3.2, 3.2)}


def _bead_truth(n, ts):
    rates = lambda _, y: np.stack([y[:, 1], -n["weight"] * np.cos(y[:, 0])], axis=1)  # noqa: E731
    s, w = np.moveaxis(integrate(rates, np.stack([n["s"], n["w"]], axis=1), ts, width=0.03), -1, 0)
    return Truth(np.stack([np.cos(s), np.sin(s), s, -np.sin(s) * w, np.cos(s) * w, w], axis=-1))


BEAD = {
    "draw": lambda r: {"s": r.uniform(-0.3, 0.3), "w": r.choice([-1.0, 1.0]) * r.uniform(2.0, 6.0), "weight": float(r.choice([0.0, 2.0])),
                       "span": r.uniform(0.5, 4.0)},
    "start": lambda n: {
        "x": jnp.cos(n["s"]), "y": jnp.sin(n["s"]), "s": n["s"],
        "x_rate": -jnp.sin(n["s"]) * n["w"], "y_rate": jnp.cos(n["s"]) * n["w"], "s_rate": n["w"],
    },
    "truth": _bead_truth,
    "names": ("x", "y", "s", "x_rate", "y_rate", "s_rate"),
    "parameters": lambda n: {"weight": n["weight"]},
}  # fmt: skip


class Blade(jj.Scene):
    """A body on a blade under its mass centre, on a slope along x; headings near zero are expected."""

    push: object = jj.parameter(2.0, unit="m/s^2")
    coordinates = jj.coordinates("x y heading")
    domain = {"heading": (-0.3, 0.3)}

    def bodies(self, t, q):
        return {"body": jj.RigidBody(1.0, 0.3 * jnp.ones(3), jnp.stack([q.x, q.y, 0.0 * q.x]), jj.rot_z(q.heading))}

    def velocity_constraints(self, motion):
        body = motion["body"]
        return {"blade": jj.knife_edge(body, body.position, body.orientation[:, 1])}

    def loads(self, motion):
        return (jj.gravity(motion, self.push, (1.0, 0.0, 0.0)),)


def _blade_truth(n, ts):
    def rates(_, y):
        _, _, th, v = y.T
        return np.stack([v * np.cos(th), v * np.sin(th), n["w"], n["push"] * np.cos(th)], axis=1)

    o = 0.0 * n["v"]
    y = integrate(rates, np.stack([o, o, n["th"], n["v"]], axis=1), ts, width=0.05)
    x, z, th, v = np.moveaxis(y, -1, 0)
    return Truth(np.stack([x, z, th, v * np.cos(th), v * np.sin(th), n["w"][:, None] + 0 * th], axis=-1))


class RodChain(jj.Scene):
    """Two particles on rods, in x and z; near the lowest position is expected."""

    coordinates = jj.coordinates("x1 z1 x2 z2")
    domain = {"x1": (-0.4, 0.4), "z1": (-1.0, -0.9), "x2": (-0.8, 0.8), "z2": (-2.0, -1.7)}
    second: object = jj.parameter(1.0, unit="kg", positive=True)

    def bodies(self, t, q):
        place = lambda x, z: jnp.stack([x, 0.0 * x, z])  # noqa: E731
        return {"upper": jj.Particle(1.0, place(q.x1, q.z1)), "lower": jj.Particle(self.second, place(q.x2, q.z2))}

    def geometric_constraints(self, pose):
        upper, lower = pose["upper"].position, pose["lower"].position
        return {"first": jj.rod(jnp.zeros(3), upper, 1.0), "second": jj.rod(upper, lower, 1.0)}

    def loads(self, motion):
        return (jj.gravity(motion, G),)


def _chain_truth(n, ts):
    """Double pendulum of unit rods in angles; (1 + m) a'' + m cos(a - b) b'' = ..., Landau & Lifshitz, Mechanics, section 5."""
    m = n["m"]

    def rates(_, y):
        a, b, da, db = y.T
        c, s = np.cos(a - b), np.sin(a - b)
        f1, f2 = -m * s * db**2 - (1 + m) * G * np.sin(a), s * da**2 - G * np.sin(b)
        det = 1 + m - m * c * c
        return np.stack([da, db, (f1 - m * c * f2) / det, ((1 + m) * f2 - c * f1) / det], axis=1)

    o = 0.0 * m
    a, b = np.moveaxis(integrate(rates, np.stack([o, o, n["w1"], n["w2"]], axis=1), ts, width=0.02)[..., :2], -1, 0)
    x1, z1 = np.sin(a), -np.cos(a)
    return Truth(np.stack([x1, z1, x1 + np.sin(b), z1 - np.cos(b)], axis=-1))


FAMILIES = (
    Family(name="rod-pendulum", what="pendulum in x, z with a rod and a narrow domain", draw=_swing_drawn, **ROD, cases=140),
    Family(
        name="rod-pendulum-in-step", what="the same, saved in step with its rotation", draw=_turning_drawn, times=_full_turns, fixed=("span", "whole"),
        asks=(Ask("simulate", 2), Ask("jit", 8), Ask("vmap", 1, 1e-6), Ask("simulate", 4, 1e-6)), **ROD,
    ),
    Family(
        name="spherical-pendulum", what="pendulum in x, y, z with a rod and a narrow domain", scene=SphericalPendulum,
        draw=lambda r: {"l": float(r.choice([1.0, r.uniform(0.7, 1.4)])), "vx": r.uniform(-8, 8), "vy": r.uniform(-8, 8), "span": r.uniform(0.5, 3.0)},
        start=lambda n: {"x": 0.0 * n["l"], "y": 0.0 * n["l"], "z": -n["l"], "x_rate": n["vx"], "y_rate": n["vy"], "z_rate": 0.0 * n["l"]},
        truth=_spherical_truth, names=("x", "y", "z", "x_rate", "y_rate", "z_rate"), parameters=lambda n: {"length": n["l"]},
    ),
    Family(name="bead-on-ring", what="bead on a ring, an arc for the third coordinate, narrow domain", scene=BeadOnRing, **BEAD),
    Family(name="bead-on-wide-ring", what="the same, its domain all around", scene=BeadOnWideRing, **BEAD),
    Family(
        name="blade", what="blade on a slope with a narrow domain of its heading", scene=Blade,
        draw=lambda r: {"push": r.uniform(0.0, 4.0), "th": r.uniform(-0.3, 0.3), "v": r.uniform(-2, 2), "w": r.uniform(0.5, 6.0), "span": r.uniform(1.0, 6.0)},
        start=lambda n: {
            "x": 0.0 * n["v"], "y": 0.0 * n["v"], "heading": n["th"], "heading_rate": n["w"],
            "x_rate": n["v"] * jnp.cos(n["th"]), "y_rate": n["v"] * jnp.sin(n["th"]),
        },
        truth=_blade_truth, names=("x", "y", "heading", "x_rate", "y_rate", "heading_rate"), parameters=lambda n: {"push": n["push"]},
    ),
    Family(
        name="rod-chain", what="double pendulum of rods in x, z with a narrow domain", scene=RodChain,
        draw=lambda r: {"m": r.uniform(0.3, 3.0), "w1": r.uniform(-6, 6), "w2": r.uniform(-8, 8), "span": r.uniform(0.5, 1.5)},
        start=lambda n: {
            "x1": 0.0 * n["m"], "z1": 0.0 * n["m"] - 1.0, "x2": 0.0 * n["m"], "z2": 0.0 * n["m"] - 2.0,
            "x1_rate": n["w1"], "z1_rate": 0.0 * n["m"], "x2_rate": n["w1"] + n["w2"], "z2_rate": 0.0 * n["m"],
        },
        truth=_chain_truth, names=("x1", "z1", "x2", "z2"), parameters=lambda n: {"second": n["m"]}, single=False,
    ),
)  # fmt: skip
