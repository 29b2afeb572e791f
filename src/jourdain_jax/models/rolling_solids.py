"""Solids that roll without slip: a ball on a turntable, a rattleback."""

import math

import jax.numpy as jnp

from jourdain_jax.calculus.reals import Matrix3, Parameter, Vector3
from jourdain_jax.calculus.rotations import quaternion_rate, quaternion_to_matrix, rot_x, rot_y, rot_z, vec
from jourdain_jax.models.weight import Heavy
from jourdain_jax.scene.bodies import RigidBody, Visual
from jourdain_jax.scene.contact.contacts import ball_contact, ellipsoid_contact
from jourdain_jax.scene.contact.grounds import Plane
from jourdain_jax.scene.coordinates import coordinates, parameter, quaternion, speeds


class BallOnTurntable(Heavy):
    """A ball that rolls on a level or tilted turntable. Its constraints are affine, because the ground moves.

    Its centre moves like a charge in a magnetic field: in a circle on a level table, and drifting *across*
    the direction of steepest descent on a tilted one.

        R'' = n z x R' + g sin(tilt) x / (1 + kappa)
        n = Om kappa / (1 + kappa)                               (2/7 Om for a solid ball)

    R: the centre; z, x: unit vectors normal to the table and downhill; Om: turn rate of the table.

    The speeds are quasi-velocities: the rates of the centre and the angular velocity in the axes of the
    table. With these the constraints have constant coefficients and do not depend on the attitude, a
    quaternion needed only for drawing. Source: K. Weltner, Am. J. Phys. 47 (1979) 984.

    Coordinates: x, y of the centre along the table, and the attitude. Speeds: x_rate, y_rate, and the angular
    velocity roll_x, roll_y, spin in the axes of the table.
    """

    mass: Parameter = parameter(1.0, unit="kg", positive=True)
    radius: Parameter = parameter(0.05, unit="m", positive=True)
    inertia_ratio: Parameter = parameter(0.4, positive=True, about="kappa = I/(m r^2): 2/5 solid, 2/3 hollow")
    turn_rate: Parameter = parameter(
        2.0, unit="rad/s", about="Om, of the table about its normal through the origin"
    )
    tilt: Parameter = parameter(0.0, unit="rad", about="of the table, down along x")
    gravity: Parameter = parameter(9.81, unit="m/s^2")

    coordinates = coordinates("x y", quaternion("attitude"))
    speeds = speeds("x_rate y_rate roll_x roll_y spin")
    privileged = ("x_rate", "y_rate", "spin")
    domain = dict.fromkeys(("roll_x", "roll_y", "spin"), (-10.0, 10.0))
    conventions = (
        "z up; x, y along the table (x downhill when tilt > 0, y level), which turns anticlockwise about its"
        " normal."
    )
    example = {"x": 0.2, "x_rate": 0.1, "y_rate": 0.3, "spin": 1.0}
    example_span = 10.0

    def bodies(self, t, q):
        x_axis, y_axis, normal = self._axes()
        centre = q.x * x_axis + q.y * y_axis + self.radius * normal
        turned = quaternion_to_matrix(q.attitude)
        return {
            "ball": RigidBody.ball(
                self.mass, self.radius, position=centre, orientation=turned, factor=self.inertia_ratio
            )
        }

    def coordinate_rates(self, t, q, u):
        omega = jnp.stack([u.roll_x, u.roll_y, u.spin]) @ self._axes()  # space components
        omega_body = quaternion_to_matrix(q.attitude).T @ omega
        return jnp.concatenate([jnp.stack([u.x_rate, u.y_rate]), quaternion_rate(q.attitude, omega_body)])

    def contacts(self, pose):
        normal = self._axes()[2]
        table = Plane(tilt=self.tilt, angular_velocity=self.turn_rate * normal)
        return {"table": ball_contact(pose["ball"], self.radius, ground=table)}

    def visuals(self, pose):
        axes, width = self._axes().T, 0.2 * self.radius
        turned = axes @ rot_z(self.turn_rate * pose.t)
        return {
            "": Visual.wheel(
                12 * self.radius, width, axis="z", at=-width / 2 * axes[:, 2], turn=turned, colour="#b9b2a4"
            )
        }

    def invariants(self, motion):
        q, u = motion.q, motion.u
        gyration = self.turn_rate * self.inertia_ratio / (1 + self.inertia_ratio)
        push = self.gravity * jnp.sin(self.tilt) / (1 + self.inertia_ratio)
        guide_x, guide_y = u.x_rate + gyration * q.y - push * motion.t, u.y_rate - gyration * q.x
        return {"spin": u.spin, "guiding centre along x": guide_x, "guiding centre along y": guide_y}

    def _axes(self) -> Matrix3:
        """Return downhill, level and normal unit vectors of the table, as rows."""
        table = Plane(tilt=self.tilt)
        return jnp.vstack([table.tangents, table.normal])


class Rattleback(Heavy):
    """The rattleback (celt): an ellipsoid that rolls without slip on a level plane.

    Its principal axes of inertia are turned relative to the axes of the ellipsoid.

    Space axes n1 and n2 are level, n3 points DOWN. Body axes are the axes of the ellipsoid, with axis 3 down
    at zero angles; the body is turned by gamma about 3, alpha about 1, beta about 2, in this order. mu = R'
    n3 is the downward vertical in body axes. At the contact point the outward normal is mu. The vector from
    the mass centre to this point is, with the depth h of the mass centre below the ellipsoid's centre,

        rho = S mu / sqrt(mu . S mu) - h e3,   S = diag(a^2, b^2, c^2)

    The height of the mass centre, rho . mu, is built into the coordinates. Two no-slip constraints leave
    three degrees of freedom. Source: T. R. Kane and D. A. Levinson, Int. J. Non-Linear Mech. 17 (1982) 175.

    Coordinates: x, y of the mass centre; angles alpha, beta, gamma, singular at alpha = +-pi/2. Speeds:
    x_rate, y_rate, and the body angular velocity w1, w2, w3.
    """

    mass: Parameter = parameter(1.0, unit="kg", positive=True)
    a: Parameter = parameter(0.20, unit="m", positive=True, about="semi-axis along body 1")
    b: Parameter = parameter(0.03, unit="m", positive=True, about="semi-axis along body 2")
    c: Parameter = parameter(0.02, unit="m", positive=True, about="semi-axis along body 3")
    h: Parameter = parameter(0.01, unit="m", about="of the mass centre below the ellipsoid's centre")
    A: Parameter = parameter(2e-4, unit="kg m^2", positive=True, about="central moment of inertia about 1")
    B: Parameter = parameter(16e-4, unit="kg m^2", positive=True, about="central moment of inertia about 2")
    C: Parameter = parameter(17e-4, unit="kg m^2", positive=True, about="central moment of inertia about 3")
    D: Parameter = parameter(-0.2e-4, unit="kg m^2", about="entry 12 of the inertia matrix")
    gravity: Parameter = parameter(9.81, unit="m/s^2")

    coordinates = coordinates("x y alpha beta gamma")
    speeds = speeds("x_rate y_rate w1 w2 w3")
    privileged = ("w1", "w2", "w3")
    domain = {"alpha": (-1.0, 1.0), "beta": (-1.0, 1.0)} | dict.fromkeys(("w1", "w2", "w3"), (-5.0, 5.0))
    conventions = (
        "x, y, z inertial with z up, of the mass centre; angles and w1, w2, w3 refer to axes with n3 = -z "
        "down: R = rot3(gamma) rot1(alpha) rot2(beta), body axis 3 down at zero angles, so that w3 > 0 turns "
        "clockwise seen from above."
    )
    example = {"alpha": math.radians(0.5), "beta": math.radians(0.5), "w1": 0.0, "w2": 0.0, "w3": -5.0}
    example_span = 20.0

    def bodies(self, t, q):
        level = jnp.stack([q.x, q.y])
        # half a turn: from axes with n3 down to the engine's, z up
        turned = jnp.diag(jnp.array([1.0, -1.0, -1.0])) @ rot_z(q.gamma) @ rot_x(q.alpha) @ rot_y(q.beta)
        down = -turned[2]  # mu
        height = self.contact_arm(down) @ down
        return {"stone": RigidBody(self.mass, self._inertia(), jnp.append(level, height), turned)}

    def coordinate_rates(self, t, q, u):
        # body 1-3 components of gammadot n3 + alphadot n1' + betadot b2, solved for the rates
        gamma_rate = (u.w3 * jnp.cos(q.beta) - u.w1 * jnp.sin(q.beta)) / jnp.cos(q.alpha)
        alpha_rate = u.w1 * jnp.cos(q.beta) + u.w3 * jnp.sin(q.beta)
        beta_rate = u.w2 - gamma_rate * jnp.sin(q.alpha)
        return jnp.stack([u.x_rate, u.y_rate, alpha_rate, beta_rate, gamma_rate])

    def contacts(self, pose):
        return {"sole": ellipsoid_contact(pose["stone"], self._semi_axes(), centre=-self._below_centre())}

    def events(self, motion):
        return {"on edge": 1.4 - jnp.abs(motion.q.alpha)}

    def contact_arm(self, down: Vector3) -> Vector3:
        """Return the vector rho (m) from the mass centre to the ellipsoid's lowest point, in body axes.
        `down`: the downward vertical in body axes.
        """
        weighted = self._semi_axes() ** 2 * down
        return weighted / jnp.sqrt(down @ weighted) - self._below_centre()

    def _semi_axes(self) -> Vector3:
        return jnp.stack([self.a, self.b, self.c])

    def _below_centre(self) -> Vector3:
        return vec(0, 0, self.h)

    def _inertia(self) -> Matrix3:
        o = jnp.zeros_like(self.A)
        return jnp.stack(
            [jnp.stack([self.A, self.D, o]), jnp.stack([self.D, self.B, o]), jnp.stack([o, o, self.C])]
        )
