"""Suslov's problem: a body about a fixed point that cannot turn about its own third axis.

    w3 = 0 (body axes):   I11 w1' = -I13 w1 w2,   I22 w2' = I13 w1^2          (I12 = I23 = 0)

With 2E = I11 w1^2 + I22 w2^2 every motion ends in a steady turn about the second axis, w2 = sqrt(2E/I22) tanh(k (t - t0)). The
row's multiplier is the torque (N m) that the constraint exerts about the third axis.
Source: G. K. Suslov, Theoretical Mechanics (1902); V. V. Kozlov, Regular and Chaotic Dynamics 7 (2002) 161.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from jourdain_jax.calculus.rotations import quaternion_to_matrix
from jourdain_jax.scene.bodies import RigidBody
from jourdain_jax.scene.coordinates import coordinates, quaternion
from jourdain_jax.scene.parameters import parameter
from jourdain_jax.scene.scene import Scene


class Suslov(Scene):
    """Suslov's problem: a body about a fixed point that cannot turn about its own third axis.

    Attitude as a quaternion, speeds: body angular velocity. Moments of inertia about the fixed point, the mass centre.
    """

    i11: Float[Array, ""] = parameter(1.0, unit="kg m^2", positive=True)
    i22: Float[Array, ""] = parameter(2.0, unit="kg m^2", positive=True)
    i33: Float[Array, ""] = parameter(1.5, unit="kg m^2", positive=True)
    i13: Float[Array, ""] = parameter(0.5, unit="kg m^2", about="entry of the inertia matrix; |i13| < sqrt(i11 i33)")

    coordinates = coordinates(quaternion("attitude"))
    privileged = ("attitude_omega_x", "attitude_omega_y")
    conventions = "Fixed point at the origin; attitude takes body to space; i13 is the entry of the matrix, minus the integral of x z."
    example = {"attitude_omega_x": 0.6, "attitude_omega_y": 0.8}
    example_span = 10.0

    def bodies(self, t, q):
        o = jnp.zeros_like(self.i11)
        inertia = [[self.i11, o, self.i13], [o, self.i22, o], [self.i13, o, self.i33]]
        attitude = quaternion_to_matrix(q.attitude)
        mass = 1.0 + o  # of no account: the mass centre is fixed
        return {"body": RigidBody(mass, jnp.stack([jnp.stack(row) for row in inertia]), jnp.zeros(3), attitude)}

    def velocity_constraints(self, motion):
        return {"no turn about axis 3": motion["body"].angular_velocity_body[2]}
