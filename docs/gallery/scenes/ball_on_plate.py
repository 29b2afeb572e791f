"""A ball on a plate that tilts about two axes through the middle of its top: the classic of control laboratories.

About the middle, s'' = 5/7 (g/r) a and J a'' = m g r (s - a) + torque, with the tilt a and the ball's absolute angle of rolling s: a ball
left alone runs off. Source: linear equations by Lagrange's method; S. Awtar et al., Mechatronics 12 (2002) 217 describes the apparatus.
"""

import jax.numpy as jnp

import jourdain_jax as jj

LOOK = "Two torques in quadrature lead the ball along a spiral; nothing holds it, and at last it runs down the tilting plate."


class BallOnPlate(jj.Scene):
    """x, y of the contact on the plate; `roll` and `pitch` of the plate; attitude of the ball. Inputs: torques on the plate (N m)."""

    ball_mass: object = jj.parameter(0.3, unit="kg", positive=True)
    radius: object = jj.parameter(0.03, unit="m", positive=True)
    plate_inertia: object = jj.parameter((0.05, 0.05, 0.1), unit="kg m^2", positive=True)
    gravity: object = jj.parameter(9.81, unit="m/s^2")

    coordinates = jj.coordinates("x y roll pitch", jj.quaternion("attitude"))
    inputs = jj.inputs("roll_torque pitch_torque")
    domain = {"x": (-0.2, 0.2), "y": (-0.2, 0.2), "roll": (-0.4, 0.4), "pitch": (-0.4, 0.4)}
    conventions = "z up; x, y along the plate; positive pitch lowers the side of x, positive roll raises the side of y."
    example = {"x": 0.06, "y_rate": 0.15}
    example_span = 1.2

    def bodies(self, t, q):
        plate = jj.rot_x(q.roll) @ jj.rot_y(q.pitch)
        on_plate = plate @ jnp.stack([q.x, q.y, self.radius + 0.0 * q.x])
        corners = jnp.array([[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [-1.0, 1.0, 0.0], [-1.0, -1.0, 0.0]])
        return {
            "plate": jj.RigidBody(1.0, self.plate_inertia, jnp.zeros(3), plate, 0.25 * corners),
            "ball": jj.RigidBody.ball(self.ball_mass, self.radius, position=on_plate, orientation=jj.quaternion_to_matrix(q.attitude)),
        }

    def loads(self, motion):
        torques = jj.generalized_force(motion, roll_rate=motion.inputs.roll_torque, pitch_rate=motion.inputs.pitch_torque)
        return jj.gravity(motion, self.gravity), torques

    def velocity_constraints(self, motion):
        ball, plate = motion["ball"], motion["plate"]
        touch = ball.position - self.radius * plate.orientation[:, 2]
        slip = ball.velocity_at(touch) - plate.velocity_at(touch)
        return {"ball on plate": plate.orientation[:, :2].T @ slip}
