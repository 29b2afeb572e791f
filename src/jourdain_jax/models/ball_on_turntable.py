"""A ball that rolls on a turntable, flat or tilted: affine rows, because the ground moves.

Its centre moves like a charge in a magnetic field: in a circle on the flat table, drifting *along* the slope of the tilted one.

    R'' = n z x R' + g sin(tilt) x / (1 + kappa),    n = Om kappa / (1 + kappa)        (2/7 Om for a solid ball)

The speeds are quasi-velocities: the rates of the centre and the angular velocity in the axes of the table. In these the rows are
constant, and the attitude, a quaternion that a drawing needs, never enters them.
Source: K. Weltner, Am. J. Phys. 47 (1979) 984.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from jourdain_jax.calculus.rotations import quaternion_rate, quaternion_to_matrix, rot_z
from jourdain_jax.scene.bodies import RigidBody
from jourdain_jax.scene.contacts import ball_contact
from jourdain_jax.scene.coordinates import coordinates, quaternion, speeds
from jourdain_jax.scene.grounds import Plane
from jourdain_jax.scene.loads import gravity
from jourdain_jax.scene.parameters import parameter
from jourdain_jax.scene.scene import Scene
from jourdain_jax.scene.visuals import Visual


class BallOnTurntable(Scene):
    """A ball that rolls without slip on a turntable, flat or tilted.

    x, y of the centre along the table, and the attitude; roll_x, roll_y, spin: angular velocity in the table's axes.
    """

    mass: Float[Array, ""] = parameter(1.0, unit="kg", positive=True)
    radius: Float[Array, ""] = parameter(0.05, unit="m", positive=True)
    inertia_ratio: Float[Array, ""] = parameter(0.4, positive=True, about="kappa = I/(m r^2): 2/5 solid, 2/3 hollow")
    turn_rate: Float[Array, ""] = parameter(2.0, unit="rad/s", about="Om, of the table about its normal through the origin")
    tilt: Float[Array, ""] = parameter(0.0, unit="rad", about="of the table, down along x")
    gravity: Float[Array, ""] = parameter(9.81, unit="m/s^2")

    coordinates = coordinates("x y", quaternion("attitude"))
    speeds = speeds("x_rate y_rate roll_x roll_y spin")
    privileged = ("x_rate", "y_rate", "spin")
    domain = {"roll_x": (-10.0, 10.0), "roll_y": (-10.0, 10.0), "spin": (-10.0, 10.0)}
    conventions = "z up; x, y along the table (x downhill when tilt > 0, y level), which turns anticlockwise about its normal."
    example = {"x": 0.2, "x_rate": 0.1, "y_rate": 0.3, "spin": 1.0}
    example_span = 10.0

    def bodies(self, t, q):
        x_axis, y_axis, normal = self._axes()
        centre = q.x * x_axis + q.y * y_axis + self.radius * normal
        turned = quaternion_to_matrix(q.attitude)
        return {"ball": RigidBody.ball(self.mass, self.radius, position=centre, orientation=turned, factor=self.inertia_ratio)}

    def coordinate_rates(self, t, q, u):
        omega = jnp.stack([u.roll_x, u.roll_y, u.spin]) @ self._axes()  # space components
        omega_body = quaternion_to_matrix(q.attitude).T @ omega
        return jnp.concatenate([jnp.stack([u.x_rate, u.y_rate]), quaternion_rate(q.attitude, omega_body)])

    def loads(self, motion):
        return (gravity(motion, self.gravity),)

    def contacts(self, pose):
        normal = self._axes()[2]
        table = Plane(tilt=self.tilt, angular_velocity=self.turn_rate * normal)
        return {"table": ball_contact(pose["ball"], self.radius, ground=table)}

    def visuals(self, pose):
        axes, width = self._axes().T, 0.2 * self.radius
        turned = axes @ rot_z(self.turn_rate * pose.t)
        table = Visual.wheel(12 * self.radius, width, axis="z", at=-width / 2 * axes[:, 2], turn=turned, colour="#b9b2a4")
        return {"": table}

    def invariants(self, motion):
        q, u = motion.q, motion.u
        gyration = self.turn_rate * self.inertia_ratio / (1 + self.inertia_ratio)
        push = self.gravity * jnp.sin(self.tilt) / (1 + self.inertia_ratio)
        guide_x, guide_y = u.x_rate + gyration * q.y - push * motion.t, u.y_rate - gyration * q.x
        return {"spin": u.spin, "guiding centre along x": guide_x, "guiding centre along y": guide_y}

    def _axes(self) -> Float[Array, "3 3"]:
        """Downhill, level and normal unit vectors of the table, in rows."""
        table = Plane(tilt=self.tilt)
        return jnp.concatenate([table.tangents, table.normal[None]])
