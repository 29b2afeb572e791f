"""The full nonlinear Whipple bicycle: four rigid bodies on two knife-edge wheels that roll without slip.

Rear wheel R, rear frame with rider B, front frame (handlebar and fork) H, front wheel F. The rear contact and
its height are built into the coordinates; the front contact is the lowest point of the front wheel, with a
height constraint and two no-slip constraints, valid at any lean and steer. Five constraints leave three
degrees of freedom: lean, steer, forward motion.

Parameters have the source's names and frame: origin at the rear contact, x forward, y to the right, z DOWN.
The engine's frame has y to the left and z up, rotated by half a turn about x: `(x, y, z) -> (x, -y, -z)`, so
products of inertia change sign, `Ixz -> -Ixz`. Lean is a rotation about x in both. Steer is a rotation about
the steer axis `(sin lam, 0, -cos lam)`, downwards. Source: J. P. Meijaard, J. M. Papadopoulos, A. Ruina and
A. L. Schwab, Proc. R. Soc. A 463 (2007) 1955; defaults: its benchmark.
"""

import math
from collections.abc import Mapping

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jourdain_jax.calculus.reals import Matrix3, Number, Parameter, Scalar, Vector3, real_type
from jourdain_jax.calculus.rotations import rot_x, rot_y, rot_z, vec
from jourdain_jax.scene.bodies import RigidBody, Visual
from jourdain_jax.scene.contact.contacts import disc_contact
from jourdain_jax.scene.coordinates import Labels, check_name, coordinates, inputs, parameter, parameters_of
from jourdain_jax.scene.loads import generalized_force, gravity
from jourdain_jax.scene.scene import Scene


class WhippleBicycle(Scene):
    """The full nonlinear Whipple bicycle: four rigid bodies, with knife-edge wheels that do not slip.

    Coordinates: x, y of the rear contact; yaw, lean, pitch of the rear frame; steer; spins of the wheels
    relative to their frames.

    Inputs, both positive to the right (N m): `lean_torque`, an external torque on the rear frame about the
    level line through the rear contact; `steer_torque` on the front frame about the steer axis, with its
    reaction on the rear frame.
    """

    w: Parameter = parameter(1.02, unit="m", positive=True, about="wheelbase")
    c: Parameter = parameter(0.08, unit="m", about="trail")
    lam: Parameter = parameter(math.pi / 10, unit="rad", about="steer axis tilt, backwards from the vertical")
    g: Parameter = parameter(9.81, unit="m/s^2", about="gravity")
    rR: Parameter = parameter(0.3, unit="m", positive=True, about="rear wheel radius")
    mR: Parameter = parameter(2.0, unit="kg", positive=True, about="rear wheel mass")
    IRxx: Parameter = parameter(
        0.0603, unit="kg m^2", non_negative=True, about="rear wheel diametral moment of inertia"
    )
    IRyy: Parameter = parameter(
        0.12, unit="kg m^2", non_negative=True, about="rear wheel axial moment of inertia"
    )
    xB: Parameter = parameter(0.3, unit="m", about="rear frame centre of mass, forward")
    zB: Parameter = parameter(-0.9, unit="m", about="rear frame centre of mass, down")
    mB: Parameter = parameter(85.0, unit="kg", positive=True, about="rear frame and rider mass")
    IBxx: Parameter = parameter(
        9.2, unit="kg m^2", non_negative=True, about="rear frame moment of inertia about x"
    )
    IByy: Parameter = parameter(
        11.0, unit="kg m^2", non_negative=True, about="rear frame moment of inertia about y"
    )
    IBzz: Parameter = parameter(
        2.8, unit="kg m^2", non_negative=True, about="rear frame moment of inertia about z"
    )
    IBxz: Parameter = parameter(2.4, unit="kg m^2", about="rear frame product of inertia")
    xH: Parameter = parameter(0.9, unit="m", about="fork centre of mass, forward")
    zH: Parameter = parameter(-0.7, unit="m", about="fork centre of mass, down")
    mH: Parameter = parameter(4.0, unit="kg", positive=True, about="fork mass")
    IHxx: Parameter = parameter(
        0.05892, unit="kg m^2", non_negative=True, about="fork moment of inertia about x"
    )
    IHyy: Parameter = parameter(
        0.06, unit="kg m^2", non_negative=True, about="fork moment of inertia about y"
    )
    IHzz: Parameter = parameter(
        0.00708, unit="kg m^2", non_negative=True, about="fork moment of inertia about z"
    )
    IHxz: Parameter = parameter(-0.00756, unit="kg m^2", about="fork product of inertia")
    rF: Parameter = parameter(0.35, unit="m", positive=True, about="front wheel radius")
    mF: Parameter = parameter(3.0, unit="kg", positive=True, about="front wheel mass")
    IFxx: Parameter = parameter(
        0.1405, unit="kg m^2", non_negative=True, about="front wheel diametral moment of inertia"
    )
    IFyy: Parameter = parameter(
        0.28, unit="kg m^2", non_negative=True, about="front wheel axial moment of inertia"
    )

    coordinates = coordinates("x y yaw lean pitch steer rear_spin front_spin")
    inputs = inputs("lean_torque steer_torque")
    # regular at any steer; the rear wheel stops at a right angle
    privileged = ("lean_rate", "steer_rate", "front_spin_rate")
    domain = {"lean": (-0.8, 0.8), "pitch": (-0.1, 0.1), "steer": (-1.0, 1.0)}
    conventions = (
        "z up, x forward, y to the left at yaw = 0; parameters in the z-down frame of Meijaard et al. "
        "(2007). Turns in the order yaw, lean, pitch. Positive: yaw left, lean right, pitch nose down, steer "
        "right, spins rolling forward."
    )
    example = {"rear_spin_rate": 15.0, "lean_rate": 0.2, "steer_rate": 0.0}

    @classmethod
    def from_values(cls, values: Mapping[str, float | Array]) -> "WhippleBicycle":
        """Return the bicycle with these 26 parameters by name, as read from a parameter file.

        Raises ValueError with the names of missing or unknown parameters.
        """
        names = [name for name, _, _ in parameters_of(cls())]
        for name in values:
            check_name(name, names, f"unknown bicycle parameter `{name}`")
        missing = [name for name in names if name not in values]
        if missing:
            raise ValueError(
                f"bicycle parameters missing: {', '.join(f'`{name}`' for name in missing)}; "
                f"give all {len(names)}"
            )
        return cls(**values)

    def upright(self, speed: Number) -> dict[str, Scalar]:
        """Return the speeds of upright straight running at `speed` (m/s), the steady motion of the linear
        model; all other values are zero.
        """
        speed = jnp.asarray(speed, real_type())
        return {"x_rate": speed, "rear_spin_rate": speed / self.rR, "front_spin_rate": speed / self.rF}

    def bodies(self, t, q):
        contact = vec(q.x, q.y, 0)
        wheel_plane = rot_z(q.yaw) @ rot_x(q.lean)
        rear = wheel_plane @ rot_y(q.pitch)
        # about the steer axis (sin lam, 0, -cos lam) by +steer: about its opposite, the z axis tilted back,
        # by -steer
        front = rear @ rot_y(-self.lam) @ rot_z(-q.steer) @ rot_y(self.lam)
        rear_centre = contact + self.rR * wheel_plane[:, 2]
        # intersection of the axis and the ground when upright
        on_steer_axis = rear_centre + rear @ _vector(self.w + self.c, self.rR)
        front_centre = on_steer_axis + front @ _vector(-self.c, -self.rF)
        frame_centre = rear_centre + rear @ _vector(self.xB, self.zB + self.rR)
        fork_centre = on_steer_axis + front @ _vector(self.xH - self.w - self.c, self.zH)
        return {
            "rear wheel": _wheel(
                self.mR, self.rR, self.IRxx, self.IRyy, rear_centre, rear @ rot_y(q.rear_spin)
            ),
            "rear frame": RigidBody(
                self.mB, _inertia(self.IBxx, self.IByy, self.IBzz, self.IBxz), frame_centre, rear
            ),
            "front frame": RigidBody(
                self.mH, _inertia(self.IHxx, self.IHyy, self.IHzz, self.IHxz), fork_centre, front
            ),
            "front wheel": _wheel(
                self.mF, self.rF, self.IFxx, self.IFyy, front_centre, front @ rot_y(q.front_spin)
            ),
        }

    def visuals(self, pose):
        """Return shapes to draw: bars from the hubs to the steer axis for frame and fork, and a ball at the
        rider's mass centre.
        """
        on_axis = lambda z: (self.w + self.c + z * jnp.tan(self.lam), z)
        head = on_axis(-2.1 * self.rF)
        top = on_axis(-2.6 * self.rF)
        hub = (0.0, -self.rR)
        saddle = (0.26 * self.w, -2.5 * self.rR)
        crank = (0.42 * self.w, -0.85 * self.rR)
        bars = {
            "rear frame": (self.xB, self.zB, (hub, crank, head, saddle, crank)),
            "front frame": (self.xH, self.zH, ((self.w, -self.rF), head, top)),
        }
        lines = {
            name: [Visual.line(*(_vector(px - x, pz - z) for px, pz in points), radius=0.045 * self.rR)]
            for name, (x, z, points) in bars.items()
        }
        wheels = {
            name: Visual.wheel(radius, 0.12 * radius)
            for name, radius in (("rear wheel", self.rR), ("front wheel", self.rF))
        }
        grip = _vector(top[0] - self.xH, top[1] - self.zH)
        lines["front frame"].append(Visual.cylinder(0.045 * self.rR, 0.44 * self.w, axis="y", at=grip))
        lines["rear frame"].append(Visual.ball(0.2 * self.rR, opacity=0.6))
        return lines | wheels

    def loads(self, motion):
        torques = generalized_force(
            motion, lean_rate=motion.inputs.lean_torque, steer_rate=motion.inputs.steer_torque
        )
        return gravity(motion, self.g), torques

    def contacts(self, pose):
        return {
            "rear": disc_contact(pose["rear wheel"], self.rR, axis="y", height="coordinates"),
            "front": disc_contact(pose["front wheel"], self.rF, axis="y", height="row"),
        }

    def mode_names(self, eigenvalues: np.ndarray) -> Labels:
        """Return the names of four modes; no names for another number of modes.

        Weave is the complex pair. If all eigenvalues are real, weave consists of the two with equal sign that
        merge at a higher speed (when riding forward, the two that grow). Of the other two, castering is the
        faster mode and capsize the slower.
        """
        if len(eigenvalues) != 4:
            return ()
        order = np.argsort(-np.abs(eigenvalues.imag) if np.any(eigenvalues.imag) else -eigenvalues.real)
        fast, slow = sorted(order[2:], key=lambda k: -abs(eigenvalues[k]))
        return tuple("castering" if k == fast else "capsize" if k == slow else "weave" for k in range(4))

    def events(self, motion):
        # a lean that is too large, or a steer beyond a right angle, where a real handlebar hits the frame
        return {"fallen": jnp.minimum(1.2 - jnp.abs(motion.q.lean), jnp.pi / 2 - jnp.abs(motion.q.steer))}


def _vector(x, z) -> Vector3:
    """Return the vector (x, z) of the plane of symmetry, z down, in the engine's axes: (x, 0, -z)."""
    return vec(x, 0, -z)


def _inertia(xx, yy, zz, xz) -> Matrix3:
    """Return the inertia in the engine's axes; half a turn about x changes the sign of the product of
    inertia.
    """
    zero = jnp.zeros_like(xx)
    return jnp.stack([xx, zero, -xz, zero, yy, zero, -xz, zero, zz]).reshape(3, 3)


def _wheel(mass, radius, diametral, axial, centre, orientation) -> RigidBody:
    return RigidBody.thin_disc(
        mass, radius, axis="y", position=centre, orientation=orientation, axial=axial, diametral=diametral
    )
