"""A particle kept at constant speed c under gravity: a row *nonlinear* in the velocities.

    (v.v - c^2)/(2 c) = 0,     A = v/c,     virtual velocities obey v.dv = 0

The multiplier is the force along the velocity, in N; it does no virtual power but real power: energy is not conserved.
With `tau = g t/c` from level flight: sin(theta) = -tanh(tau), x = (c^2/g) gd(tau), z = -(c^2/g) ln cosh(tau).
Source: D. J. Evans, W. G. Hoover and others, Phys. Rev. A 28 (1983) 1016 (the Gaussian isokinetic thermostat).
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from jourdain_jax.scene.bodies import Particle
from jourdain_jax.scene.coordinates import coordinates
from jourdain_jax.scene.loads import gravity
from jourdain_jax.scene.parameters import parameter
from jourdain_jax.scene.scene import Scene


class IsokineticParticle(Scene):
    """A particle kept at constant speed under gravity: a row that is nonlinear in the velocities.

    Motion in a vertical plane, x horizontal and z up.
    """

    mass: Float[Array, ""] = parameter(1.0, unit="kg", positive=True)
    speed: Float[Array, ""] = parameter(1.7, unit="m/s", positive=True, about="c, which the row keeps")
    gravity: Float[Array, ""] = parameter(9.81, unit="m/s^2")

    coordinates = coordinates("x z")
    domain = {"x_rate": (0.3, 2.0), "z_rate": (-2.0, 2.0)}
    conventions = "x horizontal, z up; the direction of flight is measured from x upwards."
    example_span = 2.0

    @property
    def example(self):
        """Level flight at the speed of the row."""
        return {"x_rate": self.speed}

    def bodies(self, t, q):
        return {"particle": Particle(self.mass, jnp.stack([q.x, jnp.zeros_like(q.x), q.z]))}

    def loads(self, motion):
        return (gravity(motion, self.gravity),)

    def velocity_constraints(self, motion):
        v = motion["particle"].velocity
        return {"constant speed": (v @ v - self.speed**2) / (2 * self.speed)}

    def invariants(self, motion):
        # x = (c^2/g) gd(tau) and theta = -gd(tau)
        return {"x and direction": self.gravity * motion.q.x + self.speed**2 * jnp.arctan2(motion.u.z_rate, motion.u.x_rate)}
