"""A car (or skate) pulling a chain of trailers on on-axle hitches: n + 1 knife edges, 2 n pin rows, two degrees of freedom.

    gamma_i' = w_{i-1} - (v_{i-1}/L) sin(gamma_i),   gamma_i = heading_{i-1} - heading_i
    v_i = v_{i-1} cos(gamma_i),   w_i = (v_{i-1}/L) sin(gamma_i)

Coordinates are maximal: x, y of the axle and heading of every body. Each row then holds two neighbours only and the rows are
banded; in the minimal coordinates (x, y, n + 1 headings) every trailer's row would hold all headings ahead of it. The speeds are
each body's own forward, sideways and turning velocity, so that the car's forward speed and turn rate are privileged at any
heading. The hitch pulls at the car's mass centre: without torque the car's turn rate is constant.
Source: J.-P. Laumond, Proc. IEEE Int. Conf. Intelligent Robots and Systems (1993) 1033; O. J. Sordalen, ICRA (1993) 1983.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jourdain_jax.calculus.rotations import rot_z
from jourdain_jax.scene.bodies import RigidBody
from jourdain_jax.scene.constraints import knife_edge, pin
from jourdain_jax.scene.coordinates import coordinates, inputs, speeds
from jourdain_jax.scene.loads import generalized_force
from jourdain_jax.scene.parameters import parameter
from jourdain_jax.scene.scene import Scene
from jourdain_jax.scene.visuals import Visual


class TrailerChain(Scene):
    """A car that pulls a chain of trailers, each hitched to the axle ahead.

    Body 0 is the car, bodies 1 to n the trailers; mass centres on the axles. Trailer parameters: one number or one each.

    Inputs: `drive` forward on the car (N), `turn` torque on the car (N m).
    """

    trailers: int = eqx.field(static=True, default=3)
    car_mass: Float[Array, ""] = parameter(1.0, unit="kg", positive=True)
    car_inertia: Float[Array, ""] = parameter(0.1, unit="kg m^2", positive=True)
    trailer_mass: Float[Array, "*trailers"] = parameter(0.5, unit="kg", non_negative=True)
    trailer_inertia: Float[Array, "*trailers"] = parameter(0.02, unit="kg m^2", non_negative=True)
    length: Float[Array, "*trailers"] = parameter(0.7, unit="m", positive=True, about="from hitch to axle")

    inputs = inputs("drive turn")
    privileged = ("forward0", "turn0")
    conventions = "z up; headings from x towards y; x, y of the axle; hitch of a trailer on the axle of the body ahead."
    example_span = 5.0

    def __check_init__(self):
        if not isinstance(self.trailers, int) or self.trailers < 0:
            raise ValueError(f"`trailers` of `TrailerChain` is {self.trailers!r}, expected a whole number >= 0")

    @property
    def coordinates(self):
        """x, y of the axle and heading of every body."""
        return coordinates(*(f"x{i} y{i} heading{i}" for i in range(self.trailers + 1)))

    @property
    def speeds(self):
        """Velocity of every axle along and across its body, and turn rate."""
        return speeds(" ".join(f"forward{i} sideways{i} turn{i}" for i in range(self.trailers + 1)))

    @property
    def domain(self):
        """The bodies one behind the other, at any heading."""
        behind = {f"x{i}": (-1.0 - 0.7 * i, 1.0 - 0.7 * i) for i in range(self.trailers + 1)}
        return behind | {f"heading{i}": (-3.2, 3.2) for i in range(self.trailers + 1)}

    @property
    def example(self):
        """The car turns left, the trailers start straight behind it."""
        return self.towing([0.0] * (self.trailers + 1), forward=1.2, turn=0.4)

    def towing(self, headings, *, forward=0.0, turn=0.0) -> dict[str, Float[Array, ""]]:
        """A start: headings (rad) of the car at the origin and of all trailers, speed (m/s) and turn rate (rad/s) of the car."""
        headings, lengths = jnp.asarray(headings), self._per_trailer(self.length)
        x = jnp.concatenate([jnp.zeros(1), -jnp.cumsum(lengths * jnp.cos(headings[1:]))])
        y = jnp.concatenate([jnp.zeros(1), -jnp.cumsum(lengths * jnp.sin(headings[1:]))])
        values = {"forward0": jnp.asarray(forward), "turn0": jnp.asarray(turn)}
        for i in range(self.trailers + 1):
            values |= {f"x{i}": x[i], f"y{i}": y[i], f"heading{i}": headings[i]}
        return values

    def bodies(self, t, q):
        masses = jnp.append(self.car_mass, self._per_trailer(self.trailer_mass))
        moments = jnp.append(self.car_inertia, self._per_trailer(self.trailer_inertia))
        places = [jnp.stack([q[f"x{i}"], q[f"y{i}"], jnp.zeros_like(q.x0)]) for i in range(self.trailers + 1)]
        return {_name(i): RigidBody(masses[i], moments[i] * jnp.ones(3), place, rot_z(q[f"heading{i}"])) for i, place in enumerate(places)}

    def visuals(self, pose):
        looks = {"car": [*_axle(), Visual.box((0.44, 0.26, 0.12), at=(0.06, 0.0, 0.15)), Visual.box((0.2, 0.22, 0.1), at=(0.0, 0.0, 0.26))]}
        for i, length in enumerate(self._per_trailer(self.length), 1):
            level = jnp.array([0.0, 0.0, 0.1])
            tongue = Visual.line(level, level + length * jnp.array([1.0, 0.0, 0.0]), radius=0.015, colour="#8a8a86")
            looks[_name(i)] = [*_axle(), Visual.box((0.36, 0.26, 0.14), at=(0.0, 0.0, 0.17)), tongue]
        return looks

    def coordinate_rates(self, t, q, u):
        rates = []
        for i in range(self.trailers + 1):
            c, s = jnp.cos(q[f"heading{i}"]), jnp.sin(q[f"heading{i}"])
            forward, sideways = u[f"forward{i}"], u[f"sideways{i}"]
            rates += [forward * c - sideways * s, forward * s + sideways * c, u[f"turn{i}"]]
        return jnp.stack(rates)

    def loads(self, motion):
        return (generalized_force(motion, forward0=motion.inputs.drive, turn0=motion.inputs.turn),)

    def geometric_constraints(self, pose):
        lengths = self._per_trailer(self.length)
        rows = {}
        for i in range(1, self.trailers + 1):
            ahead, trailer = pose[_name(i - 1)], pose[_name(i)]
            hitch = trailer.position + lengths[i - 1] * trailer.orientation[:, 0]
            rows[f"hitch {i}"] = pin(hitch, ahead.position, axes="xy")
        return rows

    def velocity_constraints(self, motion):
        bodies = [motion[_name(i)] for i in range(self.trailers + 1)]
        return {f"axle {i}": knife_edge(body, body.position, body.orientation[:, 1]) for i, body in enumerate(bodies)}

    def invariants(self, motion):
        """The car's turn rate, where no torque drives it."""
        return {"turn rate of the car": motion.u.turn0}

    def _per_trailer(self, value) -> Float[Array, "trailers"]:
        return jnp.broadcast_to(value, (self.trailers,))


def _name(i: int) -> str:
    return "car" if i == 0 else f"trailer {i}"


def _axle() -> list[Visual]:
    return [Visual.wheel(0.1, 0.05, at=(0.0, side, 0.1)) for side in (-0.18, 0.18)]
