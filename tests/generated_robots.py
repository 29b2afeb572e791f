"""Planar robots on wheels and beads on curves, drawn by a seed: their rows are written along axes that no
heading makes privileged.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np

import jourdain_jax as jj

HULL = (0.1, 0.0, 0.0)


class PlanarRobot(jj.Scene):
    """A hull on two driven discs and a train of trailers, each on an axle; the rows of the discs lie along
    world axes turned by `turned`.

    `maximal`: x, y and heading of every trailer with pins between them, otherwise headings only; `by_rate`:
    hitches are rows of velocity.
    """

    trailers: int = eqx.field(static=True, default=0)
    maximal: bool = eqx.field(static=True, default=False)
    by_rate: bool = eqx.field(static=True, default=False)
    turned: object = jj.parameter(0.0, unit="rad")
    hitch: object = jj.parameter(0.0, unit="m")
    length: object = jj.parameter(0.8, unit="m", positive=True)
    trailer_mass: object = jj.parameter(0.5, unit="kg", non_negative=True)
    trailer_inertia: object = jj.parameter(0.05, unit="kg m^2", non_negative=True)
    track: object = jj.parameter(0.3, unit="m", positive=True)

    @property
    def coordinates(self):
        trailers = (f"x{i} y{i} h{i}" if self.maximal else f"h{i}" for i in range(self.trailers))
        return jj.coordinates("x y heading left right", *trailers)

    def bodies(self, t, q):
        o, R = 0 * q.x, jj.rot_z(q.heading)
        at = jnp.stack([q.x, q.y, o + 0.1])
        made = {"hull": jj.RigidBody(3.0, 0.2 * jnp.ones(3), at + R @ jnp.array(HULL), R)}
        for name, side in (("left", 1.0), ("right", -1.0)):
            centre = at + R @ jnp.stack([o, o + side * self.track, o])
            made[name] = jj.RigidBody.thin_disc(
                0.3, 0.1, axis="y", position=centre, orientation=R @ jj.rot_y(q[name])
            )
        ahead = at - R @ jnp.stack([self.hitch, o, o])
        for i in range(self.trailers):
            R = jj.rot_z(q[f"h{i}"])
            axle = (
                jnp.stack([q[f"x{i}"], q[f"y{i}"], o])
                if self.maximal
                else ahead - R @ jnp.stack([self.length, o, o])
            )
            made[f"trailer{i}"] = jj.RigidBody(self.trailer_mass, self.trailer_inertia * jnp.ones(3), axle, R)
            ahead = axle
        return made

    def _pins(self, given):
        """Misses of the hitches, of a pose or a motion."""
        o, made = 0 * given.q.x, {}
        ahead = jnp.stack([given.q.x, given.q.y, o]) - jj.rot_z(given.q.heading) @ jnp.stack(
            [self.hitch, o, o]
        )
        for i in range(self.trailers):
            body = given[f"trailer{i}"]
            made[f"hitch{i}"] = (body.place([self.length, o, o]) - ahead)[:2]
            ahead = body.position
        return made

    def geometric_constraints(self, pose):
        return self._pins(pose) if self.maximal and not self.by_rate else {}

    def velocity_constraints(self, m):
        rows, c, s = {}, jnp.cos(self.turned), jnp.sin(self.turned)
        for name in ("left", "right"):
            v = m[name].velocity + jnp.cross(m[name].angular_velocity, jnp.array([0.0, 0.0, -0.1]))
            rows[name] = jnp.stack([c * v[0] + s * v[1], c * v[1] - s * v[0]])
        hull = m["hull"]
        ahead = hull.velocity + jnp.cross(
            hull.angular_velocity, hull.orientation @ (jnp.stack([-self.hitch, 0.0, 0.0]) - jnp.array(HULL))
        )
        for i in range(self.trailers):
            body = m[f"trailer{i}"]
            rows[f"trailer{i}"] = jj.knife_edge(body, body.position, body.orientation[:, 1])
            if self.maximal and self.by_rate:
                tongue = body.velocity + jnp.cross(
                    body.angular_velocity, body.orientation @ jnp.stack([self.length, 0.0, 0.0])
                )
                rows[f"hitch{i}"] = (tongue - ahead)[:2]
            ahead = body.velocity
        return rows

    def loads(self, m):
        return jj.generalized_force(m, left_rate=0.3 * jnp.cos(m.t), right_rate=0.1 + 0 * m.t)

    def start(self, left=3.0, right=12.0, **more):
        """A start in which it turns: assembled, the trailers at an angle."""
        values, x, y = {"left_rate": left, "right_rate": right, **more}, -self.hitch, 0.0
        for i in range(self.trailers):
            h = 0.3 * (i + 1)
            x, y = x - self.length * np.cos(h), y - self.length * np.sin(h)
            values |= {f"h{i}": h} | ({f"x{i}": x, f"y{i}": y} if self.maximal else {})
        return values


class BeadOnCurve(jj.Scene):
    """A bead on an ellipse in the plane, by a geometric row or one of velocity, whose way round a slider `s`
    follows by a row; `turned` axes.
    """

    by_rate: bool = eqx.field(static=True, default=False)
    a: object = jj.parameter(1.0, unit="m", positive=True)
    b: object = jj.parameter(1.0, unit="m", positive=True)
    turned: object = jj.parameter(0.0, unit="rad")
    coordinates = jj.coordinates("x y s")
    domain = {"x": (-1.2, 1.2), "y": (-1.2, 1.2)}

    def bodies(self, t, q):
        o = 0 * q.x
        return {"bead": jj.Particle(1.0, [q.x, q.y, o]), "slider": jj.Particle(0.5, [q.s, o, o])}

    def _own(self, x, y):
        c, s = jnp.cos(self.turned), jnp.sin(self.turned)
        return (c * x + s * y) / self.a, (c * y - s * x) / self.b

    def geometric_constraints(self, pose):
        x, y = self._own(pose.q.x, pose.q.y)
        return {} if self.by_rate else {"curve": x**2 + y**2 - 1}

    def velocity_constraints(self, m):
        (x, y), (vx, vy) = self._own(m.q.x, m.q.y), self._own(m.u.x_rate, m.u.y_rate)
        return {"arc": x * vy - y * vx - m.u.s_rate} | ({"curve": x * vx + y * vy} if self.by_rate else {})

    def loads(self, m):
        return jj.gravity(m, 9.81 * 1.09**0.5, np.array((0.3, -1.0, 0.0)) / 1.09**0.5)

    def start(self, speed=9.0):
        """On the curve, fast enough to go round."""
        c, s = np.cos(self.turned), np.sin(self.turned)
        return {"x": float(self.a * c), "y": float(self.a * s), "s_rate": speed}


def drawn(seed):
    """The scene with this number."""
    draw = np.random.default_rng(seed)
    turned = float(draw.uniform(-3, 3))
    if seed % 4 == 3:
        a, b = draw.uniform(0.7, 1.4, 2).tolist()
        return BeadOnCurve(by_rate=bool(draw.integers(2)), a=a, b=b, turned=turned)
    maximal, by_rate, _, massless = draw.integers(2, size=4).astype(bool).tolist()
    weight = {"trailer_mass": 0.0, "trailer_inertia": 0.0} if massless else {}
    hitch, length = draw.uniform([0.0, 0.6], [0.2, 1.0]).tolist()
    return PlanarRobot(
        trailers=int(draw.integers(3)),
        maximal=maximal,
        by_rate=by_rate,
        turned=turned,
        hitch=hitch,
        length=length,
        **weight,
    )
