"""A chain of particles joined by massless rods, hanging from a pivot in a vertical plane: n particles, n geometric rows.

    |r_i - r_{i-1}|^2 = l_i^2,   r_0 = 0

In Cartesian coordinates each row holds two neighbours only: `A M^-1 A'` is tridiagonal, where the mass matrix in angles would be
dense. n = 2 is the double pendulum. Multipliers are the thrusts in the rods, N (negative: tension).
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jourdain_jax.scene.bodies import Particle
from jourdain_jax.scene.constraints import rod
from jourdain_jax.scene.coordinates import coordinates
from jourdain_jax.scene.loads import gravity
from jourdain_jax.scene.parameters import parameter
from jourdain_jax.scene.scene import Scene
from jourdain_jax.scene.visuals import Visual


class PendulumChain(Scene):
    """A hanging chain of particles and massless rods in a vertical plane.

    Cartesian coordinates of all particles, from the pivot down; masses and lengths are one number, or one per link.
    """

    links: int = eqx.field(static=True, default=5)
    mass: Float[Array, "*links"] = parameter(0.2, unit="kg", positive=True)
    length: Float[Array, "*links"] = parameter(0.3, unit="m", positive=True)
    gravity: Float[Array, ""] = parameter(9.81, unit="m/s^2")

    conventions = "x horizontal, z up; pivot at the origin; particle 1 hangs from the pivot."
    example_span = 3.0

    def __check_init__(self):
        if not isinstance(self.links, int) or self.links < 1:
            raise ValueError(f"`links` of `PendulumChain` is {self.links!r}, expected a whole number of particles >= 1")

    @property
    def coordinates(self):
        """x and z of every particle."""
        return coordinates(*(f"x{i} z{i}" for i in range(1, self.links + 1)))

    @property
    def domain(self):
        """Within the reach of the chain."""
        return {f"{axis}{i}": (-0.3 * i, 0.3 * i) for i in range(1, self.links + 1) for axis in "xz"}

    @property
    def example(self):
        """Straight, 60 degrees from hanging, at rest."""
        return self.hanging([jnp.pi / 3] * self.links)

    def hanging(self, angles) -> dict[str, Float[Array, ""]]:
        """Coordinates of the chain whose rods hang at these angles (rad) from straight down, positive towards +x."""
        angles, lengths = jnp.asarray(angles), self._per_link(self.length)
        x, z = jnp.cumsum(lengths * jnp.sin(angles)), -jnp.cumsum(lengths * jnp.cos(angles))
        return {f"x{i + 1}": x[i] for i in range(self.links)} | {f"z{i + 1}": z[i] for i in range(self.links)}

    def bodies(self, t, q):
        masses = self._per_link(self.mass)
        level = jnp.zeros_like(q.x1)
        places = {i: jnp.stack([q[f"x{i}"], level, q[f"z{i}"]]) for i in range(1, self.links + 1)}
        return {f"particle {i}": Particle(masses[i - 1], place) for i, place in places.items()}

    def loads(self, motion):
        return (gravity(motion, self.gravity),)

    def geometric_constraints(self, pose):
        lengths = self._per_link(self.length)
        places = [jnp.zeros(3), *(pose[f"particle {i}"].position for i in range(1, self.links + 1))]
        return {f"rod {i + 1}": rod(places[i], places[i + 1], lengths[i]) for i in range(self.links)}

    def visuals(self, pose):
        places = [jnp.zeros(3), *(pose[f"particle {i}"].position for i in range(1, self.links + 1))]
        return {"": Visual.line(*places, radius=0.02 * jnp.min(self.length))}

    def _per_link(self, value) -> Float[Array, "links"]:
        return jnp.broadcast_to(value, (self.links,))
