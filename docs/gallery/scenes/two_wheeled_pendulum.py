"""A two-wheeled inverted pendulum (a Segway): motors between a body and two coaxial wheels keep the body
upright.

Upright at rest and without a controller the pitch grows like exp(s t), s^2 = m g h / (m h^2 + J - (m h r)^2 /
((m + 2 m_w) r^2 + 2 I)). Both wheels prevent the same sideways slip: four constraints of rank three. Source:
F. Grasser et al., IEEE Trans. Ind. Electron. 49 (2002) 107.
"""

import jourdain_jax as jj

LOOK = (
    "It first rolls back to lean forward, then speeds up. The torques feed back pitch and speed; their"
    " difference turns it."
)


class TwoWheeledPendulum(jj.Scene):
    """Coordinates: x, y under the middle of the axle, heading, pitch of the body, angles of the wheels.
    Inputs: the desired `speed` (m/s), `turn` torque of one wheel (N m).
    """

    body_mass: float = jj.parameter(40.0, unit="kg", positive=True)
    height: float = jj.parameter(
        0.6, unit="m", positive=True, about="h, of the body's mass centre above the axle"
    )
    wheel_mass: float = jj.parameter(3.0, unit="kg", positive=True)
    radius: float = jj.parameter(0.2, unit="m", positive=True)
    track: float = jj.parameter(0.6, unit="m", positive=True)
    pitch_gain: float = jj.parameter(400.0, unit="N m")
    rate_gain: float = jj.parameter(90.0, unit="N m s")
    speed_gain: float = jj.parameter(35.0, unit="N s", about="torque against the speed that is lacking")
    gravity: float = jj.parameter(9.81, unit="m/s^2")

    coordinates = jj.coordinates("x y heading pitch left right")
    inputs = jj.inputs("speed turn")
    privileged = ("pitch_rate", "left_rate", "right_rate")
    domain = {"heading": (-3.2, 3.2), "pitch": (-0.8, 0.8)}
    conventions = (
        "z up; heading from x towards y; positive pitch leans forward, positive wheel angles roll forward."
    )
    example = {"pitch": 0.1}
    example_span = 6.0

    def bodies(self, t, q):
        level, axle = jj.rot_z(q.heading), jj.vec(q.x, q.y, self.radius)
        body = level @ jj.rot_y(q.pitch)
        made = {
            "body": jj.RigidBody.box(
                self.body_mass, (0.2, 0.4, 1.0), position=axle + self.height * body[:, 2], orientation=body
            )
        }
        for name, side in (("left", 0.5), ("right", -0.5)):
            centre = axle + side * self.track * level[:, 1]
            made[name] = jj.RigidBody.thin_disc(
                self.wheel_mass, self.radius, axis="y", position=centre, orientation=level @ jj.rot_y(q[name])
            )
        return made

    def loads(self, motion):
        u, q, wanted = motion.u, motion.q, motion.inputs
        lacking = wanted.speed - 0.5 * self.radius * (u.left_rate + u.right_rate)
        balance = 0.5 * (
            self.pitch_gain * q.pitch + self.rate_gain * u.pitch_rate - self.speed_gain * lacking
        )
        axle = motion["body"].orientation[:, 1]
        sides = {"left": balance - wanted.turn, "right": balance + wanted.turn}
        return jj.gravity(motion, self.gravity), *(
            jj.torque(motion, name, torque * axle, reaction="body") for name, torque in sides.items()
        )

    def contacts(self, pose):
        return {name: jj.disc_contact(pose[name], self.radius) for name in ("left", "right")}
