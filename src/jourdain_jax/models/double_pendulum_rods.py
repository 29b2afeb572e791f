"""Planar double pendulum of two particles on massless rods, in Cartesian coordinates with the rods as geometric rows.

    |r1|^2 = l1^2,   |r2 - r1|^2 = l2^2

The same system as `double_pendulum_angles`, which knows no rods. Multipliers are the thrusts in the rods, N (negative: tension).
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from jourdain_jax.scene.bodies import Particle
from jourdain_jax.scene.constraints import rod
from jourdain_jax.scene.coordinates import coordinates
from jourdain_jax.scene.loads import gravity
from jourdain_jax.scene.parameters import parameter
from jourdain_jax.scene.scene import Scene
from jourdain_jax.scene.visuals import Visual


class DoublePendulumRods(Scene):
    """A planar double pendulum in Cartesian coordinates: two rods as geometric rows.

    Cartesian coordinates of both particles; pivot at the origin.
    """

    mass1: Float[Array, ""] = parameter(1.0, unit="kg", positive=True)
    mass2: Float[Array, ""] = parameter(0.7, unit="kg", positive=True)
    length1: Float[Array, ""] = parameter(1.0, unit="m", positive=True)
    length2: Float[Array, ""] = parameter(0.8, unit="m", positive=True)
    gravity: Float[Array, ""] = parameter(9.81, unit="m/s^2")

    coordinates = coordinates("x1 z1 x2 z2")
    domain = {"x2": (-1.5, 1.5), "z2": (-1.5, 1.5)}
    conventions = "x horizontal, z up; pivot at the origin."
    example = {"x1": 0.6, "z1": -0.8, "x2": 0.6, "z2": -1.6, "x1_rate": 0.4, "z1_rate": 0.3, "x2_rate": 0.4, "z2_rate": 0.3}
    example_span = 5.0

    def bodies(self, t, q):
        level = jnp.zeros_like(q.x1)
        first, second = jnp.stack([q.x1, level, q.z1]), jnp.stack([q.x2, level, q.z2])
        return {"first": Particle(self.mass1, first), "second": Particle(self.mass2, second)}

    def loads(self, motion):
        return (gravity(motion, self.gravity),)

    def visuals(self, pose):
        return {"": Visual.line(jnp.zeros(3), pose["first"].position, pose["second"].position, radius=0.012 * self.length1)}

    def geometric_constraints(self, pose):
        first, second = pose["first"].position, pose["second"].position
        return {"upper rod": rod(jnp.zeros(3), first, self.length1), "lower rod": rod(first, second, self.length2)}
