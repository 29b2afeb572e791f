"""Discs that roll without slip on a level plane."""

import math

import jax.numpy as jnp

from jourdain_jax.calculus.reals import Parameter
from jourdain_jax.calculus.rotations import quaternion_to_matrix, rot_x, rot_y, rot_z, vec
from jourdain_jax.models.weight import Heavy
from jourdain_jax.scene.bodies import RigidBody
from jourdain_jax.scene.contact.contacts import disc_contact
from jourdain_jax.scene.coordinates import coordinates, parameter, quaternion


class VerticalDisc(Heavy):
    """An upright disc that rolls and turns on a level plane.

    Both rates are constant, and the path is a circle or a straight line.

        xdot = R cos(heading) rolldot,   ydot = R sin(heading) rolldot

    Source: A. M. Bloch, Nonholonomic Mechanics and Control (2003), section 1.4.

    Coordinates: x, y of the contact point (and of the centre), heading about the vertical, roll about the
    axle.
    """

    mass: Parameter = parameter(1.0, unit="kg", positive=True)
    radius: Parameter = parameter(1.0, unit="m", positive=True)
    roll_inertia: Parameter = parameter(1.0, unit="kg m^2", positive=True, about="about the axle")
    turn_inertia: Parameter = parameter(1.0, unit="kg m^2", positive=True, about="about a diameter")
    gravity: Parameter = parameter(9.81, unit="m/s^2")

    coordinates = coordinates("x y heading roll")
    privileged = ("heading_rate", "roll_rate")
    conventions = "z up; heading from x towards y; axle along body y; positive roll moves forwards."
    example = {"heading_rate": 2.0, "roll_rate": 1.0}
    example_span = 1.0

    def bodies(self, t, q):
        disc = RigidBody.thin_disc(
            self.mass,
            self.radius,
            axis="y",
            position=jnp.stack([q.x, q.y, self.radius]),
            orientation=rot_z(q.heading) @ rot_y(q.roll),
            axial=self.roll_inertia,
            diametral=self.turn_inertia,
        )
        return {"disc": disc}

    def contacts(self, pose):
        return {"rim": disc_contact(pose["disc"], self.radius)}

    def invariants(self, motion):
        return {"turn rate": motion.u.heading_rate, "roll rate": motion.u.roll_rate}


class _ThinDisc(Heavy):
    """A uniform thin disc on a level plane; the axle is body axis y."""

    mass: Parameter = parameter(1.0, unit="kg", positive=True)
    radius: Parameter = parameter(0.5, unit="m", positive=True)
    gravity: Parameter = parameter(9.81, unit="m/s^2")

    example_span = 10.0

    def _disc(self, centre, orientation) -> dict[str, RigidBody]:
        return {
            "disc": RigidBody.thin_disc(
                self.mass, self.radius, axis="y", position=centre, orientation=orientation
            )
        }


class TiltingDisc(_ThinDisc):
    """A thin disc that rolls without slip on a level plane, described by angles.

    This is the classic problem of Appell and Korteweg.

    Contact and height are built into the coordinates. Two no-slip constraints leave three degrees of freedom.
    The coordinates are singular where the disc lies flat (lean = +-pi/2); use `TiltingDiscQuaternion` near
    that position. Source: Wang and Pao (2003), section V; J. I. Neimark and N. A. Fufaev, Dynamics of
    Nonholonomic Systems (1972).

    Coordinates: x, y of the contact point; yaw about z, lean about the heading, spin about the axle.
    """

    coordinates = coordinates("x y yaw lean spin")
    domain = {"lean": (-1.2, 1.2)}
    conventions = (
        "z up; upright at lean = 0, heading along x at yaw = 0; axle along body y; positive spin rolls"
        " forward."
    )
    example = {"lean": 0.3, "yaw_rate": 0.5, "lean_rate": 0.2, "spin_rate": -3.0}

    def bodies(self, t, q):
        frame = rot_z(q.yaw) @ rot_x(q.lean)
        centre = vec(q.x, q.y, 0) + self.radius * frame[:, 2]
        return self._disc(centre, frame @ rot_y(q.spin))

    def contacts(self, pose):
        return {"rim": disc_contact(pose["disc"], self.radius, axis="y", height="coordinates")}

    def events(self, motion):
        return {"fallen": 1.5 - jnp.abs(motion.q.lean)}


_TILTED = TiltingDisc.example


class TiltingDiscQuaternion(_ThinDisc):
    """A thin disc that rolls without slip on a level plane, described as a free body.

    One height constraint and two no-slip constraints on six speeds leave three degrees of freedom, with the
    motion of `TiltingDisc`. The coordinates are regular everywhere, so that the scene is valid until the disc
    lies flat and the contact point is undefined. Source: Wang and Pao (2003), section V; R. Cushman and J. J.
    Duistermaat, Regular and Chaotic Dynamics 11 (2006) 31.

    Coordinates: x, y, z of the centre, attitude as a quaternion. Speeds: x_rate, y_rate, z_rate, body angular
    velocity. The axle is body axis y.
    """

    coordinates = coordinates("x y z", quaternion("attitude"))
    domain = {"z": (0.05, 0.5), **{f"attitude_omega_{axis}": (-3.0, 3.0) for axis in "xyz"}}
    conventions = (
        "z up; x, y, z of the centre; upright and heading along x at identity attitude; axle along body y."
    )
    example = {
        "y": -0.5 * math.sin(_TILTED["lean"]),
        "attitude_w": math.cos(_TILTED["lean"] / 2),
        "attitude_x": math.sin(_TILTED["lean"] / 2),
        "attitude_omega_x": _TILTED["lean_rate"],
        "attitude_omega_y": _TILTED["spin_rate"] + _TILTED["yaw_rate"] * math.sin(_TILTED["lean"]),
        "attitude_omega_z": _TILTED["yaw_rate"] * math.cos(_TILTED["lean"]),
    }

    def bodies(self, t, q):
        return self._disc(jnp.stack([q.x, q.y, q.z]), quaternion_to_matrix(q.attitude))

    def contacts(self, pose):
        return {"rim": disc_contact(pose["disc"], self.radius, height="row")}

    def events(self, motion):
        axle = motion["disc"].orientation[:, 1]
        # below 45 units of round-off of the squared angle to the ground (1e-7 rad in double precision) the
        # contact point is undefined
        return {"flat": axle[0] ** 2 + axle[1] ** 2 - 45.0 * jnp.finfo(axle.dtype).eps}
