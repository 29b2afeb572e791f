"""Rosenberg's particle: free but for the row `zdot = y xdot`, the smallest nonholonomic system that bends a path.

    ydot = const,   xdot sqrt(1 + y^2) = const

Source: R. M. Rosenberg, Analytical Dynamics of Discrete Systems (1977), ch. 15.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from jourdain_jax.scene.bodies import Particle
from jourdain_jax.scene.coordinates import coordinates
from jourdain_jax.scene.grounds import tangents_of
from jourdain_jax.scene.parameters import parameter
from jourdain_jax.scene.scene import Scene
from jourdain_jax.scene.visuals import Visual


class RosenbergParticle(Scene):
    """Rosenberg's particle: free but for the row `zdot = y xdot`.

    Lengths in units of the length that makes the row `zdot = y xdot`.
    """

    mass: Float[Array, ""] = parameter(1.0, unit="kg", positive=True)

    coordinates = coordinates("x y z")
    privileged = ("x_rate", "y_rate")
    conventions = "Right-handed inertial frame without gravity; y counts in metres in the row zdot = y xdot."
    example = {"y": -1.0, "x_rate": 1.1 / 2**0.5, "y_rate": 0.8}
    example_span = 5.0

    def bodies(self, t, q):
        return {"particle": Particle(self.mass, jnp.stack([q.x, q.y, q.z]))}

    def velocity_constraints(self, motion):
        return {"sheet": motion.u.z_rate - motion.q.y * motion.u.x_rate}

    def visuals(self, pose):
        normal = jnp.stack([-pose.q.y, 0.0 * pose.q.y, 1.0 + 0.0 * pose.q.y])
        normal = normal / jnp.sqrt(normal @ normal)
        turn = jnp.concatenate([tangents_of(normal), normal[None]]).T
        return {"particle": [Visual.ball(0.05), Visual.box((0.6, 0.6, 0.01), turn=turn, opacity=0.5)]}  # the plane of the velocities that the row allows

    def invariants(self, motion):
        return {"y rate": motion.u.y_rate, "speed in the sheet": motion.u.x_rate * jnp.sqrt(1 + motion.q.y**2)}
