"""A differential-drive robot that pulls a trailer on a hitch behind its axle: two driven wheels, one trailer
axle, two degrees of freedom.

Both wheels prevent the same sideways slip: five constraints of rank four. On a steady circle of radius R the
trailer's axle runs on a smaller circle,
R_t^2 = R^2 + hitch^2 - tongue^2. Source: C. Altafini, Int. J. Robotics Research 20 (2001) 515 (off-axle
hitches).
"""

import jourdain_jax as jj

LOOK = (
    "The trailer cuts corners: in a steady turn its axle runs on a circle with"
    " $R_t^2 = R^2 + hitch^2 - tongue^2$, inside that of the robot."
)


class RobotWithTrailer(jj.Scene):
    """Coordinates: x, y of the middle of the axle, heading; angles of the wheels; heading of the trailer.
    Inputs: torques on the wheels (N m).
    """

    hull_mass: float = jj.parameter(6.0, unit="kg", positive=True)
    wheel_mass: float = jj.parameter(0.5, unit="kg", positive=True)
    trailer_mass: float = jj.parameter(4.0, unit="kg", positive=True)
    radius: float = jj.parameter(0.1, unit="m", positive=True, about="of the wheels")
    track: float = jj.parameter(0.36, unit="m", positive=True, about="between the wheels")
    hitch: float = jj.parameter(0.2, unit="m", about="from the axle back to the hitch")
    tongue: float = jj.parameter(
        0.6, unit="m", positive=True, about="from the hitch back to the trailer's axle"
    )
    gravity: float = jj.parameter(9.81, unit="m/s^2")

    coordinates = jj.coordinates("x y heading left right trailer")
    inputs = jj.inputs("left_torque right_torque")
    privileged = ("left_rate", "right_rate")
    domain = {"heading": (-3.2, 3.2), "trailer": (-3.2, 3.2)}
    conventions = "z up; headings from x towards y; positive wheel angles roll forward."
    example = {"left_rate": 5.0, "right_rate": 9.0}
    example_span = 8.0

    def bodies(self, t, q):
        hull, trailer = jj.rot_z(q.heading), jj.rot_z(q.trailer)
        axle = jj.vec(q.x, q.y, self.radius)
        cart = axle - self.hitch * hull[:, 0] - self.tongue * trailer[:, 0]
        made = {"hull": jj.RigidBody.box(self.hull_mass, (0.4, 0.26, 0.14), position=axle, orientation=hull)}
        for name, side in (("left", 0.5), ("right", -0.5)):
            centre = axle + side * self.track * hull[:, 1]
            made[name] = jj.RigidBody.thin_disc(
                self.wheel_mass, self.radius, axis="y", position=centre, orientation=hull @ jj.rot_y(q[name])
            )
        return made | {
            "trailer": jj.RigidBody.box(
                self.trailer_mass, (0.4, 0.3, 0.16), position=cart, orientation=trailer
            )
        }

    def visuals(self, pose):
        return {
            "": jj.Visual.line(
                pose["hull"].place((-self.hitch, 0.0, 0.0)), pose["trailer"].position, radius=0.02
            )
        }

    def loads(self, motion):
        axle = motion["hull"].orientation[:, 1]
        torques = {"left": motion.inputs.left_torque, "right": motion.inputs.right_torque}
        return jj.gravity(motion, self.gravity), *(
            jj.torque(motion, name, torque * axle, reaction="hull") for name, torque in torques.items()
        )

    def contacts(self, pose):
        return {
            name: jj.disc_contact(pose[name], self.radius, carried=("hull", "left", "right"))
            for name in ("left", "right")
        }

    def velocity_constraints(self, motion):
        trailer = motion["trailer"]
        return {"trailer axle": jj.knife_edge(trailer, trailer.position, trailer.orientation[:, 1])}
