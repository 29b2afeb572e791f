"""Scenes of the atlas about long, stiff and singular motions: balls, discs, rattlebacks in quaternions,
contact oscillators, a soft contact.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from small_scenes import OnLine

import jourdain_jax as jj
from atlas_cases.scenes import Weighted

_OMEGA = (-3.0, 3.0)


def _turning():
    """The domain of an angular velocity."""
    return {f"attitude_omega_{axis}": _OMEGA for axis in "xyz"}


class InSpace(Weighted):
    """A body whose attitude is a quaternion, under gravity."""

    coordinates = jj.coordinates("x y z", jj.quaternion("attitude"))

    def place(self, q):
        """Position and orientation."""
        return [q.x, q.y, q.z], jj.quaternion_to_matrix(q.attitude)


class CeltInQuaternion(InSpace):
    """The rattleback (B15) with a quaternion and a height row: no attitude is singular. z up; body axis 3
    down at identity of the table's angles.
    """

    gravity: object = jj.parameter(9.81)
    scale: float = eqx.field(static=True, default=1.0)  # units of length per metre

    @property
    def domain(self):
        """Heights in the unit of length."""
        return {"z": (0.01 * self.scale, 0.2 * self.scale), **_turning()}

    def bodies(self, t, q):
        k = self.scale**2
        inertia = k * jnp.array([[2e-4, -0.2e-4, 0.0], [-0.2e-4, 16e-4, 0.0], [0.0, 0.0, 17e-4]])
        return {"stone": jj.RigidBody(1.0, inertia, *self.place(q))}

    def loads(self, motion):
        return jj.gravity(motion, self.gravity * self.scale)

    def _arm(self, down):
        weighted = self.scale**2 * jnp.array([0.2, 0.03, 0.02]) ** 2 * down
        return weighted / jnp.sqrt(down @ weighted) - self.scale * jnp.array([0.0, 0.0, 0.01])

    def geometric_constraints(self, pose):
        stone = pose["stone"]
        down = -stone.orientation[2]
        return {"height": stone.position[2] - self._arm(down) @ down}

    def velocity_constraints(self, motion):
        stone = motion["stone"]
        return {"no slip": stone.velocity_at(stone.place(self._arm(-stone.orientation[2])))[:2]}


class EccentricBall(InSpace):
    """A ball of radius 1 m that rolls on a plane, its mass centre off its middle along the body axis z, about
    which its inertia is symmetric.
    """

    offset: object = jj.parameter(0.3)
    axial: object = jj.parameter(0.5, positive=True)
    transverse: object = jj.parameter(0.4, positive=True)
    domain = {"z": (0.7, 1.3), **_turning()}

    def bodies(self, t, q):
        inertia = jnp.stack([self.transverse, self.transverse, self.axial])
        return {"ball": jj.RigidBody(1.0, inertia, *self.place(q))}

    def _contact(self, body):
        middle = body.position - self.offset * body.orientation[:, 2]
        return middle - jnp.array([0.0, 0.0, 1.0])

    def geometric_constraints(self, pose):
        return {"height": self._contact(pose["ball"])[2]}

    def velocity_constraints(self, motion):
        ball = motion["ball"]
        return {"no slip": ball.velocity_at(self._contact(ball))[:2]}


class DragDisc(InSpace):
    """Euler's disc (B7): a rolling disc in quaternions that loses the power `drag psidot^2`; theta^2 then
    falls linearly, to zero in finite time.
    """

    drag: object = jj.parameter(1.7e-4, non_negative=True)
    domain = {"z": (0.05, 0.3), **_turning()}

    def bodies(self, t, q):
        centre, turned = self.place(q)
        return {"disc": jj.RigidBody.thin_disc(1.0, 0.3, axis="y", position=centre, orientation=turned)}

    def loads(self, motion):
        disc = motion["disc"]
        axle = disc.orientation[:, 1]
        # of length sin(theta), along the line from the contact to the centre
        up = jnp.array([0.0, 0.0, 1.0]) - axle[2] * axle
        # psidot = w . up / sin^2, and M . w = -drag psidot^2
        moment = -self.drag * (disc.angular_velocity @ up) / (up @ up) ** 2 * up
        return super().loads(motion), jj.torque(motion, "disc", moment)

    def contacts(self, pose):
        return {"rim": jj.disc_contact(pose["disc"], 0.3, height="row")}

    def events(self, motion):
        axle = motion["disc"].orientation[:, 1]
        # as the model `tilting_disc_quaternion`
        return {"flat": axle[0] ** 2 + axle[1] ** 2 - 45 * jnp.finfo(axle.dtype).eps}


class SteepEdge(OnLine):
    """A particle of 1 kg on a line, over an edge of its potential, 2 J high and 1e-6 m wide, at x = 1 m."""

    width: object = jj.parameter(1e-6, positive=True)

    def potential(self, pose):
        return 2.0 * jax.nn.sigmoid((pose.q.x - 1.0) / self.width)


class SoftWheel(jj.Scene):
    """The vertical disc (B4) with a contact of springs instead of rows: normal stiffness k and damping, slip
    resisted by `stiffness` times 1 s.

    What penalty methods do. Its limit is rolling.
    """

    stiffness: object = jj.parameter(1e5, positive=True)
    coordinates = jj.coordinates("x y z heading roll")
    domain = {"z": (0.9, 1.1), "heading": (-3.2, 3.2), "roll": (-3.2, 3.2)}

    def bodies(self, t, q):
        turned = jj.rot_z(q.heading) @ jj.rot_y(q.roll)
        return {"disc": jj.RigidBody(1.0, jnp.ones(3), [q.x, q.y, q.z], turned)}

    def loads(self, motion):
        disc, q, u, k = motion["disc"], motion.q, motion.u, self.stiffness
        contact = jnp.array([0.0, 0.0, -1.0])
        slip = disc.velocity + jnp.cross(disc.angular_velocity, contact)
        normal = k * (1.0 - q.z) + 9.81 - 0.1 * jnp.sqrt(k) * u.z_rate
        force = jnp.stack([-k * slip[0], -k * slip[1], normal])
        return jj.gravity(motion, 9.81), jj.point_force(disc.point(disc.orientation.T @ contact), force)


class SwitchedTurntable(jj.Scene):
    """A ball (radius 0.05 m, solid) on a flat turntable whose turning is reversed smoothly: Om(t) = -2 tanh(3
    (t - 1)) rad/s.
    """

    coordinates = jj.coordinates("x y", jj.quaternion("attitude"))

    def bodies(self, t, q):
        attitude = jj.quaternion_to_matrix(q.attitude)
        return {"ball": jj.RigidBody.ball(1.0, 0.05, position=[q.x, q.y, 0.05], orientation=attitude)}

    def contacts(self, pose):
        turning = -2.0 * jnp.tanh(3.0 * (pose.t - 1.0))
        table = jj.Plane(angular_velocity=jnp.stack([0.0, 0.0, turning]))
        return {"table": jj.ball_contact(pose["ball"], 0.05, ground=table)}
