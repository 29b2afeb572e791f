"""Planar linkages of rods, in angles and in Cartesian coordinates, that pass through configurations at which
their rows lose rank.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import jourdain_jax as jj


def rod_body(x, z, angle, length, mass):
    """A uniform thin rod in the plane y = 0, centred at (x, z) m, at `angle` (rad) to the x axis."""
    return jj.RigidBody(mass, mass * length**2 / 12 * jnp.ones(3), jnp.stack([x, 0 * x, z]), jj.rot_y(-angle))


def end_of(body, distance):
    """The point of a rod at `distance` (m) from its centre."""
    return body.place(jnp.stack([distance, 0 * distance, 0 * distance]))


def pinned(name, first, second):
    """Two rows that hold two points of the plane together."""
    return {f"{name} x": first[0] - second[0], f"{name} z": first[2] - second[2]}


class Parallelogram(jj.Scene):
    """Two cranks a, c of equal length and a coupler b as long as the ground: flat at a = 0 and a = pi, where
    both rows have no independent gradient.

    Without loads the parallelogram's branch is a = c = a_0 + w t, b = 0.
    """

    crank: Float[Array, ""] = jj.parameter(1.0, unit="m", positive=True)
    coupler: Float[Array, ""] = jj.parameter(2.0, unit="m", positive=True)
    mass: Float[Array, ""] = jj.parameter(1.0, unit="kg", positive=True)
    coordinates = jj.coordinates("a b c")
    example = {"a": 0.7, "b": 0.0, "c": 0.7, "a_rate": 1.0}

    def bodies(self, t, q):
        r, d, m = self.crank, self.coupler, self.mass
        x, z = r * jnp.cos(q.a), r * jnp.sin(q.a)
        return {
            "first": rod_body(0.5 * x, 0.5 * z, q.a, r, m),
            "coupler": rod_body(x + 0.5 * d * jnp.cos(q.b), z + 0.5 * d * jnp.sin(q.b), q.b, d, m),
            "second": rod_body(d + 0.5 * r * jnp.cos(q.c), 0.5 * r * jnp.sin(q.c), q.c, r, m),
        }

    def geometric_constraints(self, pose):
        return pinned(
            "loop", end_of(pose["coupler"], 0.5 * self.coupler), end_of(pose["second"], 0.5 * self.crank)
        )


class SliderCrank(jj.Scene):
    """A crank a and a rod b of the same length 1 m that moves a slider x along the x axis; at a = pi/2 the
    slider passes the crank's axis.

    The branch b = -a, x = 2 cos a crosses there the branch on which rod and crank turn as one and the slider
    rests.
    """

    slider: Float[Array, ""] = jj.parameter(0.5, unit="kg", positive=True)
    coordinates = jj.coordinates("a b x")
    example = {"a": 0.5, "b": -0.5, "x": 2 * np.cos(0.5), "a_rate": 1.0}

    def bodies(self, t, q):
        one = jnp.ones_like(q.a)
        x, z = jnp.cos(q.a), jnp.sin(q.a)
        return {
            "crank": rod_body(0.5 * x, 0.5 * z, q.a, one, 1.0),
            "rod": rod_body(x + 0.5 * jnp.cos(q.b), z + 0.5 * jnp.sin(q.b), q.b, one, 1.0),
            "slider": jj.Particle(self.slider, [q.x, 0.0, 0.0]),
        }

    def geometric_constraints(self, pose):
        return pinned("pin", end_of(pose["rod"], jnp.asarray(0.5)), pose["slider"].position)


class NarrowPendulum(jj.Scene):
    """A pendulum in Cartesian coordinates whose domain says that it hangs: the speed of z follows from that
    of x, but for a motion that reaches z = 0.
    """

    length: Float[Array, ""] = jj.parameter(1.0, unit="m", positive=True)
    coordinates = jj.coordinates("x z")
    domain = {"x": (-0.6, 0.6), "z": (-1.0, -0.8)}
    example = {"x": 0.3, "z": -np.sqrt(0.91), "x_rate": 1.0}

    def bodies(self, t, q):
        return {"bob": jj.Particle(1.0, [q.x, 0.0, q.z])}

    def loads(self, motion):
        return jj.gravity(motion, 9.81)

    def geometric_constraints(self, pose):
        return {"rod": jj.rod(jnp.zeros(3), pose["bob"].position, self.length)}
