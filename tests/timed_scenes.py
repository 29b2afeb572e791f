"""Small scenes in which something depends on time by itself, each with the closed form of the work that time
does.
"""

import jax.numpy as jnp
from small_scenes import OnLine, Upright

import jourdain_jax as jj


def along_x(x):
    return jnp.stack([x, 0.0 * x, 0.0 * x])


class Bead(OnLine):
    """A free bead on a line."""

    mass: float = jj.parameter(2.0, positive=True)


class GrowingField(Bead):
    """V = -f t x: x = f t^3/(6 m), T = f^2 t^4/(8 m), V = -f^2 t^4/(6 m)."""

    slope: float = jj.parameter(3.0)

    def potential(self, pose):
        return -self.slope * pose.t * pose.q.x

    def work(self, t):
        return -(self.slope**2) * t**4 / (24 * self.mass)


class ShakenAnchor(Bead):
    """m x'' = -k (x - a sin W t), from rest: x = b (sin W t - W/w sin w t), b = a w^2/(w^2 - W^2)."""

    stiffness: float = jj.parameter(18.0)
    amplitude: float = jj.parameter(0.1)
    rate: float = jj.parameter(2.0)

    def loads(self, motion):
        anchor = jj.fixed_point(along_x(self.amplitude * jnp.sin(self.rate * motion.t)))
        return jj.spring(motion["mass"].point(), anchor, self.stiffness)

    def work(self, t):
        a, W, w = self.amplitude, self.rate, jnp.sqrt(self.stiffness / self.mass)
        b = a * w**2 / (w**2 - W**2)
        x, v = b * (jnp.sin(W * t) - W / w * jnp.sin(w * t)), b * W * (jnp.cos(W * t) - jnp.cos(w * t))
        return 0.5 * self.mass * v**2 + 0.5 * self.stiffness * (x - a * jnp.sin(W * t)) ** 2


class TurningRates(jj.Scene):
    """A bead on a wire that a coordinate's given rate turns: r = r0 cosh W t from rest, T = m W^2 r0^2 cosh(2
    W t)/2.
    """

    mass: float = jj.parameter(2.0, positive=True)
    rate: float = jj.parameter(1.3)
    coordinates = jj.coordinates("turn r")
    speeds = jj.speeds("r_rate")
    domain = {"r": (0.2, 1.0)}
    example = {"r": 0.5}

    def coordinate_rates(self, t, q, u):
        return jnp.stack([self.rate, u.r_rate])

    def bodies(self, t, q):
        return {"bead": jj.Particle(self.mass, q.r * jnp.stack([jnp.cos(q.turn), jnp.sin(q.turn), 0.0]))}

    def work(self, t):
        return 0.5 * self.mass * self.rate**2 * 0.5**2 * (jnp.cosh(2 * self.rate * t) - 1)


class DrivenOrientation(jj.Scene):
    """A ball on a gimbal whose outer axis is turned by the angle c t^2: its inertia is the same all around,
    so T = I ((2 c t)^2 + lean_rate^2)/2.
    """

    rate: float = jj.parameter(0.8)
    coordinates = jj.coordinates("lean")
    example = {"lean": 0.3, "lean_rate": 0.7}

    def bodies(self, t, q):
        return {
            "ball": jj.RigidBody.ball(
                2.0, 0.5, position=jnp.zeros(3), orientation=jj.rot_z(self.rate * t**2) @ jj.rot_x(q.lean)
            )
        }

    def work(self, t):
        return 0.5 * (0.4 * 2.0 * 0.5**2) * (2 * self.rate * t) ** 2


class LosingMass(Bead):
    """A bead that loses mass at its own velocity: it goes on as it went, T = m exp(-c t) v^2/2."""

    loss: float = jj.parameter(0.4)
    example = {"x_rate": 1.5}

    def bodies(self, t, q):
        return {"mass": jj.Particle(self.mass * jnp.exp(-self.loss * t), along_x(q.x))}

    def work(self, t):
        return 0.5 * self.mass * 1.5**2 * (jnp.exp(-self.loss * t) - 1)


class Lifted(Upright):
    """A weight whose height is prescribed, `height + rate t`: the winch does m g rate t."""

    mass: float = jj.parameter(2.0, positive=True)
    rate: float = jj.parameter(0.5)
    example = {"z": 2.0, "x_rate": 1.0}

    def loads(self, motion):
        return jj.gravity(motion, 9.81)

    def prescribed(self, t):
        return {"z": 2.0 + self.rate * t}

    def work(self, t):
        return self.mass * 9.81 * self.rate * t


class Towed(Bead):
    """A bead that an input tows at its speed through a row, against a spring at the origin: the tow does k
    x^2/2.
    """

    stiffness: float = jj.parameter(18.0)
    inputs = jj.inputs("speed")

    def loads(self, motion):
        return jj.spring(motion["mass"].point(), jj.fixed_point((0.0, 0.0, 0.0)), self.stiffness)

    def velocity_constraints(self, motion):
        return {"tow": motion.u.x_rate - motion.inputs.speed}

    def work(self, t):
        return 0.5 * self.stiffness * (0.6 * t) ** 2


# Each with what depends on time in it, and whether it moves while all speeds are zero.
TIMED = [
    (GrowingField(), ("potential",), False),
    (ShakenAnchor(), ("loads", "potential"), False),
    (TurningRates(), (), True),
    (DrivenOrientation(), ("poses",), True),
    (LosingMass(), ("inertias",), False),
    (Lifted(), ("rows",), False),
    (Towed(), (), False),
]
