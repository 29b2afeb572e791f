"""A car with Ackermann steering and n trailers, each hitched to the axle ahead (the n-trailer of path
planning).

The linkage turns the inner front wheel more, cot(outer) - cot(inner) = track / wheelbase, so that all axles
meet in one point. The constraints of both front wheels are then equal to round-off: n + 3 constraints of rank
n + 2. Source: J.-P. Laumond, Proc. IROS (1993) 1033.
"""

import equinox as eqx
import jax.numpy as jnp

import jourdain_jax as jj

LOOK = (
    "All axles of the car meet in one point: the constraints of both front wheels agree to round-off. Each"
    " trailer cuts corners more than the one ahead."
)


class CarWithTrailers(jj.Scene):
    """Coordinates: x, y of the rear axle, heading, steer (of an imaginary wheel in the middle), headings of
    the trailers. Inputs: `drive` (N) and `steer_torque` (N m).
    """

    trailers: int = eqx.field(static=True, default=2)
    car_mass: float = jj.parameter(900.0, unit="kg", positive=True)
    wheel_mass: float = jj.parameter(
        15.0, unit="kg", positive=True, about="of a front wheel, with what turns with it"
    )
    trailer_mass: float = jj.parameter(300.0, unit="kg", positive=True)
    wheelbase: float = jj.parameter(2.6, unit="m", positive=True)
    track: float = jj.parameter(1.5, unit="m", positive=True)
    length: float = jj.parameter(3.4, unit="m", positive=True, about="of a trailer, from hitch to axle")

    inputs = jj.inputs("drive steer_torque")
    conventions = "z up; headings from x towards y; steer positive to the left."
    example = {"x_rate": 3.0, "steer": 0.3}
    example_span = 8.0

    @property
    def coordinates(self):
        return jj.coordinates("x y heading steer", *(f"trailer{i + 1}" for i in range(self.trailers)))

    @property
    def domain(self):
        return {"heading": (-3.2, 3.2), "steer": (-0.5, 0.5)} | {
            f"trailer{i + 1}": (-3.2, 3.2) for i in range(self.trailers)
        }

    def bodies(self, t, q):
        car, axle = jj.rot_z(q.heading), jj.vec(q.x, q.y, 0)
        middle = axle + 0.5 * self.wheelbase * car[:, 0]
        made = {"car": jj.RigidBody.box(self.car_mass, (3.6, 1.0, 0.8), position=middle, orientation=car)}
        for name, side in (("left", 0.5), ("right", -0.5)):
            # tan(angle) = wheelbase / (R - side track) with R = wheelbase / tan(steer)
            angle = jnp.arctan(
                self.wheelbase * jnp.tan(q.steer) / (self.wheelbase - side * self.track * jnp.tan(q.steer))
            )
            centre = axle + self.wheelbase * car[:, 0] + side * self.track * car[:, 1]
            made[name] = jj.RigidBody.thin_disc(
                self.wheel_mass, 0.35, axis="y", position=centre, orientation=car @ jj.rot_z(angle)
            )
        for i in range(self.trailers):
            turned = jj.rot_z(q[f"trailer{i + 1}"])
            axle = axle - self.length * turned[:, 0]
            made[f"trailer {i + 1}"] = jj.RigidBody.box(
                self.trailer_mass, (2.4, 1.2, 0.8), position=axle, orientation=turned
            )
        return made

    def visuals(self, pose):
        up, half = jnp.array([0.0, 0.0, 0.35]), 0.5 * self.wheelbase
        body = [
            jj.Visual.box((3.6, 1.2, 0.5), at=(0.0, 0.0, 0.55)),
            jj.Visual.box((1.6, 1.1, 0.5), at=(-0.3, 0.0, 1.0)),
        ]
        looks = {
            "car": [
                *body,
                *(
                    jj.Visual.wheel(0.35, 0.2, at=up + jnp.stack([-half, side * self.track, 0.0]))
                    for side in (0.5, -0.5)
                ),
            ]
        }
        looks |= {name: jj.Visual.wheel(0.35, 0.2, at=up) for name in ("left", "right")}
        for i in range(1, self.trailers + 1):
            wheels = [jj.Visual.wheel(0.35, 0.2, at=(0.0, side, 0.35)) for side in (0.6, -0.6)]
            tongue = jj.Visual.line(
                up, up + jnp.stack([self.length, 0.0, 0.0]), radius=0.06, colour="#8a8a86"
            )
            looks[f"trailer {i}"] = [jj.Visual.box((2.4, 1.0, 0.6), at=(0.0, 0.0, 0.7)), *wheels, tongue]
        return looks

    def loads(self, motion):
        push = motion.inputs.drive * motion["car"].orientation[:, 0]
        return jj.point_force(motion["car"].point(), push), jj.generalized_force(
            motion, steer_rate=motion.inputs.steer_torque
        )

    def velocity_constraints(self, motion):
        car = motion["car"]
        rows = {
            "rear axle": jj.knife_edge(
                car, car.position - 0.5 * self.wheelbase * car.orientation[:, 0], car.orientation[:, 1]
            )
        }
        for name in ("left", "right", *(f"trailer {i + 1}" for i in range(self.trailers))):
            rows[name] = jj.knife_edge(motion[name], motion[name].position, motion[name].orientation[:, 1])
        return rows
