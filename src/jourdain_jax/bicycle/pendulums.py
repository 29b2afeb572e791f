"""The two pendulums by which the parts of a bicycle are measured, as scenes, and the periods of their small motions.

    swung on a level axle       (I + m l^2) angle'' + m g l sin angle = 0        T = 2 pi sqrt((I + m l^2) / (m g l))
    twisted on an upright rod   (n . I n) twist'' + k twist = 0                  T = 2 pi sqrt((n . I n) / k)

n is the direction of the rod in axes of the part. Periods come from the scenes by linearisation, not from these formulas, which the tests compare them with.
Source: J. D. G. Kooijman, Experimental validation of a model for the motion of an uncontrolled bicycle, M.Sc. thesis, Delft (2006), chapter 3.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jourdain_jax.calculus.rotations import rot_y, rot_z
from jourdain_jax.equations.virtual_power import generalized_forces, mass_matrix_at
from jourdain_jax.scene.bodies import RigidBody
from jourdain_jax.scene.coordinates import coordinates
from jourdain_jax.scene.loads import generalized_force, gravity
from jourdain_jax.scene.parameters import parameter
from jourdain_jax.scene.scene import Scene

Scalar = Float[Array, ""]


class SwungPart(Scene):
    """A part hung on a level axle, `length` away from its mass centre: a compound pendulum."""

    mass: Scalar = parameter(5.0, unit="kg", positive=True)
    inertia: Scalar = parameter(0.5, unit="kg m^2", positive=True)  # about an axis along the axle, through the mass centre
    length: Scalar = parameter(0.3, unit="m", positive=True)
    gravity: Scalar = parameter(9.81, unit="m/s^2")

    coordinates = coordinates("angle")
    conventions = "x horizontal, z up; the axle lies along y through the origin; angle from hanging straight down."

    def bodies(self, t, q):
        centre = self.length * jnp.stack([jnp.sin(q.angle), jnp.zeros_like(q.angle), -jnp.cos(q.angle)])
        return {"part": RigidBody(self.mass, jnp.full(3, self.inertia), centre, rot_y(-q.angle))}

    def loads(self, motion):
        return (gravity(motion, self.gravity),)


class TwistedPart(Scene):
    """A part clamped to an upright rod that twists, its mass centre below the rod: a torsional pendulum."""

    Ixx: Scalar = parameter(0.5, unit="kg m^2")
    Izz: Scalar = parameter(0.5, unit="kg m^2")
    Ixz: Scalar = parameter(0.0, unit="kg m^2")
    tilt: Scalar = parameter(0.0, unit="rad")  # of the part about its y axis, from where its z axis lies along the rod
    stiffness: Scalar = parameter(5.0, unit="N m/rad", positive=True)

    coordinates = coordinates("twist")
    conventions = "The rod lies along z; x and z of the part are in the plane of symmetry of the bicycle that it belongs to."

    def bodies(self, t, q):
        zero = jnp.zeros(())
        # Iyy does not matter to turns about a direction in the plane of x and z; nor does the mass
        inertia = jnp.stack([jnp.stack([self.Ixx, zero, self.Ixz]), jnp.array([0.0, 1.0, 0.0]), jnp.stack([self.Ixz, zero, self.Izz])])
        return {"part": RigidBody(1.0, inertia, jnp.zeros(3), rot_z(q.twist) @ rot_y(self.tilt))}

    def loads(self, motion):
        return (generalized_force(motion, twist_rate=-self.stiffness * motion.q.twist),)


def period(pendulum: SwungPart | TwistedPart) -> Scalar:
    """Period of small motions about rest, s: 2 pi sqrt(M / K), M the mass in the scene's equation, K by how much its force falls with the coordinate."""
    zero, rest = jnp.zeros(()), jnp.zeros(1)
    force = lambda q: generalized_forces(pendulum, zero, q, rest)[0]  # noqa: E731
    return 2 * jnp.pi * jnp.sqrt(mass_matrix_at(pendulum, zero, rest)[0, 0] / -jax.jvp(force, (rest,), (jnp.ones(1),))[1])
