"""Single particles with one velocity constraint: two linear ones, and one that is nonlinear in the
velocities.
"""

import jax.numpy as jnp

from jourdain_jax.calculus.reals import Parameter
from jourdain_jax.calculus.rotations import vec
from jourdain_jax.models.weight import Heavy
from jourdain_jax.scene.bodies import Particle, Visual
from jourdain_jax.scene.contact.grounds import tangents_of
from jourdain_jax.scene.coordinates import coordinates, parameter
from jourdain_jax.scene.scene import Scene


class _OnSheets(Scene):
    """A free particle whose constraint restricts velocities to a plane through each point."""

    mass: Parameter = parameter(1.0, unit="kg", positive=True)

    coordinates = coordinates("x y z")
    privileged = ("x_rate", "y_rate")

    def bodies(self, t, q):
        return {"particle": Particle(self.mass, jnp.stack([q.x, q.y, q.z]))}

    def _with_plane(self, normal) -> dict:
        """Return shapes to draw: the particle, and the plane of allowed velocities with this normal."""
        normal = normal / jnp.sqrt(normal @ normal)
        turn = jnp.vstack([tangents_of(normal), normal]).T
        return {"particle": [Visual.ball(0.05), Visual.box((0.6, 0.6, 0.01), turn=turn, opacity=0.5)]}


class RosenbergParticle(_OnSheets):
    """Rosenberg's particle, which has the constraint `zdot = y xdot` and no forces.

    It is the smallest nonholonomic system whose free motion is not straight.

        ydot = const,   xdot sqrt(1 + y^2) = const

    Source: R. M. Rosenberg, Analytical Dynamics of Discrete Systems (1977), ch. 15.

    The unit of length is chosen so that the constraint has no factor.
    """

    conventions = "Right-handed inertial frame without gravity; zdot = y xdot with y in metres."
    example = {"y": -1.0, "x_rate": 1.1 / 2**0.5, "y_rate": 0.8}

    def velocity_constraints(self, motion):
        return {"sheet": motion.u.z_rate - motion.q.y * motion.u.x_rate}

    def visuals(self, pose):
        return self._with_plane(vec(-pose.q.y, 0, 1))

    def invariants(self, motion):
        return {
            "y rate": motion.u.y_rate,
            "speed in the sheet": motion.u.x_rate * jnp.sqrt(1 + motion.q.y**2),
        }


class HeisenbergParticle(_OnSheets):
    """The Heisenberg system: a particle with the constraint `zdot = y xdot - x ydot` and no forces.

    It moves in straight lines.

    The variational ("vakonomic") principle with the same constraint would give helices, so that this system
    tests which principle an engine follows. Source: A. M. Bloch, Nonholonomic Mechanics and Control (2003),
    section 1.8.

    The unit of length is chosen so that the constraint has no factor.
    """

    conventions = "Right-handed inertial frame without gravity; zdot = y xdot - x ydot with x, y in metres."
    example = {"x": 0.3, "y": -0.2, "x_rate": 0.7, "y_rate": 0.4}
    example_span = 10.0

    def velocity_constraints(self, motion):
        q, u = motion.q, motion.u
        return {"contact form": u.z_rate - q.y * u.x_rate + q.x * u.y_rate}

    def visuals(self, pose):
        return self._with_plane(vec(-pose.q.y, pose.q.x, 1))

    def invariants(self, motion):
        return {"x rate": motion.u.x_rate, "y rate": motion.u.y_rate, "z rate": motion.u.z_rate}


class IsokineticParticle(Heavy):
    """A particle kept at constant speed c under gravity.

    Its constraint is *nonlinear* in the velocities:

        (v.v - c^2)/(2 c) = 0,     A = v/c,     virtual velocities obey v.dv = 0

    The multiplier is the force along the velocity, in N. Its virtual power is zero, but its real power is
    not: energy is not conserved. With `tau = g t/c` from level flight: sin(theta) = -tanh(tau), x = (c^2/g)
    gd(tau), z = -(c^2/g) ln cosh(tau). Source: D. J. Evans, W. G. Hoover and others, Phys. Rev. A 28 (1983)
    1016 (the Gaussian isokinetic thermostat).

    Coordinates: x horizontal and z up, in a vertical plane.
    """

    mass: Parameter = parameter(1.0, unit="kg", positive=True)
    speed: Parameter = parameter(1.7, unit="m/s", positive=True, about="c, kept by the constraint")
    gravity: Parameter = parameter(9.81, unit="m/s^2")

    coordinates = coordinates("x z")
    domain = {"x_rate": (0.3, 2.0), "z_rate": (-2.0, 2.0)}
    conventions = "x horizontal, z up; the direction of flight is measured from x upwards."
    example_span = 2.0

    @property
    def example(self):
        """Return level flight at the constrained speed."""
        return {"x_rate": self.speed}

    def bodies(self, t, q):
        return {"particle": Particle(self.mass, vec(q.x, 0, q.z))}

    def velocity_constraints(self, motion):
        v = motion["particle"].velocity
        return {"constant speed": (v @ v - self.speed**2) / (2 * self.speed)}

    def invariants(self, motion):
        # x = (c^2/g) gd(tau) and theta = -gd(tau)
        return {
            "x and direction": (
                self.gravity * motion.q.x + self.speed**2 * jnp.arctan2(motion.u.z_rate, motion.u.x_rate)
            )
        }
