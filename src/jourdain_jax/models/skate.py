"""A skate (knife edge) on an incline: the smallest nonholonomic system with a force, one row in three coordinates.

    xdot sin(heading) - ydot cos(heading) = 0,      heading'' = 0,   forward speed  v' = g sin(slope) cos(heading)

Set turning, it drifts across the slope, not downhill. Neither xdot nor ydot can be privileged at every heading.
Source: J. I. Neimark and N. A. Fufaev, Dynamics of Nonholonomic Systems (1972), ch. III.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from jourdain_jax.calculus.rotations import rot_z
from jourdain_jax.scene.bodies import RigidBody
from jourdain_jax.scene.constraints import knife_edge
from jourdain_jax.scene.coordinates import coordinates
from jourdain_jax.scene.loads import gravity
from jourdain_jax.scene.parameters import parameter
from jourdain_jax.scene.scene import Scene
from jourdain_jax.scene.visuals import Visual


class Skate(Scene):
    """A skate (knife edge) on an incline, its blade under its mass centre.

    x, y of the mass centre, heading of the blade.
    """

    mass: Float[Array, ""] = parameter(1.0, unit="kg", positive=True)
    inertia: Float[Array, ""] = parameter(0.2, unit="kg m^2", positive=True, about="about the normal of the slope")
    slope: Float[Array, ""] = parameter(0.3, unit="rad")
    gravity: Float[Array, ""] = parameter(9.81, unit="m/s^2")

    coordinates = coordinates("x y heading")
    domain = {"heading": (-3.2, 3.2)}
    conventions = "x down the slope, y across it, z along its normal; heading from x towards y; the blade is along body x."
    example = {"heading_rate": 1.3}
    example_span = 10.0

    def bodies(self, t, q):
        position = jnp.stack([q.x, q.y, jnp.zeros_like(q.x)])
        moments = self.inertia * jnp.ones(3)  # only the one about z matters
        return {"skate": RigidBody(self.mass, moments, position, rot_z(q.heading))}

    def loads(self, motion):
        down = jnp.stack([jnp.sin(self.slope), jnp.zeros_like(self.slope), -jnp.cos(self.slope)])
        return (gravity(motion, self.gravity, down),)

    def velocity_constraints(self, motion):
        skate = motion["skate"]
        return {"edge": knife_edge(skate, skate.position, skate.orientation[:, 1])}

    def visuals(self, pose):
        blade = Visual.box((0.3, 0.008, 0.05), at=(0.0, 0.0, 0.025), colour="#8a8a86")
        return {"skate": [blade, Visual.box((0.26, 0.09, 0.03), at=(0.0, 0.0, 0.065)), Visual.box((0.12, 0.08, 0.12), at=(-0.06, 0.0, 0.13))]}

    def invariants(self, motion):
        q, u = motion.q, motion.u
        forward = u.x_rate * jnp.cos(q.heading) + u.y_rate * jnp.sin(q.heading)
        return {
            "turn rate": u.heading_rate,
            "speed and heading": forward * u.heading_rate - self.gravity * jnp.sin(self.slope) * jnp.sin(q.heading),
        }
