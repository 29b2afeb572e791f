"""A coin is dropped onto a table: its rim strikes and slips, and then it rolls and slips in turn.

The rim of radius r is sharp. Coulomb friction and restitution act at its lowest point, and between contacts
the coin flies.
"""

import jax.numpy as jnp

import jourdain_jax as jj

LOOK = (
    "The coin spins while it falls, strikes a few times, and slips. Later it rolls for short times between"
    " slips, each time that it is lowest. `print(motion.phases)` lists the changes."
)


class Coin(jj.Scene):
    """A coin: x, y, z of its centre and its attitude."""

    mass: float = jj.parameter(0.01, unit="kg", positive=True)
    radius: float = jj.parameter(0.012, unit="m", positive=True)
    friction: float = jj.parameter(0.3, non_negative=True)
    bounce: float = jj.parameter(0.3, non_negative=True)
    coordinates = jj.coordinates("x y z", jj.quaternion("attitude"))
    # 1.3 rad from lying flat, 1 mm above the table, 25 rad/s about the vertical
    example = {
        "z": 0.0125627,
        "x_rate": 0.5,
        "attitude_w": 0.7960837985,
        "attitude_x": 0.6051864057,
        "attitude_y": 0.0,
        "attitude_z": 0.0,
        "attitude_omega_y": 24.0889546,
        "attitude_omega_z": 6.6874707,
    }
    example_span = 1.5

    def bodies(self, t, q):
        inertia = self.mass * self.radius**2 * jnp.array([0.25, 0.25, 0.5])
        return {
            "coin": jj.RigidBody(
                self.mass, inertia, jj.vec(q.x, q.y, q.z), jj.quaternion_to_matrix(q.attitude)
            )
        }

    def loads(self, motion):
        return jj.gravity(motion, 9.81)

    def contacts(self, pose):
        rim = jj.disc_contact(
            pose["coin"], self.radius, axis="z", height="row", friction=self.friction, restitution=self.bounce
        )
        return {"rim": rim}
