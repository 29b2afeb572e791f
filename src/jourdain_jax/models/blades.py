"""Bodies on blades and wheels that do not slide sideways."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jourdain_jax.calculus.rotations import rot_z
from jourdain_jax.scene.bodies import RigidBody
from jourdain_jax.scene.constraints import knife_edge, pin
from jourdain_jax.scene.coordinates import coordinates, inputs, speeds
from jourdain_jax.scene.loads import generalized_force, gravity
from jourdain_jax.scene.parameters import Scalar, parameter
from jourdain_jax.scene.scene import Scene
from jourdain_jax.scene.visuals import Visual


class Skate(Scene):
    """A skate (knife edge) on an incline: the smallest nonholonomic system with a force, one row in three coordinates.

        xdot sin(heading) - ydot cos(heading) = 0,      heading'' = 0,   forward speed  v' = g sin(slope) cos(heading)

    Set turning, it drifts across the slope, not downhill. Neither xdot nor ydot can be privileged at every heading.
    Source: J. I. Neimark and N. A. Fufaev, Dynamics of Nonholonomic Systems (1972), ch. III.

    x, y of the mass centre, heading of the blade.
    """

    mass: Scalar = parameter(1.0, unit="kg", positive=True)
    inertia: Scalar = parameter(0.2, unit="kg m^2", positive=True, about="about the normal of the slope")
    slope: Scalar = parameter(0.3, unit="rad")
    gravity: Scalar = parameter(9.81, unit="m/s^2")

    coordinates = coordinates("x y heading")
    domain = {"heading": (-3.2, 3.2)}
    conventions = "x down the slope, y across it, z along its normal; heading from x towards y; the blade is along body x."
    example = {"heading_rate": 1.3}
    example_span = 10.0

    def bodies(self, t, q):
        position = jnp.stack([q.x, q.y, jnp.zeros_like(q.x)])
        moments = self.inertia * jnp.ones(3)  # only the one about z matters
        return {"skate": RigidBody(self.mass, moments, position, rot_z(q.heading))}

    def loads(self, motion):
        down = jnp.stack([jnp.sin(self.slope), jnp.zeros_like(self.slope), -jnp.cos(self.slope)])
        return (gravity(motion, self.gravity, down),)

    def velocity_constraints(self, motion):
        skate = motion["skate"]
        return {"edge": knife_edge(skate, skate.position, skate.orientation[:, 1])}

    def visuals(self, pose):
        blade = Visual.box((0.3, 0.008, 0.05), at=(0.0, 0.0, 0.025), colour="#8a8a86")
        return {"skate": [blade, Visual.box((0.26, 0.09, 0.03), at=(0.0, 0.0, 0.065)), Visual.box((0.12, 0.08, 0.12), at=(-0.06, 0.0, 0.13))]}

    def invariants(self, motion):
        q, u = motion.q, motion.u
        forward = u.x_rate * jnp.cos(q.heading) + u.y_rate * jnp.sin(q.heading)
        return {
            "turn rate": u.heading_rate,
            "speed and heading": forward * u.heading_rate - self.gravity * jnp.sin(self.slope) * jnp.sin(q.heading),
        }


class ChaplyginSleigh(Scene):
    """The Chaplygin sleigh: a body on smooth ice with one blade, its mass centre a distance a ahead of the blade.

        -xdot sin(heading) + ydot cos(heading) - a headingdot = 0        (x, y of the mass centre)
        v' = a w^2,   w' = -(a/k^2) v w,   k^2 = I/m + a^2               (v forward speed, w turn rate)

    Energy is conserved, yet every motion ends in straight forward sliding. Motions show (I + m a^2)/m and a, but not m and I apart.
    Source: S. A. Chaplygin (1911); A. M. Bloch, Nonholonomic Mechanics and Control (2003), section 1.7.

    x, y of the mass centre, heading of the blade; the blade touches the ice at body point (-offset, 0, 0).
    """

    mass: Scalar = parameter(1.3, unit="kg", positive=True)
    inertia: Scalar = parameter(0.4, unit="kg m^2", positive=True, about="I, about the mass centre")
    offset: Scalar = parameter(0.25, unit="m", about="a, of the mass centre ahead of the blade; negative behind it")

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


class Snakeboard(Scene):
    """The snakeboard: a board with a rotor, on two wheel pairs that steer by opposite angles.

        -sin(heading +- steer) xdot + cos(heading +- steer) ydot +- l cos(steer) headingdot = 0        (front +, back -)

    Two rows, three degrees of freedom. At steer = +-pi/2 the rows are parallel and the rank drops from 2 to 1. Motions pass through
    smoothly: without torques the forward speed is c l cos(steer)/D and the turn rate c sin(steer)/D, with a constant c and
    D^2 = m l^2 cos^2(steer) + (J + 2 Jw) sin^2(steer).
    Source: A. Lewis, J. Ostrowski, R. Murray and J. Burdick, Proc. IEEE Int. Conf. Robotics and Automation (1994) 2391.

    x, y of the board's middle, heading; rotor angle relative to the board; steer of the front wheels, the back ones by -steer.

    Inputs (N m): `rotor_torque` between rotor and board, `steer_torque` that opens both wheel pairs.
    """

    mass: Scalar = parameter(6.0, unit="kg", positive=True, about="of everything")
    half_length: Scalar = parameter(0.2, unit="m", positive=True, about="l, from the middle to a wheel pair")
    board_inertia: Scalar = parameter(0.1, unit="kg m^2", positive=True, about="J, with the masses of rotor and wheels")
    rotor_inertia: Scalar = parameter(0.05, unit="kg m^2", positive=True, about="Jr")
    wheel_inertia: Scalar = parameter(0.002, unit="kg m^2", positive=True, about="Jw, of one wheel pair")

    coordinates = coordinates("x y heading rotor steer")
    inputs = inputs("rotor_torque steer_torque")
    domain = {"heading": (-3.2, 3.2), "rotor": (-3.2, 3.2), "steer": (-1.2, 1.2)}
    conventions = "z up; heading from x towards y; all angles positive counterclockwise seen from above."
    example = {"steer": 0.3, "steer_rate": 0.5, "x_rate": 1.0, "rotor_rate": 0.4}

    def bodies(self, t, q):
        board = rot_z(q.heading)
        middle = jnp.stack([q.x, q.y, jnp.zeros_like(q.x)])
        reach = self.half_length * board[:, 0]
        nothing = jnp.zeros_like(self.mass)  # the masses of rotor and wheels count in the board's
        return {
            "board": RigidBody(self.mass, _about_z(self.board_inertia), middle, board),
            "rotor": RigidBody(nothing, _about_z(self.rotor_inertia), middle, board @ rot_z(q.rotor)),
            "front": RigidBody(nothing, _about_z(self.wheel_inertia), middle + reach, board @ rot_z(q.steer)),
            "back": RigidBody(nothing, _about_z(self.wheel_inertia), middle - reach, board @ rot_z(-q.steer)),
        }

    def visuals(self, pose):
        l, wheel = self.half_length, 0.16 * self.half_length
        deck = Visual.box(l * jnp.array([2.3, 0.3, 0.08]), at=l * jnp.array([0.0, 0.0, 0.42]))
        plates = [Visual.cylinder(0.32 * l, 0.1 * l, at=l * jnp.array([x, 0.0, 0.48])) for x in (-1.0, 1.0)]
        rotor = [Visual.box(l * jnp.array([1.3, 0.14, 0.1]), at=l * jnp.array([0.0, 0.0, 0.7])), *_balls(0.14 * l, 0.65 * l, 0.7 * l)]
        ends = [l * jnp.array([0.0, y, 0.16]) for y in (-0.4, 0.4)]
        trucks = [Visual.line(*ends, radius=0.05 * l), *(Visual.wheel(wheel, 0.1 * l, at=end) for end in ends)]
        return {"board": [deck, *plates], "rotor": rotor, "front": trucks, "back": trucks}

    def loads(self, motion):
        return (generalized_force(motion, rotor_rate=motion.inputs.rotor_torque, steer_rate=motion.inputs.steer_torque),)

    def velocity_constraints(self, motion):
        front, back = motion["front"], motion["back"]
        return {
            "front wheels": knife_edge(front, front.position, front.orientation[:, 1]),
            "back wheels": knife_edge(back, back.position, back.orientation[:, 1]),
        }


def _about_z(moment) -> Float[Array, "3"]:
    return moment * jnp.ones(3)  # only the one about z matters


def _balls(radius, reach, height) -> list[Visual]:
    return [Visual.ball(radius, at=jnp.stack([side * reach, 0 * reach, height])) for side in (-1, 1)]


class TrailerChain(Scene):
    """A car (or skate) pulling a chain of trailers on on-axle hitches: n + 1 knife edges, 2 n pin rows, two degrees of freedom.

        gamma_i' = w_{i-1} - (v_{i-1}/L) sin(gamma_i),   gamma_i = heading_{i-1} - heading_i
        v_i = v_{i-1} cos(gamma_i),   w_i = (v_{i-1}/L) sin(gamma_i)

    Coordinates are maximal: x, y of the axle and heading of every body. Each row then holds two neighbours only and the rows are
    banded; in the minimal coordinates (x, y, n + 1 headings) every trailer's row would hold all headings ahead of it. The speeds are
    each body's own forward, sideways and turning velocity, so that the car's forward speed and turn rate are privileged at any
    heading. The hitch pulls at the car's mass centre: without torque the car's turn rate is constant.
    Source: J.-P. Laumond, Proc. IEEE Int. Conf. Intelligent Robots and Systems (1993) 1033; O. J. Sordalen, ICRA (1993) 1983.

    Body 0 is the car, bodies 1 to n the trailers; mass centres on the axles. Trailer parameters: one number or one each.

    Inputs: `drive` forward on the car (N), `turn` torque on the car (N m).
    """

    trailers: int = eqx.field(static=True, default=3)
    car_mass: Scalar = parameter(1.0, unit="kg", positive=True)
    car_inertia: Scalar = parameter(0.1, unit="kg m^2", positive=True)
    trailer_mass: Float[Array, "*trailers"] = parameter(0.5, unit="kg", non_negative=True)
    trailer_inertia: Float[Array, "*trailers"] = parameter(0.02, unit="kg m^2", non_negative=True)
    length: Float[Array, "*trailers"] = parameter(0.7, unit="m", positive=True, about="from hitch to axle")

    inputs = inputs("drive turn")
    privileged = ("forward0", "turn0")
    conventions = "z up; headings from x towards y; x, y of the axle; hitch of a trailer on the axle of the body ahead."

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

    def towing(self, headings, *, forward=0.0, turn=0.0) -> dict[str, Scalar]:
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
