"""A satellite with three reaction wheels: internal torques turn it, and its angular momentum in space is
conserved.

If one wheel is driven from rest about a principal axis, the satellite turns by -I_w / (I + I_w) times the
angle of the wheel relative to it. There are no constraints. Source: P. C. Hughes, Spacecraft Attitude
Dynamics (1986), ch. 6 (gyrostats).
"""

import jax.numpy as jnp

import jourdain_jax as jj

LOOK = (
    "The wheels are driven from rest. The satellite turns in the opposite direction, and the total angular"
    " momentum stays zero."
)


class Satellite(jj.Scene):
    """Coordinates: x, y, z of the bus and its attitude; angles of the wheels on its faces. Inputs: torques of
    the wheels' motors (N m).
    """

    bus_mass: float = jj.parameter(30.0, unit="kg", positive=True)
    sides: jnp.ndarray = jj.parameter((0.6, 0.5, 0.4), unit="m", positive=True, about="of the bus")
    wheel_mass: float = jj.parameter(1.5, unit="kg", positive=True)
    wheel_radius: float = jj.parameter(0.14, unit="m", positive=True)

    coordinates = jj.coordinates("x y z", jj.quaternion("attitude"), "wheel_x wheel_y wheel_z")
    inputs = jj.inputs("torque_x torque_y torque_z")
    conventions = (
        "Right-handed inertial axes; attitude takes the bus to space; wheels turn about the axes of the bus."
    )
    example = {"wheel_x_rate": 60.0, "attitude_omega_y": 0.3}
    example_span = 10.0

    def bodies(self, t, q):
        bus, centre = jj.quaternion_to_matrix(q.attitude), jnp.stack([q.x, q.y, q.z])
        made = {"bus": jj.RigidBody.box(self.bus_mass, self.sides, position=centre, orientation=bus)}
        for k, (axis, turned) in enumerate(
            (("x", jj.rot_x(q.wheel_x)), ("y", jj.rot_y(q.wheel_y)), ("z", jj.rot_z(q.wheel_z)))
        ):
            place = centre + (0.5 * self.sides[k] + 0.02) * bus[:, k]
            wheel = jj.RigidBody.thin_disc(
                self.wheel_mass, self.wheel_radius, axis=axis, position=place, orientation=bus @ turned
            )
            made[f"wheel {axis}"] = wheel
        return made

    def loads(self, motion):
        bus = motion["bus"].orientation
        return tuple(
            jj.torque(motion, f"wheel {axis}", motion.inputs[f"torque_{axis}"] * bus[:, k], reaction="bus")
            for k, axis in enumerate("xyz")
        )

    def invariants(self, motion):
        """Return the angular momentum about the mass centre, in space (N m s)."""
        bodies = [motion[name] for name in ("bus", "wheel x", "wheel y", "wheel z")]
        mass = sum(body.mass for body in bodies)
        middle, drift = (
            sum(body.mass * getattr(body, part) for body in bodies) / mass
            for part in ("position", "velocity")
        )
        momentum = 0.0
        for body in bodies:
            own = body.orientation @ body.body.inertia @ body.angular_velocity_body
            momentum = momentum + own + body.mass * jnp.cross(body.position - middle, body.velocity - drift)
        return {f"angular momentum {axis}": momentum[k] for k, axis in enumerate("xyz")}
