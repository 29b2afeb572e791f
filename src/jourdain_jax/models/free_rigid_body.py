"""A rigid body that nothing acts on: Euler's equations, solved by Jacobi's elliptic functions.

    I1 w1' = (I2 - I3) w2 w3   and cyclically;   r'' = 0

Energy, momentum and angular momentum about the mass centre (in space) are conserved; turning about the middle axis is unstable.
Source: L. Euler (1758); L. D. Landau and E. M. Lifshitz, Mechanics, section 37; Wang and Pao (2003), eq. (48).
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from jourdain_jax.calculus.rotations import quaternion_to_matrix
from jourdain_jax.scene.bodies import RigidBody
from jourdain_jax.scene.coordinates import coordinates, quaternion
from jourdain_jax.scene.parameters import parameter
from jourdain_jax.scene.scene import Scene


class FreeRigidBody(Scene):
    """A rigid body that nothing acts on.

    Position of the mass centre, attitude as a quaternion, body angular velocity as speeds; body axes are principal.
    """

    mass: Float[Array, ""] = parameter(1.0, unit="kg", positive=True)
    i1: Float[Array, ""] = parameter(1.0, unit="kg m^2", positive=True)
    i2: Float[Array, ""] = parameter(2.0, unit="kg m^2", positive=True)
    i3: Float[Array, ""] = parameter(2.5, unit="kg m^2", positive=True)

    coordinates = coordinates("x y z", quaternion("attitude"))
    conventions = "Right-handed inertial axes; attitude takes body to space; i1, i2, i3 about body x, y, z through the mass centre."
    example = {"attitude_omega_x": 0.9, "attitude_omega_y": 0.4, "attitude_omega_z": -0.7}
    example_span = 20.0

    def bodies(self, t, q):
        moments = jnp.stack([self.i1, self.i2, self.i3])
        return {"body": RigidBody(self.mass, moments, jnp.stack([q.x, q.y, q.z]), quaternion_to_matrix(q.attitude))}

    def invariants(self, motion):
        body = motion["body"]
        momentum = body.mass * body.velocity
        spin = body.orientation @ (jnp.stack([self.i1, self.i2, self.i3]) * body.angular_velocity_body)
        named = {f"momentum {axis}": momentum[k] for k, axis in enumerate("xyz")}
        return named | {f"angular momentum {axis}": spin[k] for k, axis in enumerate("xyz")}
