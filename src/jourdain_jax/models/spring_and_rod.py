"""Two particles in a vertical plane: a spring holds the first to the origin, a rod holds the second to the first.

The spring is an impressed force, known from the positions; the rod is a constraint, its force known only by what it enforces,
`|r2 - r1| = l`. The rod's multiplier is its thrust (negative: tension), in N.
Source: Wang and Pao (2003), section I.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from jourdain_jax.scene.bodies import Particle
from jourdain_jax.scene.constraints import rod
from jourdain_jax.scene.coordinates import coordinates
from jourdain_jax.scene.loads import damper, gravity, spring
from jourdain_jax.scene.motion_state import fixed_point
from jourdain_jax.scene.parameters import parameter
from jourdain_jax.scene.scene import Scene
from jourdain_jax.scene.visuals import Visual


class SpringAndRod(Scene):
    """Two particles in a vertical plane: a spring holds the first to the origin, a rod the second to the first.

    Cartesian coordinates of both particles; origin - spring (and damper) - first - rod - second.
    """

    mass1: Float[Array, ""] = parameter(1.0, unit="kg", positive=True)
    mass2: Float[Array, ""] = parameter(0.6, unit="kg", positive=True)
    stiffness: Float[Array, ""] = parameter(40.0, unit="N/m", non_negative=True)
    natural_length: Float[Array, ""] = parameter(0.5, unit="m", non_negative=True, about="of the spring")
    damping: Float[Array, ""] = parameter(0.0, unit="N s/m", non_negative=True, about="along the spring")
    rod_length: Float[Array, ""] = parameter(0.6, unit="m", positive=True)
    gravity: Float[Array, ""] = parameter(9.81, unit="m/s^2")

    coordinates = coordinates("x1 z1 x2 z2")
    domain = {"x2": (-1.5, 1.5), "z2": (-1.5, 1.5)}
    conventions = "x horizontal, z up; the spring's fixed end is the origin."
    example_span = 5.0

    @property
    def example(self):
        """The rod level and turning."""
        places = {"x1": 0.3, "z1": -0.6, "x2": 0.3 + self.rod_length, "z2": -0.6}
        return places | {"x1_rate": 0.4, "z1_rate": 0.1, "x2_rate": 0.4, "z2_rate": 0.7}

    def bodies(self, t, q):
        level = jnp.zeros_like(q.x1)
        first, second = jnp.stack([q.x1, level, q.z1]), jnp.stack([q.x2, level, q.z2])
        return {"first": Particle(self.mass1, first), "second": Particle(self.mass2, second)}

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
        return {"": [Visual.coil(jnp.zeros(3), first, 0.06 * self.rod_length), Visual.line(first, second, radius=0.02 * self.rod_length)]}
