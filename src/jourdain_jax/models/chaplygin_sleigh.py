"""The Chaplygin sleigh: a body on smooth ice with one blade, its mass centre a distance a ahead of the blade.

    -xdot sin(heading) + ydot cos(heading) - a headingdot = 0        (x, y of the mass centre)
    v' = a w^2,   w' = -(a/k^2) v w,   k^2 = I/m + a^2               (v forward speed, w turn rate)

Energy is conserved, yet every motion ends in straight forward sliding. Motions show (I + m a^2)/m and a, but not m and I apart.
Source: S. A. Chaplygin (1911); A. M. Bloch, Nonholonomic Mechanics and Control (2003), section 1.7.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from jourdain_jax.calculus.rotations import rot_z
from jourdain_jax.scene.bodies import RigidBody
from jourdain_jax.scene.constraints import knife_edge
from jourdain_jax.scene.coordinates import coordinates
from jourdain_jax.scene.parameters import parameter
from jourdain_jax.scene.scene import Scene
from jourdain_jax.scene.visuals import Visual


class ChaplyginSleigh(Scene):
    """The Chaplygin sleigh: a body on smooth ice with one blade, its mass centre ahead of the blade.

    x, y of the mass centre, heading of the blade; the blade touches the ice at body point (-offset, 0, 0).
    """

    mass: Float[Array, ""] = parameter(1.3, unit="kg", positive=True)
    inertia: Float[Array, ""] = parameter(0.4, unit="kg m^2", positive=True, about="I, about the mass centre")
    offset: Float[Array, ""] = parameter(0.25, unit="m", about="a, of the mass centre ahead of the blade; negative behind it")

    coordinates = coordinates("x y heading")
    domain = {"heading": (-3.2, 3.2)}
    conventions = "z up; heading from x towards y; the blade is along body x; x, y of the mass centre."
    example = {"x_rate": -0.6, "heading_rate": 0.9}  # backwards at first
    example_span = 12.0

    def bodies(self, t, q):
        position = jnp.stack([q.x, q.y, jnp.zeros_like(q.x)])
        moments = self.inertia * jnp.ones(3)  # only the one about z matters
        return {"sleigh": RigidBody(self.mass, moments, position, rot_z(q.heading))}

    def velocity_constraints(self, motion):
        sleigh = motion["sleigh"]
        return {"blade": knife_edge(sleigh, sleigh.place(self._blade()), sleigh.orientation[:, 1])}

    def visuals(self, pose):
        above = jnp.array([0.0, 0.0, 0.1])
        corners = [self._blade() + above, jnp.array([0.3, 0.2, 0.1]), jnp.array([0.3, -0.2, 0.1])]
        feet = [look for corner in corners[1:] for look in (Visual.line(corner, corner - above, radius=0.01), Visual.ball(0.025, at=corner - 0.75 * above))]
        blade = Visual.box((0.14, 0.006, 0.1), at=self._blade() + 0.5 * above, colour="#8a8a86")
        return {"sleigh": [Visual.line(*corners, corners[0], radius=0.014), *feet, blade, Visual.ball(0.035, at=above, colour="#444444")]}

    def invariants(self, motion):
        q, u = motion.q, motion.u
        k = jnp.sqrt(self.inertia / self.mass + self.offset**2)
        forward = u.x_rate * jnp.cos(q.heading) + u.y_rate * jnp.sin(q.heading)
        # d/dt atan(v / (k |w|)) = (a/k) |w|, and w keeps its sign
        turned = jnp.sign(u.heading_rate) * jnp.arctan2(forward, k * jnp.abs(u.heading_rate))
        return {"heading and slide": self.offset * q.heading - k * turned}

    def _blade(self) -> Float[Array, "3"]:
        return jnp.stack([-self.offset, 0 * self.offset, 0 * self.offset])
