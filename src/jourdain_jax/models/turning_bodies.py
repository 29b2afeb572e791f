"""Single rotating bodies without weight."""

import jax.numpy as jnp

from jourdain_jax.calculus.reals import Parameter
from jourdain_jax.calculus.rotations import quaternion_to_matrix
from jourdain_jax.scene.bodies import RigidBody
from jourdain_jax.scene.coordinates import coordinates, parameter, quaternion
from jourdain_jax.scene.scene import Scene


class FreeRigidBody(Scene):
    """A free rigid body. It obeys Euler's equations, which Jacobi's elliptic functions solve.

        I1 w1' = (I2 - I3) w2 w3   and cyclically;   r'' = 0

    Energy, momentum and angular momentum about the mass centre (in space) are conserved; rotation about the
    middle axis is unstable. Source: L. Euler (1758); L. D. Landau and E. M. Lifshitz, Mechanics, section 37;
    Wang and Pao (2003), eq. (48).

    Coordinates: position of the mass centre, attitude as a quaternion. Speeds: rate of the position, body
    angular velocity. Body axes are principal axes.
    """

    mass: Parameter = parameter(1.0, unit="kg", positive=True)
    i1: Parameter = parameter(1.0, unit="kg m^2", positive=True)
    i2: Parameter = parameter(2.0, unit="kg m^2", positive=True)
    i3: Parameter = parameter(2.5, unit="kg m^2", positive=True)

    coordinates = coordinates("x y z", quaternion("attitude"))
    conventions = (
        "Right-handed inertial axes; attitude takes body to space; i1, i2, i3 about body x, y, z through the"
        " mass centre."
    )
    example = {"attitude_omega_x": 0.9, "attitude_omega_y": 0.4, "attitude_omega_z": -0.7}
    example_span = 20.0

    def bodies(self, t, q):
        moments = jnp.stack([self.i1, self.i2, self.i3])
        return {
            "body": RigidBody(
                self.mass, moments, jnp.stack([q.x, q.y, q.z]), quaternion_to_matrix(q.attitude)
            )
        }

    def invariants(self, motion):
        body = motion["body"]
        momentum = body.mass * body.velocity
        spin = body.orientation @ (jnp.stack([self.i1, self.i2, self.i3]) * body.angular_velocity_body)
        named = {f"momentum {axis}": momentum[k] for k, axis in enumerate("xyz")}
        return named | {f"angular momentum {axis}": spin[k] for k, axis in enumerate("xyz")}


class Suslov(Scene):
    """Suslov's problem: a body with a fixed point that cannot turn about its third body axis.

        w3 = 0 (body axes):   I11 w1' = -I13 w1 w2,   I22 w2' = I13 w1^2          (I12 = I23 = 0)

    With 2E = I11 w1^2 + I22 w2^2 every motion ends in steady rotation about the second axis, w2 =
    sqrt(2E/I22) tanh(k (t - t0)). The multiplier is the torque (N m) of the constraint about the third axis.
    Source: G. K. Suslov, Theoretical Mechanics (1902); V. V. Kozlov, Regular and Chaotic Dynamics 7 (2002)
    161.

    Coordinates: attitude as a quaternion. Speeds: body angular velocity. Moments of inertia are about the
    fixed point, which is the mass centre.
    """

    i11: Parameter = parameter(1.0, unit="kg m^2", positive=True)
    i22: Parameter = parameter(2.0, unit="kg m^2", positive=True)
    i33: Parameter = parameter(1.5, unit="kg m^2", positive=True)
    i13: Parameter = parameter(0.5, unit="kg m^2", about="entry of the inertia matrix; |i13| < sqrt(i11 i33)")

    coordinates = coordinates(quaternion("attitude"))
    privileged = ("attitude_omega_x", "attitude_omega_y")
    conventions = (
        "Fixed point at the origin; attitude takes body to space; i13 is the entry of the matrix, minus the"
        " integral of x z."
    )
    example = {"attitude_omega_x": 0.6, "attitude_omega_y": 0.8}
    example_span = 10.0

    def bodies(self, t, q):
        o = jnp.zeros_like(self.i11)
        inertia = [[self.i11, o, self.i13], [o, self.i22, o], [self.i13, o, self.i33]]
        attitude = quaternion_to_matrix(q.attitude)
        mass = 1.0 + o  # irrelevant: the mass centre is fixed
        return {
            "body": RigidBody(mass, jnp.stack([jnp.stack(row) for row in inertia]), jnp.zeros(3), attitude)
        }

    def velocity_constraints(self, motion):
        return {"no turn about axis 3": motion["body"].angular_velocity_body[2]}
