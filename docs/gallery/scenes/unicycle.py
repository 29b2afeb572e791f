"""A unicycle with a heavy rim and a rider who balances fore and aft by the pedals. Sideways, only the spin of
the wheel stabilises it.

With S = m_w r + m (r + h), the lean in straight running at the spin w obeys A lean'' = (S g - (I + S r) I w^2
/ (D + J_z)) lean: it is stable above the spin at which the bracket vanishes. Without a rider this is the
rolling disc's w^2 = g / (3 r). Source: the equations of the disc by J. I. Neimark and N. A. Fufaev (1972),
with a rider added to the same two equations of moments.
"""

import jax.numpy as jnp

import jourdain_jax as jj

LOOK = (
    "It weaves but does not fall, since the wheel turns faster than the critical spin. From `spin_rate=3.0`"
    " it falls."
)


class Unicycle(jj.Scene):
    """Coordinates: x, y of the contact; yaw and lean of the wheel; pitch of the rider; spin of the wheel.
    Input: `pedals`, a torque in addition to the rider's own (N m).
    """

    wheel_mass: float = jj.parameter(8.0, unit="kg", positive=True, about="all of it in the rim")
    radius: float = jj.parameter(0.35, unit="m", positive=True)
    rider_mass: float = jj.parameter(20.0, unit="kg", non_negative=True)
    height: float = jj.parameter(
        0.5, unit="m", positive=True, about="of the rider's mass centre above the axle"
    )
    rider_inertia: jnp.ndarray = jj.parameter((1.2, 1.2, 0.3), unit="kg m^2", non_negative=True)
    pitch_gain: float = jj.parameter(250.0, unit="N m", about="pedal torque for each radian of pitch")
    rate_gain: float = jj.parameter(60.0, unit="N m s", about="pedal torque for each rad/s of pitch")
    gravity: float = jj.parameter(9.81, unit="m/s^2")

    coordinates = jj.coordinates("x y yaw lean pitch spin")
    inputs = jj.inputs("pedals")
    privileged = ("yaw_rate", "lean_rate", "pitch_rate", "spin_rate")
    domain = {"yaw": (-3.2, 3.2), "lean": (-1.0, 1.0), "pitch": (-0.8, 0.8), "spin": (-3.2, 3.2)}
    conventions = (
        "z up; heading along x at yaw = 0; positive lean to the right, pitch forward, spin rolling forward."
    )
    example = {"lean": 0.06, "spin_rate": 8.0}
    example_span = 4.0

    def bodies(self, t, q):
        frame = jj.rot_z(q.yaw) @ jj.rot_x(q.lean)
        hub, rider = jj.vec(q.x, q.y, 0) + self.radius * frame[:, 2], frame @ jj.rot_y(q.pitch)
        rim = self.wheel_mass * self.radius**2
        spun = frame @ jj.rot_y(q.spin)
        outline = self.height * jnp.array(
            [[0, 0, -1], [0, 0, 0.4], [0, -0.5, 0.1], [0, 0, 0.4], [0, 0.5, 0.1], [0, 0, 0.4], [0, 0, 0.8]]
        )
        return {
            "wheel": jj.RigidBody.thin_disc(
                self.wheel_mass,
                self.radius,
                axis="y",
                position=hub,
                orientation=spun,
                axial=rim,
                diametral=rim / 2,
            ),
            "rider": jj.RigidBody(
                self.rider_mass, self.rider_inertia, hub + self.height * rider[:, 2], rider, outline
            ),
        }

    def loads(self, motion):
        pedals = (
            motion.inputs.pedals + self.pitch_gain * motion.q.pitch + self.rate_gain * motion.u.pitch_rate
        )
        axle = motion["wheel"].orientation[:, 1]
        return jj.gravity(motion, self.gravity), jj.torque(motion, "wheel", pedals * axle, reaction="rider")

    def contacts(self, pose):
        return {"rim": jj.disc_contact(pose["wheel"], self.radius)}

    def events(self, motion):
        return {"fallen": 1.0 - jnp.abs(motion.q.lean)}
