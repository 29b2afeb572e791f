"""A ball on a plate that tilts about two axes through the middle of its top, a classic experiment in control.

Near the middle, s'' = 5/7 (g/r) a and J a'' = m g r (s - a) + torque, with the tilt a and the ball's absolute
angle of rolling s: without control, the ball runs off. Motors therefore tilt the plate against the position
and the velocity of the ball. Source: linear equations by Lagrange's method; S. Awtar et al., Mechatronics 12
(2002) 217 describes the apparatus.
"""

import jax.numpy as jnp

import jourdain_jax as jj

LOOK = (
    "The plate tilts so that the ball follows a point on a circle, with a lag. If all four gains are"
    " zero, the ball runs off."
)


class BallOnPlate(jj.Scene):
    """Coordinates: x, y of the contact on the plate; `roll` and `pitch` of the plate; attitude of the ball.
    Inputs: the desired position of the ball (m).
    """

    ball_mass: float = jj.parameter(0.3, unit="kg", positive=True)
    radius: float = jj.parameter(0.03, unit="m", positive=True)
    plate_inertia: jnp.ndarray = jj.parameter((0.05, 0.05, 0.1), unit="kg m^2", positive=True)
    stiffness: float = jj.parameter(20.0, unit="N m", about="of the motors about the tilt that is wanted")
    damping: float = jj.parameter(1.6, unit="N m s", about="of the motors")
    place_gain: float = jj.parameter(0.9, unit="rad/m", about="tilt for each metre that the ball is away")
    rate_gain: float = jj.parameter(0.5, unit="rad s/m", about="tilt for each m/s of the ball")
    gravity: float = jj.parameter(9.81, unit="m/s^2")

    coordinates = jj.coordinates("x y roll pitch", jj.quaternion("attitude"))
    inputs = jj.inputs("wanted_x wanted_y")
    domain = {"x": (-0.2, 0.2), "y": (-0.2, 0.2), "roll": (-0.4, 0.4), "pitch": (-0.4, 0.4)}
    conventions = (
        "z up; x, y along the plate; positive pitch lowers the side of x, positive roll raises the side of y."
    )
    example = {"x": 0.12}
    example_span = 4.0

    def bodies(self, t, q):
        plate = jj.rot_x(q.roll) @ jj.rot_y(q.pitch)
        on_plate = plate @ jj.vec(q.x, q.y, self.radius)
        corners = jnp.array(
            [[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [-1.0, 1.0, 0.0], [-1.0, -1.0, 0.0]]
        )
        return {
            "plate": jj.RigidBody(1.0, self.plate_inertia, jnp.zeros(3), plate, 0.25 * corners),
            "ball": jj.RigidBody.ball(
                self.ball_mass,
                self.radius,
                position=on_plate,
                orientation=jj.quaternion_to_matrix(q.attitude),
            ),
        }

    def loads(self, motion):
        q, u, wanted = motion.q, motion.u, motion.inputs
        pitch = self.place_gain * (wanted.wanted_x - q.x) - self.rate_gain * u.x_rate
        roll = self.rate_gain * u.y_rate - self.place_gain * (wanted.wanted_y - q.y)
        about_x = self.stiffness * (roll - q.roll) - self.damping * u.roll_rate
        about_y = self.stiffness * (pitch - q.pitch) - self.damping * u.pitch_rate
        return jj.gravity(motion, self.gravity), jj.generalized_force(
            motion, roll_rate=about_x, pitch_rate=about_y
        )

    def velocity_constraints(self, motion):
        ball, plate = motion["ball"], motion["plate"]
        touch = ball.position - self.radius * plate.orientation[:, 2]
        slip = ball.velocity_at(touch) - plate.velocity_at(touch)
        return {"ball on plate": plate.orientation[:, :2].T @ slip}
