"""The snakeboard: a board with a rotor, on two wheel pairs that steer by opposite angles.

    -sin(heading +- steer) xdot + cos(heading +- steer) ydot +- l cos(steer) headingdot = 0        (front +, back -)

Two rows, three degrees of freedom. At steer = +-pi/2 the rows are parallel and the rank drops from 2 to 1. Motions pass through
smoothly: without torques the forward speed is c l cos(steer)/D and the turn rate c sin(steer)/D, with a constant c and
D^2 = m l^2 cos^2(steer) + (J + 2 Jw) sin^2(steer).
Source: A. Lewis, J. Ostrowski, R. Murray and J. Burdick, Proc. IEEE Int. Conf. Robotics and Automation (1994) 2391.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from jourdain_jax.calculus.rotations import rot_z
from jourdain_jax.scene.bodies import RigidBody
from jourdain_jax.scene.constraints import knife_edge
from jourdain_jax.scene.coordinates import coordinates, inputs
from jourdain_jax.scene.loads import generalized_force
from jourdain_jax.scene.parameters import parameter
from jourdain_jax.scene.scene import Scene
from jourdain_jax.scene.visuals import Visual


class Snakeboard(Scene):
    """The snakeboard: a board with a rotor, on two wheel pairs that steer by opposite angles.

    x, y of the board's middle, heading; rotor angle relative to the board; steer of the front wheels, the back ones by -steer.

    Inputs (N m): `rotor_torque` between rotor and board, `steer_torque` that opens both wheel pairs.
    """

    mass: Float[Array, ""] = parameter(6.0, unit="kg", positive=True, about="of everything")
    half_length: Float[Array, ""] = parameter(0.2, unit="m", positive=True, about="l, from the middle to a wheel pair")
    board_inertia: Float[Array, ""] = parameter(0.1, unit="kg m^2", positive=True, about="J, with the masses of rotor and wheels")
    rotor_inertia: Float[Array, ""] = parameter(0.05, unit="kg m^2", positive=True, about="Jr")
    wheel_inertia: Float[Array, ""] = parameter(0.002, unit="kg m^2", positive=True, about="Jw, of one wheel pair")

    coordinates = coordinates("x y heading rotor steer")
    inputs = inputs("rotor_torque steer_torque")
    domain = {"heading": (-3.2, 3.2), "rotor": (-3.2, 3.2), "steer": (-1.2, 1.2)}
    conventions = "z up; heading from x towards y; all angles positive counterclockwise seen from above."
    example = {"steer": 0.3, "steer_rate": 0.5, "x_rate": 1.0, "rotor_rate": 0.4}
    example_span = 5.0

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
