"""The Heisenberg system: a free particle under the row `zdot = y xdot - x ydot` moves in straight lines, free of force.

The variational ("vakonomic") reading of the same row would give helices: the sharpest test of which principle an engine follows.
Source: A. M. Bloch, Nonholonomic Mechanics and Control (2003), section 1.8.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from jourdain_jax.scene.bodies import Particle
from jourdain_jax.scene.coordinates import coordinates
from jourdain_jax.scene.grounds import tangents_of
from jourdain_jax.scene.parameters import parameter
from jourdain_jax.scene.scene import Scene
from jourdain_jax.scene.visuals import Visual


class HeisenbergParticle(Scene):
    """The Heisenberg system: a free particle under the row `zdot = y xdot - x ydot`.

    Lengths in units of the length that makes the row `zdot = y xdot - x ydot`.
    """

    mass: Float[Array, ""] = parameter(1.0, unit="kg", positive=True)

    coordinates = coordinates("x y z")
    privileged = ("x_rate", "y_rate")
    conventions = "Right-handed inertial frame without gravity; x, y count in metres in the row zdot = y xdot - x ydot."
    example = {"x": 0.3, "y": -0.2, "x_rate": 0.7, "y_rate": 0.4}
    example_span = 10.0

    def bodies(self, t, q):
        return {"particle": Particle(self.mass, jnp.stack([q.x, q.y, q.z]))}

    def velocity_constraints(self, motion):
        q, u = motion.q, motion.u
        return {"contact form": u.z_rate - q.y * u.x_rate + q.x * u.y_rate}

    def visuals(self, pose):
        normal = jnp.stack([-pose.q.y, pose.q.x, 1.0 + 0.0 * pose.q.x])
        normal = normal / jnp.sqrt(normal @ normal)
        turn = jnp.concatenate([tangents_of(normal), normal[None]]).T
        return {"particle": [Visual.ball(0.05), Visual.box((0.6, 0.6, 0.01), turn=turn, opacity=0.5)]}  # the plane of the velocities that the row allows

    def invariants(self, motion):
        return {"x rate": motion.u.x_rate, "y rate": motion.u.y_rate, "z rate": motion.u.z_rate}
