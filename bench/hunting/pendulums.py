"""Particles and blades whose scenes state narrow domains, which the motions leave: the chosen independent
speeds then stop determining the others.
"""

import jax.numpy as jnp
import numpy as np
from scipy.special import ellipk
from small_scenes import InSpace, OnPlane, Upright

import jourdain_jax as jj
from hunting.family import Ask, Family, G, drawn, either, one_of
from hunting.reference import integrate


class Weighted(jj.Scene):
    """Under gravity."""

    def loads(self, motion):
        return jj.gravity(motion, G)


class RodPendulum(Weighted, Upright):
    """A particle on a massless rod, in x and z."""

    length: object = jj.parameter(1.0, positive=True)
    mass: object = jj.parameter(1.0, positive=True)
    domain = {"x": (-0.6, 0.6), "z": (-1.0, -0.8)}

    def geometric_constraints(self, pose):
        return {"rod": jj.rod(jnp.zeros(3), pose["mass"].position, self.length)}


def _rod_truth(n, ts):
    """By the angle from the vertical, from the lowest position at t0."""
    rates = lambda t, angle, rate: (rate, -G / n.length * np.sin(angle))
    angle, rate = integrate(rates, (0.0, n.v / n.length), ts, width=0.03)
    s, c = n.length * np.sin(angle), n.length * np.cos(angle)
    return s, -c, c * rate, s * rate


def _full_turns(n, count):
    """One time per turn, or per half turn."""
    period = 4 * n.length / n.v * ellipk(4 * G * n.length / n.v**2)
    return period * np.arange(1, count + 1) * (1.0 if n.whole else 0.5)


LENGTH = one_of(1.0, (0.7, 1.4))
SWING = drawn(length=LENGTH, mass=(0.2, 4.0), v=either(5.0, 10.0), span=one_of(2.0, (0.5, 4.0)))


TURNING = drawn(v=(6.8, 11.0), length=(0.7, 1.0), whole=lambda r, n: r.uniform() < 0.5)
ROD = {
    "scene": RodPendulum,
    "start": lambda n: {"z": -n.length, "x_rate": n.v, "z_rate": 0.0},
    "truth": _rod_truth,
    "names": "x z x_rate z_rate",
}


class SphericalPendulum(RodPendulum):
    """A rod pendulum in space."""

    coordinates, bodies = InSpace.coordinates, InSpace.bodies
    domain = {"x": (-0.4, 0.4), "y": (-0.4, 0.4), "z": (-1.0, -0.8)}


def _spherical_truth(n, ts):
    """r'' = -g k - r (v.v - g z)/l^2, so that |r| stays."""

    def rates(_, x, y, z, vx, vy, vz):
        push = -(vx * vx + vy * vy + vz * vz - G * z) / n.length**2
        return vx, vy, vz, x * push, y * push, z * push - G

    return integrate(rates, (0.0, 0.0, -n.length, n.x_rate, n.y_rate, 0.0), ts, width=0.03)


class BeadOnRing(OnPlane):
    """A bead in a plane on a ring, and the arc that it has gone: `arc: x ydot - y xdot - sdot`."""

    domain = {"x": (0.7, 1.0), "y": (-0.5, 0.5), "s": (-0.5, 0.5)}
    coordinates = jj.coordinates("x y s")
    weight: object = jj.parameter(0.0)

    def geometric_constraints(self, pose):
        return {"ring": jj.rod(jnp.zeros(3), pose["mass"].position, 1.0)}

    def velocity_constraints(self, motion):
        q, u = motion.q, motion.u
        return {"arc": q.x * u.y_rate - q.y * u.x_rate - u.s_rate}

    def loads(self, motion):
        return jj.gravity(motion, self.weight, (0.0, -1.0, 0.0))


class BeadOnWideRing(BeadOnRing):
    """A bead on a ring, its domain all around."""

    domain = {"x": (-1.0, 1.0), "y": (-1.0, 1.0), "s": (-3.2, 3.2)}


def _bead_truth(n, ts):
    s, w = integrate(lambda _, s, w: (w, -n.weight * np.cos(s)), (n.s, n.s_rate), ts, width=0.03)
    return np.cos(s), np.sin(s), s, -np.sin(s) * w, np.cos(s) * w, w


def _bead_start(n):
    c, s = jnp.cos(n.s), jnp.sin(n.s)
    return {"x": c, "y": s, "x_rate": -s * n.s_rate, "y_rate": c * n.s_rate}


BEAD = {
    "draw": drawn(s=(-0.3, 0.3), s_rate=either(2.0, 6.0), weight=one_of(0.0, 2.0), span=(0.5, 4.0)),
    "start": _bead_start, "truth": _bead_truth, "names": "x y s x_rate y_rate s_rate",
}  # fmt: skip


class Blade(jj.Scene):
    """A body on a blade under its mass centre, on a slope along x; headings near zero are expected."""

    push: object = jj.parameter(2.0)
    coordinates = jj.coordinates("x y heading")
    domain = {"heading": (-0.3, 0.3)}

    def bodies(self, t, q):
        return {"body": jj.RigidBody(1.0, 0.3 * jnp.ones(3), [q.x, q.y, 0.0], jj.rot_z(q.heading))}

    def velocity_constraints(self, motion):
        body = motion["body"]
        return {"blade": jj.knife_edge(body, body.position, body.orientation[:, 1])}

    def loads(self, motion):
        return jj.gravity(motion, self.push, (1.0, 0.0, 0.0))


def _blade_truth(n, ts):
    w = n.heading_rate
    rates = lambda _, x, y, th, v: (v * np.cos(th), v * np.sin(th), w, n.push * np.cos(th))
    x, y, th, v = integrate(rates, (0.0, 0.0, n.heading, n.v), ts, width=0.05)
    return x, y, th, v * np.cos(th), v * np.sin(th), w


class RodChain(Weighted):
    """Two particles on rods, in x and z; near the lowest position is expected."""

    coordinates = jj.coordinates("x1 z1 x2 z2")
    domain = {"x1": (-0.4, 0.4), "z1": (-1.0, -0.9), "x2": (-0.8, 0.8), "z2": (-2.0, -1.7)}
    second: object = jj.parameter(1.0, positive=True)

    def bodies(self, t, q):
        upper, lower = [q.x1, 0.0, q.z1], [q.x2, 0.0, q.z2]
        return {"upper": jj.Particle(1.0, upper), "lower": jj.Particle(self.second, lower)}

    def geometric_constraints(self, pose):
        upper, lower = pose["upper"].position, pose["lower"].position
        return {"first": jj.rod(jnp.zeros(3), upper, 1.0), "second": jj.rod(upper, lower, 1.0)}


def _chain_truth(n, ts):
    """Double pendulum of unit rods in angles; (1 + m) a'' + m cos(a - b) b'' = ..., Landau & Lifshitz,
    Mechanics, section 5.
    """
    m = n.second

    def rates(_, a, b, da, db):
        c, s = np.cos(a - b), np.sin(a - b)
        f1, f2 = -m * s * db**2 - (1 + m) * G * np.sin(a), s * da**2 - G * np.sin(b)
        det = 1 + m - m * c * c
        return da, db, (f1 - m * c * f2) / det, ((1 + m) * f2 - c * f1) / det

    a, b, _, _ = integrate(rates, (0.0, 0.0, n.w1, n.w2), ts, width=0.02)
    x1, z1 = np.sin(a), -np.cos(a)
    return x1, z1, x1 + np.sin(b), z1 - np.cos(b)


FAMILIES = (
    Family(
        name="rod-pendulum", what="pendulum in x, z with a rod and a narrow domain", draw=SWING, **ROD,
        cases=140,
    ),
    Family(
        name="rod-pendulum-in-step", what="the same, saved in step with its rotation",
        draw=lambda r: SWING(r) | TURNING(r),
        times=_full_turns, fixed=("span", "whole"),
        asks=(Ask("simulate", 2), Ask("jit", 8), Ask("vmap", 1, 1e-6), Ask("simulate", 4, 1e-6)), **ROD,
    ),
    Family(
        name="spherical-pendulum", what="pendulum in x, y, z with a rod and a narrow domain",
        scene=SphericalPendulum,
        draw=drawn(length=LENGTH, x_rate=(-8, 8), y_rate=(-8, 8), span=(0.5, 3.0)),
        start=lambda n: {"z": -n.length, "z_rate": 0.0},
        truth=_spherical_truth, names="x y z x_rate y_rate z_rate",
    ),
    Family(
        name="bead-on-ring", what="bead on a ring, an arc for the third coordinate, narrow domain",
        scene=BeadOnRing, **BEAD,
    ),
    Family(name="bead-on-wide-ring", what="the same, its domain all around", scene=BeadOnWideRing, **BEAD),
    Family(
        name="blade", what="blade on a slope with a narrow domain of its heading", scene=Blade,
        truth=_blade_truth,
        draw=drawn(push=(0.0, 4.0), heading=(-0.3, 0.3), v=(-2, 2), heading_rate=(0.5, 6.0), span=(1.0, 6.0)),
        start=lambda n: {"x_rate": n.v * jnp.cos(n.heading), "y_rate": n.v * jnp.sin(n.heading)},
        names="x y heading x_rate y_rate heading_rate",
    ),
    Family(
        name="rod-chain", what="double pendulum of rods in x, z with a narrow domain", scene=RodChain,
        truth=_chain_truth, names="x1 z1 x2 z2", single=False,
        draw=drawn(second=(0.3, 3.0), w1=(-6, 6), w2=(-8, 8), span=(0.5, 1.5)),
        start=lambda n: {
            "z1": -1.0, "z2": -2.0, "x1_rate": n.w1, "z1_rate": 0.0, "x2_rate": n.w1 + n.w2, "z2_rate": 0.0,
        },
    ),
)  # fmt: skip
