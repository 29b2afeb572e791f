"""A tricycle (a fork-lift, a tug): the front wheel is driven and steered, two rear wheels roll freely.

The shares of the load on three wheels are determined. In a turn with the steer angle d the rear wheels turn
at (R -+ track/2)/r, R = wheelbase / tan(d), and the front wheel at sqrt(R^2 + wheelbase^2)/r, for one unit of
turn rate. Source: R. Siegwart and I. Nourbakhsh, Autonomous Mobile Robots (2004), 3.2.
"""

import jourdain_jax as jj

LOOK = "The rear wheels turn at different rates, as a differential allows; the outer one carries more load."


class Tricycle(jj.Scene):
    """Coordinates: x, y under the middle of the rear axle, heading, steer; angles of the wheels. Inputs:
    `drive` about the front axle and `steer_torque` (N m).
    """

    frame_mass: float = jj.parameter(60.0, unit="kg", positive=True)
    ahead: float = jj.parameter(0.4, unit="m", about="of the frame's mass centre before the rear axle")
    height: float = jj.parameter(0.5, unit="m", positive=True, about="of the frame's mass centre")
    wheel_mass: float = jj.parameter(2.0, unit="kg", positive=True)
    radius: float = jj.parameter(0.2, unit="m", positive=True)
    wheelbase: float = jj.parameter(1.1, unit="m", positive=True)
    track: float = jj.parameter(0.8, unit="m", positive=True)
    gravity: float = jj.parameter(9.81, unit="m/s^2")

    coordinates = jj.coordinates("x y heading steer left right front")
    inputs = jj.inputs("drive steer_torque")
    privileged = ("steer_rate", "front_rate")
    domain = {"heading": (-3.2, 3.2), "steer": (-1.0, 1.0)}
    conventions = (
        "z up; heading from x towards y; steer positive to the left; positive wheel angles roll forward."
    )
    example = {"steer": 0.5, "front_rate": 6.0}
    example_span = 6.0

    def bodies(self, t, q):
        frame = jj.rot_z(q.heading)
        axle, fork = jj.vec(q.x, q.y, self.radius), frame @ jj.rot_z(q.steer)
        centre = axle + self.ahead * frame[:, 0] + jj.vec(0, 0, self.height - self.radius)
        made = {
            "frame": jj.RigidBody.box(self.frame_mass, (0.9, 0.5, 0.4), position=centre, orientation=frame)
        }
        places = {
            "left": 0.5 * self.track * frame[:, 1],
            "right": -0.5 * self.track * frame[:, 1],
            "front": self.wheelbase * frame[:, 0],
        }
        for name, place in places.items():
            turned = (fork if name == "front" else frame) @ jj.rot_y(q[name])
            made[name] = jj.RigidBody.thin_disc(
                self.wheel_mass, self.radius, axis="y", position=axle + place, orientation=turned
            )
        return made

    def loads(self, motion):
        front = motion["front"].orientation[:, 1]
        return (
            jj.gravity(motion, self.gravity),
            jj.torque(motion, "front", motion.inputs.drive * front, reaction="frame"),
            jj.torque(
                motion,
                "front",
                motion.inputs.steer_torque * motion["frame"].orientation[:, 2],
                reaction="frame",
            ),
        )

    def contacts(self, pose):
        return {name: jj.disc_contact(pose[name], self.radius) for name in ("left", "right", "front")}
