"""An upright disc that rolls and turns on a level plane: both rates are constant, the path is a circle or a straight line.

    xdot = R cos(heading) rolldot,   ydot = R sin(heading) rolldot

Source: A. M. Bloch, Nonholonomic Mechanics and Control (2003), section 1.4.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from jourdain_jax.calculus.rotations import rot_y, rot_z
from jourdain_jax.scene.bodies import RigidBody
from jourdain_jax.scene.contacts import disc_contact
from jourdain_jax.scene.coordinates import coordinates
from jourdain_jax.scene.loads import gravity
from jourdain_jax.scene.parameters import parameter
from jourdain_jax.scene.scene import Scene


class VerticalDisc(Scene):
    """An upright disc that rolls and turns on a level plane.

    x, y of the contact point (and of the centre), heading about the vertical, roll about the axle.
    """

    mass: Float[Array, ""] = parameter(1.0, unit="kg", positive=True)
    radius: Float[Array, ""] = parameter(1.0, unit="m", positive=True)
    roll_inertia: Float[Array, ""] = parameter(1.0, unit="kg m^2", positive=True, about="about the axle")
    turn_inertia: Float[Array, ""] = parameter(1.0, unit="kg m^2", positive=True, about="about a diameter")
    gravity: Float[Array, ""] = parameter(9.81, unit="m/s^2")

    coordinates = coordinates("x y heading roll")
    privileged = ("heading_rate", "roll_rate")
    domain = {"heading": (-3.2, 3.2), "roll": (-3.2, 3.2)}
    conventions = "z up; heading from x towards y; axle along body y; positive roll moves forwards."
    example = {"heading_rate": 2.0, "roll_rate": 1.0}
    example_span = 1.0

    def bodies(self, t, q):
        disc = RigidBody.thin_disc(
            self.mass,
            self.radius,
            axis="y",
            position=jnp.stack([q.x, q.y, self.radius]),
            orientation=rot_z(q.heading) @ rot_y(q.roll),
            axial=self.roll_inertia,
            diametral=self.turn_inertia,
        )
        return {"disc": disc}

    def loads(self, motion):
        return (gravity(motion, self.gravity),)

    def contacts(self, pose):
        return {"rim": disc_contact(pose["disc"], self.radius)}

    def invariants(self, motion):
        return {"turn rate": motion.u.heading_rate, "roll rate": motion.u.roll_rate}
