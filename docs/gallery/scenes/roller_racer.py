"""The roller racer: two bodies with an axle each, joined by a pivot. Swinging the handlebar drives it
forward.

With the mass centres on the axles, straight running at the speed v straightens the handlebar like exp(-v t
(I1 b + I2 a)/(I1 b^2 + I2 a^2)); backwards (v < 0) it folds. Source: P. S. Krishnaprasad and D. P. Tsakiris,
Dynamical Systems 16 (2001) 347.
"""

import jax.numpy as jnp

import jourdain_jax as jj

LOOK = "No wheel is driven: swinging the handlebar from side to side drives the racer along a wavy line."


class RollerRacer(jj.Scene):
    """Coordinates: x, y of the seat's axle, heading; angle of the handlebar relative to the seat. Input:
    `wanted`, the angle at which the arms hold the handlebar (rad).
    """

    seat_mass: float = jj.parameter(20.0, unit="kg", positive=True)
    seat_inertia: float = jj.parameter(1.5, unit="kg m^2", positive=True)
    bar_mass: float = jj.parameter(1.0, unit="kg", positive=True)
    bar_inertia: float = jj.parameter(0.05, unit="kg m^2", positive=True)
    ahead: float = jj.parameter(
        0.6, unit="m", positive=True, about="a, from the seat's axle forward to the pivot"
    )
    behind: float = jj.parameter(
        0.1, unit="m", positive=True, about="b, from the pivot back to the handlebar's axle"
    )
    stiffness: float = jj.parameter(60.0, unit="N m", non_negative=True, about="of the arms")
    damping: float = jj.parameter(3.0, unit="N m s", non_negative=True, about="of the arms")

    coordinates = jj.coordinates("x y heading handlebar")
    inputs = jj.inputs("wanted")
    domain = {"heading": (-3.2, 3.2), "handlebar": (-1.0, 1.0)}
    conventions = (
        "z up; angles positive counterclockwise seen from above; the handlebar's axle trails the pivot."
    )
    example = {"x_rate": 1.0, "handlebar": 0.5}
    example_span = 6.0

    def bodies(self, t, q):
        seat, axle = jj.rot_z(q.heading), jj.vec(q.x, q.y, 0)
        bar = seat @ jj.rot_z(q.handlebar)
        casters = axle + self.ahead * seat[:, 0] - self.behind * bar[:, 0]
        return {
            "seat": jj.RigidBody(
                self.seat_mass,
                self.seat_inertia * jnp.ones(3),
                axle,
                seat,
                jnp.array(SEAT) * jnp.stack([self.ahead, 1.0, 1.0]),
            ),
            "handlebar": jj.RigidBody(
                self.bar_mass,
                self.bar_inertia * jnp.ones(3),
                casters,
                bar,
                jnp.array(BAR) + jnp.stack([self.behind, 0.0, 0.0]),
            ),
        }

    def loads(self, motion):
        torque = (
            self.stiffness * (motion.inputs.wanted - motion.q.handlebar)
            - self.damping * motion.u.handlebar_rate
        )
        return (jj.generalized_force(motion, handlebar_rate=torque),)

    def velocity_constraints(self, motion):
        return {
            name: jj.knife_edge(motion[name], motion[name].position, motion[name].orientation[:, 1])
            for name in ("seat", "handlebar")
        }


SEAT = (
    (1.0, 0.03, 0.0),
    (0.3, 0.16, 0.0),
    (-0.3, 0.16, 0.0),
    (-0.3, -0.16, 0.0),
    (0.3, -0.16, 0.0),
    (1.0, -0.03, 0.0),
    (1.0, 0.03, 0.0),
)
BAR = (
    (0.05, 0.28, 0.0),
    (-0.05, 0.28, 0.0),
    (-0.14, 0.06, 0.0),
    (-0.14, -0.06, 0.0),
    (-0.05, -0.28, 0.0),
    (0.05, -0.28, 0.0),
    (0.05, 0.28, 0.0),
)
