"""A spherical robot: a shell, driven by a pendulum inside that turns about an axle fixed in the shell.

At rest and without torque, the pendulum swings fore and aft at W, W^2 = m g l / (m l^2 + J - (m r l)^2 / ((M
+ m) r^2 + I)): the shell rolls back under it. Source: V. A. Joshi, R. N. Banavar and R. Hippalgaonkar, Mech.
Mach. Theory 45 (2010) 130 (such robots).
"""

import jax.numpy as jnp

import jourdain_jax as jj

LOOK = (
    "The axle starts tilted. The driven robot follows a curve that bends to alternate sides as the axle"
    " rocks."
)


class SphericalRobot(jj.Scene):
    """Coordinates: x, y of the contact, attitude of the shell, angle of the pendulum in the shell. Input:
    `drive`, a torque on the shell about the axle (N m).
    """

    shell_mass: float = jj.parameter(1.0, unit="kg", positive=True)
    radius: float = jj.parameter(0.15, unit="m", positive=True)
    bob_mass: float = jj.parameter(1.5, unit="kg", positive=True)
    length: float = jj.parameter(
        0.08, unit="m", positive=True, about="of the pendulum, from the axle to its mass centre"
    )
    bob_inertia: jnp.ndarray = jj.parameter((1e-3, 1e-3, 1e-3), unit="kg m^2", positive=True)
    gravity: float = jj.parameter(9.81, unit="m/s^2")

    coordinates = jj.coordinates("x y", jj.quaternion("attitude"), "pendulum")
    inputs = jj.inputs("drive")
    domain = {"pendulum": (-3.2, 3.2)}
    conventions = (
        "z up; the axle is body y of the shell, the pendulum hangs along -z at angle zero; positive turns"
        " roll forward, along x."
    )
    example = {"attitude_w": 0.995, "attitude_x": 0.0998749, "attitude_omega_y": 6.0, "pendulum_rate": -6.0}
    example_span = 5.0

    def bodies(self, t, q):
        shell, centre = jj.quaternion_to_matrix(q.attitude), jj.vec(q.x, q.y, self.radius)
        arm = shell @ jj.rot_y(q.pendulum)
        rod = self.length * jnp.array([[0.0, 0.0, 1.0], [0.0, 0.0, 0.0]])
        return {
            "shell": jj.RigidBody.ball(
                self.shell_mass, self.radius, position=centre, orientation=shell, factor=2 / 3
            ),
            "pendulum": jj.RigidBody(
                self.bob_mass, self.bob_inertia, centre - self.length * arm[:, 2], arm, rod
            ),
        }

    def visuals(self, pose):
        return {"shell": jj.Visual.ball(self.radius, opacity=0.3)}

    def loads(self, motion):
        drive = motion.inputs.drive * motion["shell"].orientation[:, 1]
        return jj.gravity(motion, self.gravity), jj.torque(motion, "shell", drive, reaction="pendulum")

    def contacts(self, pose):
        return {"floor": jj.ball_contact(pose["shell"], self.radius)}
