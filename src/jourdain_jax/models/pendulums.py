"""Pendulums of particles in a vertical plane, described by angles, or by Cartesian coordinates with rods as
geometric constraints.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jourdain_jax.calculus.reals import Numbers, Parameter, Scalar, Vector3, checked_whole, is_traced
from jourdain_jax.calculus.rotations import vec
from jourdain_jax.models.weight import Heavy
from jourdain_jax.scene.bodies import Particle, Visual
from jourdain_jax.scene.coordinates import coordinates, parameter
from jourdain_jax.scene.loads import damper, gravity, rod, spring
from jourdain_jax.scene.motion_state import fixed_point
from jourdain_jax.scene.scene import Scene


class _DoublePendulum(Heavy):
    """Two particles on massless rods, one below the other."""

    mass1: Parameter = parameter(1.0, unit="kg", positive=True)
    mass2: Parameter = parameter(0.7, unit="kg", positive=True)
    length1: Parameter = parameter(1.0, unit="m", positive=True)
    length2: Parameter = parameter(0.8, unit="m", positive=True)
    gravity: Parameter = parameter(9.81, unit="m/s^2")

    def visuals(self, pose):
        return {
            "": Visual.line(
                jnp.zeros(3), pose["first"].position, pose["second"].position, radius=0.012 * self.length1
            )
        }


class DoublePendulumAngles(_DoublePendulum):
    """Planar double pendulum on massless rods, described by the angles of the rods.

    The two particles have two degrees of freedom and no constraints.

        (m1 + m2) l1 th1'' + m2 l2 cos(th1 - th2) th2''
                           + m2 l2 sin(th1 - th2) th2'^2 + (m1 + m2) g sin(th1) = 0
        l2 th2'' + l1 cos(th1 - th2) th1'' - l1 sin(th1 - th2) th1'^2 + g sin(th2) = 0

    The same system as `DoublePendulumRods`. Source: L. D. Landau and E. M. Lifshitz, Mechanics, section 5,
    problem 1.

    Coordinates: angles of the upper and the lower rod from straight down. The pivot is at the origin.
    """

    coordinates = coordinates("theta1 theta2")
    domain = {"theta1_rate": (-3.0, 3.0), "theta2_rate": (-3.0, 3.0)}
    conventions = "x horizontal, z up; pivot at the origin; angles from straight down, positive towards +x."
    example = {"theta1": 0.8, "theta2": -0.4, "theta1_rate": 0.3, "theta2_rate": 0.5}

    def bodies(self, t, q):
        first = self.length1 * _along(q.theta1)
        return {
            "first": Particle(self.mass1, first),
            "second": Particle(self.mass2, first + self.length2 * _along(q.theta2)),
        }


def _along(angle) -> Vector3:
    """Return the unit vector at `angle` from straight down, in the x-z plane."""
    return vec(jnp.sin(angle), 0, -jnp.cos(angle))


class DoublePendulumRods(_DoublePendulum):
    """Planar double pendulum on massless rods, described by Cartesian coordinates.

    The rods of the two particles are geometric constraints:

        |r1|^2 = l1^2,   |r2 - r1|^2 = l2^2

    The same system as `DoublePendulumAngles`, which has no constraints. Multipliers are the thrusts in the
    rods, N (negative: tension).

    Coordinates: x, z of both particles. The pivot is at the origin.
    """

    coordinates = coordinates("x1 z1 x2 z2")
    domain = {"x2": (-1.5, 1.5), "z2": (-1.5, 1.5)}
    conventions = "x horizontal, z up; pivot at the origin."
    example = {
        "x1": 0.6,
        "z1": -0.8,
        "x2": 0.6,
        "z2": -1.6,
        "x1_rate": 0.4,
        "z1_rate": 0.3,
        "x2_rate": 0.4,
        "z2_rate": 0.3,
    }

    def bodies(self, t, q):
        return _in_plane(self, q)

    def geometric_constraints(self, pose):
        first, second = pose["first"].position, pose["second"].position
        return {
            "upper rod": rod(jnp.zeros(3), first, self.length1),
            "lower rod": rod(first, second, self.length2),
        }


def _in_plane(scene: "DoublePendulumRods | SpringAndRod", q) -> dict[str, Particle]:
    """Return two particles at Cartesian coordinates in the x-z plane."""
    first, second = vec(q.x1, 0, q.z1), vec(q.x2, 0, q.z2)
    return {"first": Particle(scene.mass1, first), "second": Particle(scene.mass2, second)}


class SpringAndRod(Scene):
    """Two particles in a vertical plane, one on a spring, one on a rod.

    The spring connects the first particle to the origin, the rod connects the second to the first.

    The force of the spring is impressed: it follows from the positions. The force of the rod follows from its
    constraint `|r2 - r1| = l`; its multiplier is the thrust in the rod, N (negative: tension). Source: Wang
    and Pao (2003), section I.

    Coordinates: x, z of both particles. A spring (with damper) connects origin and first particle, a rod both
    particles.
    """

    mass1: Parameter = parameter(1.0, unit="kg", positive=True)
    mass2: Parameter = parameter(0.6, unit="kg", positive=True)
    stiffness: Parameter = parameter(40.0, unit="N/m", non_negative=True)
    natural_length: Parameter = parameter(0.5, unit="m", non_negative=True, about="of the spring")
    damping: Parameter = parameter(0.0, unit="N s/m", non_negative=True, about="along the spring")
    rod_length: Parameter = parameter(0.6, unit="m", positive=True)
    gravity: Parameter = parameter(9.81, unit="m/s^2")

    coordinates = coordinates("x1 z1 x2 z2")
    domain = {"x2": (-1.5, 1.5), "z2": (-1.5, 1.5)}
    conventions = "x horizontal, z up; the spring's fixed end is the origin."

    @property
    def example(self):
        """Return a start with the rod level and turning."""
        places = {"x1": 0.3, "z1": -0.6, "x2": 0.3 + self.rod_length, "z2": -0.6}
        return places | {"x1_rate": 0.4, "z1_rate": 0.1, "x2_rate": 0.4, "z2_rate": 0.7}

    def bodies(self, t, q):
        return _in_plane(self, q)

    def loads(self, motion):
        anchor, first = fixed_point(jnp.zeros(3)), motion["first"].point()
        return (
            gravity(motion, self.gravity),
            spring(anchor, first, self.stiffness, self.natural_length),
            damper(anchor, first, self.damping),
        )

    def geometric_constraints(self, pose):
        return {"rod": rod(pose["first"].position, pose["second"].position, self.rod_length)}

    def visuals(self, pose):
        first, second = pose["first"].position, pose["second"].position
        return {
            "": [
                Visual.coil(jnp.zeros(3), first, 0.06 * self.rod_length),
                Visual.line(first, second, radius=0.02 * self.rod_length),
            ]
        }


class PendulumChain(Heavy):
    """A chain of n particles joined by massless rods that hangs from a pivot in a vertical plane.

    Each rod is a geometric constraint:

        |r_i - r_{i-1}|^2 = l_i^2,   r_0 = 0

    In Cartesian coordinates each constraint couples only two neighbours: `A M^-1 A'` is tridiagonal, while
    the mass matrix in angles would be dense. n = 2 is the double pendulum. Multipliers are the thrusts in the
    rods, N (negative: tension).

    Coordinates: x, z of all particles, from the pivot down. Masses and lengths are one number, or one per
    link.
    """

    links: int = eqx.field(static=True, default=5)
    mass: Float[Array, "*links"] = parameter(0.2, unit="kg", positive=True)
    length: Float[Array, "*links"] = parameter(0.3, unit="m", positive=True)
    gravity: Parameter = parameter(9.81, unit="m/s^2")

    conventions = "x horizontal, z up; pivot at the origin; particle 1 hangs from the pivot."
    example_span = 3.0

    def __check_init__(self):
        checked_whole(self.links, "`links` of `PendulumChain`", 1, expected="of particles >= 1")

    @property
    def coordinates(self):
        """Return names of x and z of every particle."""
        return coordinates(*(f"x{i} z{i}" for i in range(1, self.links + 1)))

    @property
    def domain(self):
        """Return the domain: the reach of the chain, with the default lengths in place of traced ones."""
        reach = np.cumsum(np.broadcast_to(0.3 if is_traced(self.length) else self.length, self.links))
        return {f"{axis}{i + 1}": (-r, r) for i, r in enumerate(reach.tolist()) for axis in "xz"}

    @property
    def example(self):
        """Return a straight chain at rest, 60 degrees from hanging."""
        return self.hanging([jnp.pi / 3] * self.links)

    def hanging(self, angles: Numbers) -> dict[str, Scalar]:
        """Return coordinates of a chain whose rods have these angles (rad) from straight down, positive
        towards +x.
        """
        angles, lengths = jnp.asarray(angles), self._per_link(self.length)
        x, z = jnp.cumsum(lengths * jnp.sin(angles)), -jnp.cumsum(lengths * jnp.cos(angles))
        return {f"x{i + 1}": x[i] for i in range(self.links)} | {f"z{i + 1}": z[i] for i in range(self.links)}

    def bodies(self, t, q):
        masses = self._per_link(self.mass)
        places = {i: vec(q[f"x{i}"], 0, q[f"z{i}"]) for i in range(1, self.links + 1)}
        return {f"particle {i}": Particle(masses[i - 1], place) for i, place in places.items()}

    def geometric_constraints(self, pose):
        lengths = self._per_link(self.length)
        places = self._joints(pose)
        return {f"rod {i + 1}": rod(places[i], places[i + 1], lengths[i]) for i in range(self.links)}

    def visuals(self, pose):
        places = self._joints(pose)
        return {"": Visual.line(*places, radius=0.02 * jnp.min(self.length))}

    def _joints(self, pose) -> list[Vector3]:
        return [jnp.zeros(3), *(body.position for body in pose.bodies.values())]

    def _per_link(self, value) -> Float[Array, "links"]:
        return jnp.broadcast_to(value, (self.links,))
