"""Scenes whose forces are functions beyond sine and cosine: tyres by the Magic Formula, friction by tanh,
contacts by Hertz and by any exponent.
"""

from itertools import pairwise

import equinox as eqx
import jax.numpy as jnp
import numpy as np

import jourdain_jax as jj


class Car(jj.Scene):
    """A single-track car that slides; each axle's force is D sin(C atan(x - E (x - atan x))), x = B times the
    slip angle.
    """

    mass: float = jj.parameter(1200.0)
    steer: float = jj.parameter(0.05)
    coordinates = jj.coordinates("x y heading")

    def bodies(self, t, q):
        at = {"position": [q.x, q.y, 0.0], "orientation": jj.rot_z(q.heading)}
        return {"car": jj.RigidBody.box(self.mass, (3.6, 1.5, 1.0), **at)}

    def loads(self, motion):
        u, c, s = motion.u, jnp.cos(motion.q.heading), jnp.sin(motion.q.heading)
        ahead, aside = c * u.x_rate + s * u.y_rate, c * u.y_rate - s * u.x_rate

        def axle(arm, steer):
            x = 10.0 * (jnp.arctan2(aside + arm * u.heading_rate, ahead) - steer)
            return -5400.0 * jnp.sin(1.4 * jnp.arctan(x - 0.3 * (x - jnp.arctan(x))))

        front, rear = axle(1.2, self.steer), axle(-1.4, 0.0)
        total, turn = front + rear, 1.2 * front - 1.4 * rear
        return jj.generalized_force(motion, x_rate=-s * total, y_rate=c * total, heading_rate=turn)


class Blocks(jj.Scene):
    """Two blocks between springs on rough ground, whose friction is mu m g tanh(v/v0)."""

    stiffness: float = jj.parameter(50.0)
    friction: float = jj.parameter(0.3)
    coordinates = jj.coordinates("x y")

    def bodies(self, t, q):
        return {name: jj.Particle(1.0, [q[name], 0.0, 0.0]) for name in "xy"}

    def loads(self, motion):
        q, u, k = motion.q, motion.u, self.stiffness
        rough = lambda v: -self.friction * 9.81 * jnp.tanh(v / 0.05)
        spring = k * (q.y - q.x)
        first, second = rough(u.x_rate) - k * q.x + spring, rough(u.y_rate) - spring
        return jj.generalized_force(motion, x_rate=first, y_rate=second)


class Beads(jj.Scene):
    """Three beads in a row between walls, which push each other by k d^exponent where they overlap by d."""

    stiffness: float = jj.parameter(1e4)
    exponent: float = jj.parameter(1.5)
    by_hertz: bool = eqx.field(static=True, default=True)  # with the exponent 3/2, whatever the parameter
    coordinates = jj.coordinates("x y z")

    def bodies(self, t, q):
        return {name: jj.Particle(1.0, [q[name], 0.0, 0.0]) for name in "xyz"}

    def loads(self, motion):
        q, exponent = motion.q, 1.5 if self.by_hertz else self.exponent
        push = [self.stiffness * jnp.maximum(d, 0.0) ** exponent for d in (-q.x, q.x - q.y, q.y - q.z, q.z)]
        x, y, z = (before - after for before, after in pairwise(push))
        return jj.generalized_force(motion, x_rate=x, y_rate=y, z_rate=z)


def cases(lanes):
    """Name -> scene, spread starts and span."""
    random = np.random.default_rng(0)
    normal = lambda size: size * random.normal(size=lanes)
    shoved = {"x_rate": 1 + random.random(lanes), "y": 0.01 * random.random(lanes)}
    driven = {"x_rate": 15 + 5 * random.random(lanes), "y_rate": normal(0.5), "heading_rate": normal(0.3)}
    return {
        "car with tyres": (Car(), driven, 3.0),
        "blocks with friction": (Blocks(), {"x": normal(1.0), "y": normal(1.0), "x_rate": normal(1.0)}, 3.0),
        "beads, Hertz": (Beads(), shoved, 1.0),
        "beads, an exponent that is a parameter": (Beads(by_hertz=False), shoved, 1.0),
    }
