"""A thin disc rolling without slip on a level plane, in angles: the classic of Appell and Korteweg.

Contact and height are built into the coordinates (x, y: contact point). Two no-slip rows, three degrees of freedom.
Singular where the disc lies flat (lean = +-pi/2); `tilting_disc_quaternion` is the scene for that neighbourhood.
Source: Wang and Pao (2003), section V; J. I. Neimark and N. A. Fufaev, Dynamics of Nonholonomic Systems (1972).
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from jourdain_jax.calculus.rotations import rot_x, rot_y, rot_z
from jourdain_jax.scene.bodies import RigidBody
from jourdain_jax.scene.contacts import disc_contact
from jourdain_jax.scene.coordinates import coordinates
from jourdain_jax.scene.loads import gravity
from jourdain_jax.scene.parameters import parameter
from jourdain_jax.scene.scene import Scene


class TiltingDisc(Scene):
    """A thin disc that rolls without slip on a level plane, in angles.

    Uniform thin disc: yaw about z, lean about the heading, spin about the axle; x, y of the contact point.
    """

    mass: Float[Array, ""] = parameter(1.0, unit="kg", positive=True)
    radius: Float[Array, ""] = parameter(0.5, unit="m", positive=True)
    gravity: Float[Array, ""] = parameter(9.81, unit="m/s^2")

    coordinates = coordinates("x y yaw lean spin")
    domain = {"yaw": (-3.2, 3.2), "lean": (-1.2, 1.2), "spin": (-3.2, 3.2)}
    conventions = "z up; upright at lean = 0, heading along x at yaw = 0; axle along body y; positive spin rolls forward."
    example = {"lean": 0.3, "yaw_rate": 0.5, "lean_rate": 0.2, "spin_rate": -3.0}
    example_span = 10.0

    def bodies(self, t, q):
        frame = rot_z(q.yaw) @ rot_x(q.lean)
        centre = jnp.stack([q.x, q.y, 0.0 * q.x]) + self.radius * frame[:, 2]
        return {"disc": RigidBody.thin_disc(self.mass, self.radius, axis="y", position=centre, orientation=frame @ rot_y(q.spin))}

    def loads(self, motion):
        return (gravity(motion, self.gravity),)

    def contacts(self, pose):
        return {"rim": disc_contact(pose["disc"], self.radius, axis="y", height="coordinates")}

    def events(self, motion):
        return {"fallen": 1.5 - jnp.abs(motion.q.lean)}
