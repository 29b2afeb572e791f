"""Bodies on blades and wheels that do not slip sideways."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jourdain_jax.calculus.reals import Number, Numbers, Parameter, Scalar, Vector3, checked_whole
from jourdain_jax.calculus.rotations import rot_y, rot_z, vec
from jourdain_jax.scene.bodies import RigidBody, Visual
from jourdain_jax.scene.coordinates import coordinates, inputs, parameter, speeds
from jourdain_jax.scene.loads import generalized_force, gravity, knife_edge, pin
from jourdain_jax.scene.scene import Scene


class Skate(Scene):
    """A skate (knife edge) on an incline: one constraint in three coordinates.

    It is the smallest nonholonomic system with a force.

        xdot sin(heading) - ydot cos(heading) = 0
        heading'' = 0,   v' = g sin(slope) cos(heading)                  (v: forward speed)

    A turning skate drifts across the slope, not downhill. Neither xdot nor ydot can be privileged at every
    heading. Source: J. I. Neimark and N. A. Fufaev, Dynamics of Nonholonomic Systems (1972), ch. III.

    Coordinates: x, y of the mass centre, heading of the blade.
    """

    mass: Parameter = parameter(1.0, unit="kg", positive=True)
    inertia: Parameter = parameter(0.2, unit="kg m^2", positive=True, about="about the normal of the slope")
    slope: Parameter = parameter(0.3, unit="rad")
    gravity: Parameter = parameter(9.81, unit="m/s^2")

    coordinates = coordinates("x y heading")
    conventions = (
        "x down the slope, y across it, z along its normal; heading from x towards y; the blade is along"
        " body x."
    )
    example = {"heading_rate": 1.3}
    example_span = 10.0

    def bodies(self, t, q):
        return {"skate": _level(self.mass, self.inertia, q.x, q.y, rot_z(q.heading))}

    def loads(self, motion):
        return (gravity(motion, self.gravity, -rot_y(self.slope)[2]),)

    def velocity_constraints(self, motion):
        return {"edge": _edge(motion["skate"])}

    def visuals(self, pose):
        blade = Visual.box((0.3, 0.008, 0.05), at=(0.0, 0.0, 0.025), colour="#8a8a86")
        return {"skate": [blade, Visual.box((0.26, 0.09, 0.12), at=(0.0, 0.0, 0.11))]}

    def invariants(self, motion):
        turn = motion.u.heading_rate
        push = self.gravity * jnp.sin(self.slope)
        return {
            "turn rate": turn,
            "speed and heading": _forward(motion) * turn - push * jnp.sin(motion.q.heading),
        }


class ChaplyginSleigh(Scene):
    """The Chaplygin sleigh: a body on smooth ice with one blade behind its mass centre.

    a: distance of the mass centre ahead of the blade.

        -xdot sin(heading) + ydot cos(heading) - a headingdot = 0        (x, y of the mass centre)
        v' = a w^2,   w' = -(a/k^2) v w,   k^2 = I/m + a^2               (v forward speed, w turn rate)

    Energy is conserved, yet every motion ends in straight forward sliding. Motions determine (I + m a^2)/m
    and a, but not m and I separately. Source: S. A. Chaplygin (1911); A. M. Bloch, Nonholonomic Mechanics and
    Control (2003), section 1.7.

    Coordinates: x, y of the mass centre, heading of the blade. The blade touches the ice at the body point
    (-offset, 0, 0).
    """

    mass: Parameter = parameter(1.3, unit="kg", positive=True)
    inertia: Parameter = parameter(0.4, unit="kg m^2", positive=True, about="I, about the mass centre")
    offset: Parameter = parameter(
        0.25, unit="m", about="a, of the mass centre ahead of the blade; negative behind it"
    )

    coordinates = coordinates("x y heading")
    conventions = "z up; heading from x towards y; the blade is along body x; x, y of the mass centre."
    example = {"x_rate": -0.6, "heading_rate": 0.9}  # backwards at first
    example_span = 12.0

    def bodies(self, t, q):
        return {"sleigh": _level(self.mass, self.inertia, q.x, q.y, rot_z(q.heading))}

    def velocity_constraints(self, motion):
        return {"blade": _edge(motion["sleigh"], self._blade())}

    def visuals(self, pose):
        above = jnp.array([0.0, 0.0, 0.1])
        feet = [jnp.array([0.3, y, z]) for y, z in ((0.2, 0.0), (0.2, 0.1), (-0.2, 0.1), (-0.2, 0.0))]
        corners = [feet[0], feet[1], self._blade() + above, feet[2], feet[3]]
        blade = Visual.box((0.14, 0.006, 0.1), at=self._blade() + 0.5 * above, colour="#8a8a86")
        return {
            "sleigh": [
                Visual.line(*corners, radius=0.014),
                blade,
                Visual.ball(0.035, at=above, colour="#444444"),
            ]
        }

    def invariants(self, motion):
        turn = motion.u.heading_rate
        k = jnp.sqrt(self.inertia / self.mass + self.offset**2)
        # d/dt atan(v / (k |w|)) = (a/k) |w|, and w keeps its sign
        turned = jnp.sign(turn) * jnp.arctan2(_forward(motion), k * jnp.abs(turn))
        return {"heading and slide": self.offset * motion.q.heading - k * turned}

    def _blade(self) -> Vector3:
        return vec(-self.offset, 0, 0)


def _level(mass, inertia, x, y, orientation) -> RigidBody:
    """Return a body that stays level; only its moment of inertia about z matters."""
    return RigidBody(mass, inertia * jnp.ones(3), vec(x, y, 0), orientation)


def _edge(body, point=None) -> Scalar:
    """Return the constraint of a blade along body x at a point of the body (default: its mass centre)."""
    return knife_edge(body, body.position if point is None else body.place(point), body.orientation[:, 1])


def _forward(motion) -> Scalar:
    """Return the speed of the mass centre along the blade, m/s."""
    return motion.u.x_rate * jnp.cos(motion.q.heading) + motion.u.y_rate * jnp.sin(motion.q.heading)


class Snakeboard(Scene):
    """The snakeboard: a board with a rotor, on two wheel pairs that steer by opposite angles.

        -sin(heading +- steer) xdot + cos(heading +- steer) ydot +- l cos(steer) headingdot = 0
                                                                             (front: +, back: -)

    Two constraints leave three degrees of freedom. At steer = +-pi/2 the constraints are parallel and the
    rank drops from 2 to 1, but motions pass smoothly: without torques the forward speed is c l cos(steer)/D
    and the turn rate c sin(steer)/D, with a constant c and D^2 = m l^2 cos^2(steer) + (J + 2 Jw)
    sin^2(steer). Source: A. Lewis, J. Ostrowski, R. Murray and J. Burdick, Proc. IEEE Int. Conf. Robotics and
    Automation (1994) 2391.

    Coordinates: x, y of the board's middle, heading; rotor angle relative to the board; steer of the front
    wheels (the back wheels steer by -steer).

    Inputs (N m): `rotor_torque` between rotor and board, `steer_torque` that opens both wheel pairs.
    """

    mass: Parameter = parameter(6.0, unit="kg", positive=True, about="of everything")
    half_length: Parameter = parameter(
        0.2, unit="m", positive=True, about="l, from the middle to a wheel pair"
    )
    board_inertia: Parameter = parameter(
        0.1, unit="kg m^2", positive=True, about="J, with the masses of rotor and wheels"
    )
    rotor_inertia: Parameter = parameter(0.05, unit="kg m^2", positive=True, about="Jr")
    wheel_inertia: Parameter = parameter(0.002, unit="kg m^2", positive=True, about="Jw, of one wheel pair")

    coordinates = coordinates("x y heading rotor steer")
    inputs = inputs("rotor_torque steer_torque")
    domain = {"steer": (-1.2, 1.2)}
    conventions = "z up; heading from x towards y; all angles positive counterclockwise seen from above."
    example = {"steer": 0.3, "steer_rate": 0.5, "x_rate": 1.0, "rotor_rate": 0.4}

    def bodies(self, t, q):
        board = rot_z(q.heading)
        x, y, _ = self.half_length * board[:, 0]
        nothing = jnp.zeros_like(self.mass)  # the board's mass includes rotor and wheels
        return {
            "board": _level(self.mass, self.board_inertia, q.x, q.y, board),
            "rotor": _level(nothing, self.rotor_inertia, q.x, q.y, board @ rot_z(q.rotor)),
            "front": _level(nothing, self.wheel_inertia, q.x + x, q.y + y, board @ rot_z(q.steer)),
            "back": _level(nothing, self.wheel_inertia, q.x - x, q.y - y, board @ rot_z(-q.steer)),
        }

    def visuals(self, pose):
        l = self.half_length
        deck, rotor = (
            Visual.box(l * jnp.array(sides), at=l * jnp.array([0.0, 0.0, z]))
            for sides, z in (((2.6, 0.3, 0.08), 0.42), ((1.3, 0.14, 0.1), 0.6))
        )
        ends = [l * jnp.array([0.0, y, 0.16]) for y in (-0.4, 0.4)]
        trucks = [
            Visual.line(*ends, radius=0.05 * l),
            *(Visual.wheel(0.16 * l, 0.1 * l, at=end) for end in ends),
        ]
        return {"board": deck, "rotor": rotor, "front": trucks, "back": trucks}

    def loads(self, motion):
        return (
            generalized_force(
                motion, rotor_rate=motion.inputs.rotor_torque, steer_rate=motion.inputs.steer_torque
            ),
        )

    def velocity_constraints(self, motion):
        return {"front wheels": _edge(motion["front"]), "back wheels": _edge(motion["back"])}


class TrailerChain(Scene):
    """A car (or skate) that pulls a chain of n trailers on on-axle hitches.

    n + 1 knife edges and 2 n pin constraints leave two degrees of freedom.

        gamma_i' = w_{i-1} - (v_{i-1}/L) sin(gamma_i),   gamma_i = heading_{i-1} - heading_i
        v_i = v_{i-1} cos(gamma_i),   w_i = (v_{i-1}/L) sin(gamma_i)

    Coordinates are x, y of the axle and heading of every body. Each constraint then couples only two
    neighbours, and A is banded; with fewer coordinates (x, y, n + 1 headings) every trailer's constraint
    would contain all headings ahead of it. Speeds are the forward, sideways and turning velocity of every
    body, so that those of the car can be privileged at any heading. The hitch pulls at the car's mass centre:
    without torque the car's turn rate is constant. Source: J.-P. Laumond, Proc. IEEE Int. Conf. Intelligent
    Robots and Systems (1993) 1033; O. J. Sordalen, ICRA (1993) 1983.

    Body 0 is the car, bodies 1 to n are the trailers; mass centres are on the axles. A trailer parameter is
    one number for all trailers, or one number for each.

    Inputs: `drive` forward on the car (N), `turn` torque on the car (N m).
    """

    trailers: int = eqx.field(static=True, default=3)
    car_mass: Parameter = parameter(1.0, unit="kg", positive=True)
    car_inertia: Parameter = parameter(0.1, unit="kg m^2", positive=True)
    trailer_mass: Float[Array, "*trailers"] = parameter(0.5, unit="kg", non_negative=True)
    trailer_inertia: Float[Array, "*trailers"] = parameter(0.02, unit="kg m^2", non_negative=True)
    length: Float[Array, "*trailers"] = parameter(0.7, unit="m", positive=True, about="from hitch to axle")

    inputs = inputs("drive turn")
    privileged = ("forward0", "turn0")
    conventions = (
        "z up; headings from x towards y; x, y of the axle; hitch of a trailer on the axle of the body ahead."
    )

    def __check_init__(self):
        checked_whole(self.trailers, "`trailers` of `TrailerChain`", 0, expected=">= 0")

    @property
    def coordinates(self):
        """Return names of x, y of the axle and heading of every body."""
        return coordinates(*(f"x{i} y{i} heading{i}" for i in range(self.trailers + 1)))

    @property
    def speeds(self):
        """Return names of the velocity of every axle along and across its body, and of its turn rate."""
        return speeds(" ".join(f"forward{i} sideways{i} turn{i}" for i in range(self.trailers + 1)))

    @property
    def domain(self):
        """Return the domain: bodies in a line along any heading."""
        behind = {f"x{i}": (-1.0 - 0.7 * i, 1.0 - 0.7 * i) for i in range(self.trailers + 1)}
        return behind | {f"heading{i}": (-3.2, 3.2) for i in range(self.trailers + 1)}

    @property
    def example(self):
        """Return a start: the car turns left, with the trailers straight behind it."""
        return self.towing([0.0] * (self.trailers + 1), forward=1.2, turn=0.4)

    def towing(self, headings: Numbers, *, forward: Number = 0.0, turn: Number = 0.0) -> dict[str, Scalar]:
        """Return a start: headings (rad) of the car at the origin and of all trailers, speed (m/s) and turn
        rate (rad/s) of the car.
        """
        headings, lengths = jnp.asarray(headings), self._per_trailer(self.length)
        x = jnp.append(0.0, -jnp.cumsum(lengths * jnp.cos(headings[1:])))
        y = jnp.append(0.0, -jnp.cumsum(lengths * jnp.sin(headings[1:])))
        values = {
            f"{name}{i}": given[i]
            for name, given in (("x", x), ("y", y), ("heading", headings))
            for i in range(self.trailers + 1)
        }
        return values | {"forward0": jnp.asarray(forward), "turn0": jnp.asarray(turn)}

    def bodies(self, t, q):
        masses = jnp.append(self.car_mass, self._per_trailer(self.trailer_mass))
        moments = jnp.append(self.car_inertia, self._per_trailer(self.trailer_inertia))
        return {
            _name(i): _level(mass, moments[i], q[f"x{i}"], q[f"y{i}"], rot_z(q[f"heading{i}"]))
            for i, mass in enumerate(masses)
        }

    def visuals(self, pose):
        cart = [
            Visual.box((0.36, 0.26, 0.14), at=(0.0, 0.0, 0.17)),
            *(Visual.wheel(0.1, 0.05, at=(0.0, side, 0.1)) for side in (-0.18, 0.18)),
        ]
        axle, ahead = jnp.array([0.0, 0.0, 0.1]), jnp.array([1.0, 0.0, 0.0])
        tongues = [
            Visual.line(axle, axle + length * ahead, radius=0.015, colour="#8a8a86")
            for length in self._per_trailer(self.length)
        ]
        return {"car": cart} | {_name(i): [*cart, tongue] for i, tongue in enumerate(tongues, 1)}

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
        return {f"axle {i}": _edge(motion[_name(i)]) for i in range(self.trailers + 1)}

    def invariants(self, motion):
        """Return the car's turn rate, constant without a torque."""
        return {"turn rate of the car": motion.u.turn0}

    def _per_trailer(self, value) -> Float[Array, "trailers"]:
        return jnp.broadcast_to(value, (self.trailers,))


def _name(i: int) -> str:
    return "car" if i == 0 else f"trailer {i}"
