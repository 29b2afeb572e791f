"""Planar double pendulum of two particles on massless rods, in the angles of the rods: no rows, two degrees of freedom.

    (m1 + m2) l1 th1'' + m2 l2 cos(th1 - th2) th2'' + m2 l2 sin(th1 - th2) th2'^2 + (m1 + m2) g sin(th1) = 0
    l2 th2'' + l1 cos(th1 - th2) th1'' - l1 sin(th1 - th2) th1'^2 + g sin(th2) = 0

The same system as `double_pendulum_rods`.
Source: L. D. Landau and E. M. Lifshitz, Mechanics, section 5, problem 1.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from jourdain_jax.scene.bodies import Particle
from jourdain_jax.scene.coordinates import coordinates
from jourdain_jax.scene.loads import gravity
from jourdain_jax.scene.parameters import parameter
from jourdain_jax.scene.scene import Scene
from jourdain_jax.scene.visuals import Visual


class DoublePendulumAngles(Scene):
    """A planar double pendulum in the angles of its rods: no rows.

    Angles of the upper and the lower rod from straight down; pivot at the origin.
    """

    mass1: Float[Array, ""] = parameter(1.0, unit="kg", positive=True)
    mass2: Float[Array, ""] = parameter(0.7, unit="kg", positive=True)
    length1: Float[Array, ""] = parameter(1.0, unit="m", positive=True)
    length2: Float[Array, ""] = parameter(0.8, unit="m", positive=True)
    gravity: Float[Array, ""] = parameter(9.81, unit="m/s^2")

    coordinates = coordinates("theta1 theta2")
    domain = {"theta1": (-3.2, 3.2), "theta2": (-3.2, 3.2), "theta1_rate": (-3.0, 3.0), "theta2_rate": (-3.0, 3.0)}
    conventions = "x horizontal, z up; pivot at the origin; angles from straight down, positive towards +x."
    example = {"theta1": 0.8, "theta2": -0.4, "theta1_rate": 0.3, "theta2_rate": 0.5}
    example_span = 5.0

    def bodies(self, t, q):
        first = self.length1 * _along(q.theta1)
        return {"first": Particle(self.mass1, first), "second": Particle(self.mass2, first + self.length2 * _along(q.theta2))}

    def loads(self, motion):
        return (gravity(motion, self.gravity),)

    def visuals(self, pose):
        return {"": Visual.line(jnp.zeros(3), pose["first"].position, pose["second"].position, radius=0.012 * self.length1)}


def _along(angle) -> Float[Array, "3"]:
    """Unit vector at `angle` from straight down, in the x-z plane."""
    return jnp.stack([jnp.sin(angle), jnp.zeros_like(angle), -jnp.cos(angle)])
