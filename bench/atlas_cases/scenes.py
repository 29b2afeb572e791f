"""Scenes of the atlas that are no textbook models: redundant and nearly redundant rows, linkages, rows
nonlinear in the speeds.
"""

from itertools import pairwise

import equinox as eqx
import jax.numpy as jnp
from long_runs_scenes import Point

import jourdain_jax as jj

_TURN = (-3.2, 3.2)


class Weighted(jj.Scene):
    """Under gravity, of 9.81 m/s^2 unless a parameter says otherwise."""

    def loads(self, motion):
        return jj.gravity(motion, getattr(self, "gravity", 9.81))


def downhill(slope):
    """The direction of gravity in axes of a plane that falls along x."""
    return jnp.stack([jnp.sin(slope), 0.0, -jnp.cos(slope)])


class HeavyAxle(jj.Scene):
    """Two disc wheels on an axle with mass, on an incline (B1): four rows, of which the two lateral ones are
    the same.
    """

    radius: object = jj.parameter(0.3, positive=True)
    half_track: object = jj.parameter(0.4, positive=True)
    wheel_mass: object = jj.parameter(1.2, positive=True)
    axle_mass: object = jj.parameter(0.5, positive=True)
    slope: object = jj.parameter(0.2)
    gravity: object = jj.parameter(9.81)
    coordinates = jj.coordinates("x y th p1 p2")
    domain = {"th": _TURN, "p1": _TURN, "p2": _TURN}

    def bodies(self, t, q):
        turned = jj.rot_z(q.th)
        middle = jnp.stack([q.x, q.y, self.radius])
        axle = self.half_track * turned[:, 1]
        slender = self.axle_mass * (2 * self.half_track) ** 2 / 12
        bodies = {"axle": jj.RigidBody(self.axle_mass, slender * jnp.ones(3), middle, turned)}
        for name, place, spin in (("wheel 1", middle + axle, q.p1), ("wheel 2", middle - axle, q.p2)):
            at = {"position": place, "orientation": turned @ jj.rot_y(spin)}
            bodies[name] = jj.RigidBody.thin_disc(self.wheel_mass, self.radius, axis="y", **at)
        return bodies

    def loads(self, motion):
        return jj.gravity(motion, self.gravity, downhill(self.slope))

    def velocity_constraints(self, motion):
        q, u = motion.q, motion.u
        s, c = jnp.sin(q.th), jnp.cos(q.th)
        sideways, forward = -s * u.x_rate + c * u.y_rate, c * u.x_rate + s * u.y_rate
        return {
            "lateral 1": sideways,
            "lateral 2": sideways,
            "rolling 1": forward - self.half_track * u.th_rate - self.radius * u.p1_rate,
            "rolling 2": forward + self.half_track * u.th_rate - self.radius * u.p2_rate,
        }


class Edges(jj.Scene):
    """The skate with three copies of its row (one of them seven times as long), or with a second edge turned
    by `angle` against the first.
    """

    angle: object = jj.parameter(0.0)
    slope: object = jj.parameter(0.3)
    copies: bool = eqx.field(static=True, default=True)
    coordinates = jj.coordinates("x y heading")
    domain = {"heading": _TURN}

    def bodies(self, t, q):
        return {"skate": jj.RigidBody(1.0, 0.2 * jnp.ones(3), [q.x, q.y, 0.0], jj.rot_z(q.heading))}

    def loads(self, motion):
        return jj.gravity(motion, 9.81, downhill(self.slope))

    def velocity_constraints(self, motion):
        skate = motion["skate"]
        edge, second = (
            jj.knife_edge(skate, skate.position, (skate.orientation @ jj.rot_z(angle))[:, 1])
            for angle in (0.0, self.angle)
        )
        if self.copies:
            return {"edge": edge, "copy": edge, "longer copy": 7.0 * edge}
        return {"edge": edge, "second": second}


class OrthonormalRows(Weighted, Point):
    """A particle in space whose velocity has two orthonormal rows, turned with its coordinate x: equal
    singular values everywhere.
    """

    def velocity_constraints(self, motion):
        frame = jj.rot_z(motion.q.x) @ jj.rot_x(0.7 + motion.q.x)
        velocity = motion["particle"].velocity
        return {"first": velocity @ frame[:, 1], "second": velocity @ frame[:, 2]}


class LeadingRow(Point):
    """Rosenberg's particle in another order, `xdot = z ydot`: at z = 0 the row lies along the first
    coordinate.
    """

    def velocity_constraints(self, motion):
        return {"sheet": motion.u.x_rate - motion.q.z * motion.u.y_rate}


class AppellHamel(Weighted, Point):
    """Appell and Hamel's example, a row quadratic in the speeds: `xdot^2 + ydot^2 = k^2 zdot^2`. It vanishes,
    with its slope, at rest.
    """

    k: object = jj.parameter(0.8)
    domain = {"x_rate": (0.2, 1.0), "y_rate": (0.2, 1.0), "z_rate": (-2.0, -0.2)}

    def velocity_constraints(self, motion):
        v = motion["particle"].velocity
        return {"cone": v[0] ** 2 + v[1] ** 2 - (self.k * v[2]) ** 2}


class FourBars(Weighted):
    """The n-four-bar linkage: n windows of rods of 1 m and 1 kg, in a vertical plane. Points P0 to Pn hang
    from pivots 1 m apart.

    A uniform rod is as good as a sixth of its mass at either end and the rest in the middle.
    """

    windows: int = eqx.field(static=True, default=2)
    gravity: object = jj.parameter(9.81)

    @property
    def coordinates(self):
        """x and z of every moving point."""
        return jj.coordinates(*(f"x{i} z{i}" for i in range(self.windows + 1)))

    @property
    def domain(self):
        """Near the half circle above the pivots."""
        count = range(self.windows + 1)
        return {f"x{i}": (i - 1.0, i + 1.0) for i in count} | {f"z{i}": (0.2, 1.0) for i in count}

    def _points(self, q):
        count = range(self.windows + 1)
        points = [jnp.stack([q[f"x{i}"], 0.0, q[f"z{i}"]]) for i in count]
        return points, [jnp.array([float(i), 0.0, 0.0]) for i in count]

    def bodies(self, t, q):
        points, pivots = self._points(q)
        bodies = {}
        for i, (point, pivot) in enumerate(zip(points, pivots, strict=True)):
            bodies[f"end {i}"] = jj.Particle((2 + (0 < i < self.windows)) / 6, point)
            bodies[f"crank {i}"] = jj.Particle(2 / 3, (point + pivot) / 2)
        for i, ends in enumerate(pairwise(points)):
            bodies[f"coupler {i}"] = jj.Particle(2 / 3, sum(ends) / 2)
        return bodies

    def geometric_constraints(self, pose):
        points, pivots = self._points(pose.q)
        rows = {f"crank {i}": jj.rod(a, b, 1.0) for i, (a, b) in enumerate(zip(pivots, points, strict=True))}
        return rows | {f"coupler {i}": jj.rod(*ends, 1.0) for i, ends in enumerate(pairwise(points))}


_VERTICES = ("a", "b", "c", "ai", "bi", "ci")  # "ai": the image of "a"
_RODS = ("a b", "b c", "a c", "a bi", "b ci", "a ci")


class Bricard(Weighted):
    """Bricard's line-symmetric octahedron: six particles, twelve rods of rank eleven, and yet it bends. Axis
    of symmetry: z.
    """

    lengths: object = jj.parameter((1.0,) * 6, positive=True)
    domain_near: tuple = eqx.field(static=True, default=())
    coordinates = jj.coordinates(*(f"{name}{axis}" for name in _VERTICES for axis in "xyz"))

    @property
    def domain(self):
        """Near a given shape."""
        near = zip(self.coordinates.names.entries, self.domain_near, strict=False)
        return {name: (value - 0.05, value + 0.05) for name, value in near}

    def points(self, q):
        """Places of the vertices, images after their originals."""
        return dict(zip(_VERTICES, q.array.reshape(6, 3), strict=True))

    def bodies(self, t, q):
        return {
            name: jj.Particle(mass, at)
            for (name, at), mass in zip(self.points(q).items(), (1.0, 1.5, 0.7) * 2, strict=True)
        }

    def geometric_constraints(self, pose):
        points, rows = self.points(pose.q), {}
        images = dict(zip(points, (*_VERTICES[3:], *_VERTICES[:3]), strict=True))
        for name, length in zip(_RODS, self.lengths, strict=True):
            ends = name.split()
            rows[name] = jj.rod(*(points[end] for end in ends), length)
            rows[f"{name} image"] = jj.rod(*(points[images[end]] for end in ends), length)
        return rows
