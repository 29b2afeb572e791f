"""Two wheels on a rigid axle that roll down an incline: one system as four scenes, by the methods of the
paper.

    Method I    `TwoWheelAxleFree`         two free bodies, 12 coordinates, ten constraints (61)
    Method II   `TwoWheelAxleCoordinates`  seven coordinates, the five constraints (65)
    Method III  `TwoWheelAxleQuasi`        seven coordinates, two quasi-velocities (67), no constraints
    redundant   `TwoWheelAxleRedundant`    Method I with (60a) and (60b): eleven constraints of rank 10

All have two degrees of freedom and Appell's equations (64):

    2 a (M + m') psi1'' -      l (M + m') phi''                = 2 M g sin(alpha) cos(phi)
    a l (M + m') psi1'' - (M l^2 + m' l^2 + m' a^2) phi''      = M g l sin(alpha) cos(phi)

hence `phi'' = 0` and `psi1'' = M g sin(alpha) cos(phi) / (a (M + m'))`. Source: Wang and Pao, Am. J. Phys. 71
(2003) 72, section VI, eqs. (57)-(67).
"""

import jax.numpy as jnp

from jourdain_jax.calculus.reals import Parameter
from jourdain_jax.calculus.rotations import rot_x, rot_y, rot_z
from jourdain_jax.scene.bodies import RigidBody, Visual
from jourdain_jax.scene.contact.contacts import disc_contact
from jourdain_jax.scene.coordinates import coordinates, parameter, speeds
from jourdain_jax.scene.loads import gravity
from jourdain_jax.scene.scene import Scene


class _TwoWheelAxle(Scene):
    """The common parts of the four scenes: parameters, a wheel, weight, and known integrals."""

    radius: Parameter = parameter(0.3, unit="m", positive=True, about="a, of the wheels")
    length: Parameter = parameter(0.8, unit="m", positive=True, about="l, of the axle")
    mass: Parameter = parameter(
        1.2, unit="kg", positive=True, about="M, of a wheel with its load, at its centre"
    )
    rim_mass: Parameter = parameter(
        0.5, unit="kg", positive=True, about="m': a wheel's moments are m'a^2 and m'a^2/2"
    )
    slope: Parameter = parameter(0.2, unit="rad", about="alpha, of the incline")
    gravity: Parameter = parameter(9.81, unit="m/s^2")

    conventions = (
        "x down the slope, y across it, z along its normal; heading phi from x towards y, theta about the "
        "heading, psi about the axle, positive forwards: angular velocity phidot k + thetadot i' + psidot "
        "j''; wheel 2 is on the left of wheel 1."
    )
    example_span = 10.0

    def loads(self, motion):
        return (gravity(motion, self.gravity, -rot_y(self.slope)[2]),)

    def visuals(self, pose):
        return {"": Visual.line(pose["wheel1"].position, pose["wheel2"].position, radius=0.1 * self.radius)}

    def _wheel(self, centre, phi, theta, psi) -> RigidBody:
        return RigidBody.thin_disc(
            self.mass,
            self.radius,
            axis="y",
            position=jnp.stack(centre),
            orientation=rot_z(phi) @ rot_x(theta) @ rot_y(psi),
            axial=self.rim_mass * self.radius**2,
            diametral=self.rim_mass * self.radius**2 / 2,
        )

    def _rolling(self, pose, height: str):
        """Return the rolling contacts of both wheels. Each wheel carries its own weight, since the axle
        transmits no load.
        """
        return {
            wheel: disc_contact(pose[wheel], self.radius, height=height, carried=(wheel,))
            for wheel in ("wheel1", "wheel2")
        }

    def _axle_row(self, psi1_rate, psi2_rate, phi_rate):
        # (61): a psidot_2 = a psidot_1 - l phidot
        return self.radius * psi2_rate - self.radius * psi1_rate + self.length * phi_rate

    def _integrals(self, q, phi, psi1_rate, phi_rate):
        push = self.mass * self.gravity * jnp.sin(self.slope) / (self.mass + self.rim_mass)
        return {
            "turn rate": phi_rate,
            "rolling and heading": self.radius * psi1_rate * phi_rate - push * jnp.sin(phi),
            "wheel angles": self.radius * (q.psi2 - q.psi1) + self.length * phi,
            "axle along x": q.x2 - q.x1 + self.length * jnp.sin(phi),
            "axle along y": q.y2 - q.y1 - self.length * jnp.cos(phi),
        }


class _FreeWheels(_TwoWheelAxle):
    """Two upright wheels as free bodies that roll with one heading; subclasses add the constraint of the
    axle.
    """

    coordinates = coordinates("x1 y1 z1 phi1 theta1 psi1 x2 y2 z2 phi2 theta2 psi2")
    privileged = ("psi1_rate", "phi1_rate")
    domain = {"z1": (0.1, 0.5), "z2": (0.1, 0.5)}
    example = {"y2": 0.8, "psi1_rate": 0.7 / 0.3, "phi1_rate": 1.1}

    def bodies(self, t, q):
        return {
            "wheel1": self._wheel([q.x1, q.y1, q.z1], q.phi1, q.theta1, q.psi1),
            "wheel2": self._wheel([q.x2, q.y2, q.z2], q.phi2, q.theta2, q.psi2),
        }

    def geometric_constraints(self, pose):
        return {
            "wheel1 upright": pose.q.theta1,
            "wheel2 upright": pose.q.theta2,
            "one heading": pose.q.phi1 - pose.q.phi2,
        }

    def contacts(self, pose):
        return self._rolling(pose, "row")

    def invariants(self, motion):
        return self._integrals(motion.q, motion.q.phi1, motion.u.psi1_rate, motion.u.phi1_rate)


class TwoWheelAxleFree(_FreeWheels):
    """Two wheels on an axle down an incline, Method I: two free bodies, ten constraints.

    Equations of motion: Jourdain's equation (50).
    """

    def velocity_constraints(self, motion):
        return {"rigid axle": self._axle_row(motion.u.psi1_rate, motion.u.psi2_rate, motion.u.phi1_rate)}


class TwoWheelAxleRedundant(_FreeWheels):
    """Two wheels on an axle down an incline, Method I with both constraints (60a) and (60b).

    Either one alone does not describe the axle where its factor, cos phi or sin phi, is zero.
    """

    def velocity_constraints(self, motion):
        u, phi = motion.u, motion.q.phi1
        return {
            "axle along x": u.x2_rate - u.x1_rate + self.length * u.phi1_rate * jnp.cos(phi),  # (60a)
            "axle along y": u.y2_rate - u.y1_rate + self.length * u.phi1_rate * jnp.sin(phi),  # (60b)
        }


class _UprightWheels(_TwoWheelAxle):
    """Two upright wheels with one heading in the seven coordinates of Methods II and III."""

    coordinates = coordinates("x1 y1 psi1 x2 y2 psi2 phi")

    def bodies(self, t, q):
        upright = jnp.zeros_like(q.phi)
        return {
            "wheel1": self._wheel([q.x1, q.y1, self.radius], q.phi, upright, q.psi1),
            "wheel2": self._wheel([q.x2, q.y2, self.radius], q.phi, upright, q.psi2),
        }


class TwoWheelAxleCoordinates(_UprightWheels):
    """Two wheels on an axle down an incline, Method II: seven coordinates, five constraints (65).

    Equations of motion: Appell's equations (52).
    """

    privileged = ("psi1_rate", "phi_rate")
    example = {"y2": 0.8, "psi1_rate": 0.7 / 0.3, "phi_rate": 1.1}

    def contacts(self, pose):
        return self._rolling(pose, "coordinates")

    def velocity_constraints(self, motion):
        return {"rigid axle": self._axle_row(motion.u.psi1_rate, motion.u.psi2_rate, motion.u.phi_rate)}

    def invariants(self, motion):
        return self._integrals(motion.q, motion.q.phi, motion.u.psi1_rate, motion.u.phi_rate)


class TwoWheelAxleQuasi(_UprightWheels):
    """Two wheels on an axle down an incline, Method III: quasi-velocities (67).

    The constraints make five of the seven quasi-velocities zero; the rolling of wheel 1 and the turning
    remain.
    """

    speeds = speeds("rolling turning")
    example = {"y2": 0.8, "rolling": 0.7 / 0.3, "turning": 1.1}

    def coordinate_rates(self, t, q, u):
        forward = self.radius * jnp.stack([jnp.cos(q.phi), jnp.sin(q.phi)])
        psi1_rate, psi2_rate = u.rolling, u.rolling - self.length / self.radius * u.turning
        first, second = forward * psi1_rate, forward * psi2_rate
        return jnp.stack([first[0], first[1], psi1_rate, second[0], second[1], psi2_rate, u.turning])

    def invariants(self, motion):
        return self._integrals(motion.q, motion.q.phi, motion.u.rolling, motion.u.turning)
