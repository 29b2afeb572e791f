"""A thin disc rolling without slip on a level plane, as a free body: position, quaternion, and the contact as rows.

One height row and two no-slip rows on six speeds: three degrees of freedom, the motion of `tilting_disc`. The coordinates fail
nowhere, so that the scene holds down to the neighbourhood of the flat disc, where the contact point itself is undefined.
Source: Wang and Pao (2003), section V; R. Cushman and J. J. Duistermaat, Regular and Chaotic Dynamics 11 (2006) 31.
"""

import math

import jax.numpy as jnp
from jaxtyping import Array, Float

from jourdain_jax.calculus.rotations import quaternion_to_matrix
from jourdain_jax.scene.bodies import RigidBody
from jourdain_jax.scene.contacts import disc_contact
from jourdain_jax.scene.coordinates import coordinates, quaternion
from jourdain_jax.scene.loads import gravity
from jourdain_jax.scene.parameters import parameter
from jourdain_jax.scene.scene import Scene

_LEAN, _YAW_RATE, _LEAN_RATE, _SPIN_RATE = 0.3, 0.5, 0.2, -3.0  # the example of `tilting_disc`
_FLAT = 45.0  # units of round-off of the squared angle to the ground (1e-7 rad in double precision): nearer the contact point is undefined


class TiltingDiscQuaternion(Scene):
    """A thin disc that rolls without slip on a level plane, as a free body with the contact as rows.

    Uniform thin disc: x, y, z of the centre, attitude as a quaternion, body angular velocity; the axle is body y.
    """

    mass: Float[Array, ""] = parameter(1.0, unit="kg", positive=True)
    radius: Float[Array, ""] = parameter(0.5, unit="m", positive=True)
    gravity: Float[Array, ""] = parameter(9.81, unit="m/s^2")

    coordinates = coordinates("x y z", quaternion("attitude"))
    domain = {"z": (0.05, 0.5), **{f"attitude_omega_{axis}": (-3.0, 3.0) for axis in "xyz"}}
    conventions = "z up; x, y, z of the centre; upright and heading along x at identity attitude; axle along body y."
    example = {
        "y": -0.5 * math.sin(_LEAN),
        "attitude_w": math.cos(_LEAN / 2),
        "attitude_x": math.sin(_LEAN / 2),
        "attitude_omega_x": _LEAN_RATE,
        "attitude_omega_y": _SPIN_RATE + _YAW_RATE * math.sin(_LEAN),
        "attitude_omega_z": _YAW_RATE * math.cos(_LEAN),
    }
    example_span = 10.0

    def bodies(self, t, q):
        centre, turned = jnp.stack([q.x, q.y, q.z]), quaternion_to_matrix(q.attitude)
        return {"disc": RigidBody.thin_disc(self.mass, self.radius, axis="y", position=centre, orientation=turned)}

    def loads(self, motion):
        return (gravity(motion, self.gravity),)

    def contacts(self, pose):
        return {"rim": disc_contact(pose["disc"], self.radius, height="row")}

    def events(self, motion):
        axle = motion["disc"].orientation[:, 1]
        return {"flat": axle[0] ** 2 + axle[1] ** 2 - _FLAT * jnp.finfo(axle.dtype).eps}
