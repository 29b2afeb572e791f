"""Linkages that are singular at some configuration, or whose rows depend on each other at all of them."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import jourdain_jax as jj


def _particle(x, z):
    return jj.Particle(1.0, jnp.stack([x, 0.0 * x, z]))


class Parallelogram(jj.Scene):
    """Three rods in angles; two cranks of equal length. Flat, with cranks at right angles, it has one row
    less.
    """

    unit: Float[Array, ""] = jj.parameter(1.0)  # of the row along x
    coordinates = jj.coordinates("a b c")

    def _points(self, q):
        first = jnp.stack([jnp.sin(q.a), -jnp.cos(q.a)])
        second = first + 2.0 * jnp.stack([jnp.cos(q.b), jnp.sin(q.b)])
        return first, second, second - jnp.stack([jnp.sin(q.c), -jnp.cos(q.c)])

    def bodies(self, t, q):
        return {
            name: _particle(*point) for name, point in zip(("first", "second"), self._points(q), strict=False)
        }

    def loads(self, motion):
        return jj.gravity(motion, 9.81)

    def geometric_constraints(self, pose):
        end = self._points(pose.q)[2]
        return {"loop x": self.unit * (end[0] - 2.0), "loop z": end[1]}


class SliderCrank(jj.Scene):
    """A crank and a rod, in angles; of equal length, the slider's row is lost where both stand upright."""

    rod: Float[Array, ""] = jj.parameter(1.0)
    unit: Float[Array, ""] = jj.parameter(1.0)
    coordinates = jj.coordinates("a b x")

    def bodies(self, t, q):
        return {"crank": _particle(jnp.cos(q.a), jnp.sin(q.a)), "slider": _particle(q.x, 0.0 * q.x)}

    def geometric_constraints(self, pose):
        q = pose.q
        return {
            "along": self.unit * (jnp.cos(q.a) + self.rod * jnp.cos(q.b) - q.x),
            "across": jnp.sin(q.a) + self.rod * jnp.sin(q.b),
        }


class Loop(jj.Scene):
    """A closed chain of hinges in space, by Denavit and Hartenberg: lengths and twists of the links. Twelve
    rows close it.
    """

    lengths: tuple[float, ...] = eqx.field(static=True, default=())
    twists: tuple[float, ...] = eqx.field(static=True, default=())

    @property
    def coordinates(self):
        """One angle for each hinge."""
        return jj.coordinates(*(f"h{i}" for i in range(len(self.lengths))))

    def _links(self, q):
        R, r, links = jnp.eye(3), jnp.zeros(3), []
        for i, (length, twist) in enumerate(zip(self.lengths, self.twists, strict=True)):
            R = R @ jj.rot_z(q[f"h{i}"])
            r = r + length * R[:, 0]
            R = R @ jj.rot_x(twist)
            links.append((r, R))
        return links

    def bodies(self, t, q):
        return {
            f"link {i}": jj.RigidBody(1.0, np.diag([0.1, 0.12, 0.15]), r, R)
            for i, (r, R) in enumerate(self._links(q)[:-1])
        }

    def geometric_constraints(self, pose):
        r, R = self._links(pose.q)[-1]
        return {"place": r, "attitude": (R - jnp.eye(3)).ravel()}


def bennett(twist, other, length=1.0):
    """Bennett's four-bar linkage: opposite links are equal, `sin(twist)/length` is the same for all."""
    lengths = (length, float(length * np.sin(other) / np.sin(twist)))
    return Loop(lengths * 2, (twist, other) * 2)


def bricard(*lengths):
    """Bricard's trihedral six-bar linkage from five lengths: the sums of squares of even and odd links are
    equal, twists are right angles by turns.
    """
    squares = np.square(lengths)
    last = float(np.sqrt(squares[[0, 2, 4]].sum() - squares[[1, 3]].sum()))
    return Loop((*lengths, last), (np.pi / 2, -np.pi / 2) * 3)


class Windows(jj.Scene):
    """A row of windows of rods in a plane, Cartesian: as four-bar linkages, each hangs on the one before."""

    count: int = eqx.field(static=True, default=2)

    @property
    def coordinates(self):
        """Two points for each window."""
        return jj.coordinates(*(f"x{i} z{i} u{i} w{i}" for i in range(self.count)))

    def bodies(self, t, q):
        pairs = [(q[f"x{i}"], q[f"z{i}"]) for i in range(self.count)] + [
            (q[f"u{i}"], q[f"w{i}"]) for i in range(self.count)
        ]
        return {f"point {k}": _particle(*pair) for k, pair in enumerate(pairs)}

    def geometric_constraints(self, pose):
        q, rows, left, right = pose.q, {}, jnp.zeros(3), jnp.array([2.0, 0.0, 0.0])
        for i in range(self.count):
            p, r = (jnp.stack([q[f"{x}{i}"], 0.0, q[f"{z}{i}"]]) for x, z in ("xz", "uw"))
            rows |= {
                f"left {i}": jj.rod(left, p, 1.0),
                f"coupler {i}": jj.rod(p, r, 2.0),
                f"right {i}": jj.rod(right, r, 1.0),
            }
            left, right = p, r
        return rows
