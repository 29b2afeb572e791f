"""What an accelerometer on a body feels: the specific force at its place, in the axes of the body.

    f = R' (a_P - g),     a_P = d/dt (v + omega x (P - r)) along (1, qdot, udot)

Source: D. H. Titterton and J. L. Weston, Strapdown Inertial Navigation Technology, 2nd ed. (2004), section 3.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jourdain_jax.calculus.reals import checked_real, described
from jourdain_jax.equations.kinematics import coordinate_rates, motion_at
from jourdain_jax.motion.trajectories.trajectory import Trajectory
from jourdain_jax.scene.scene import Scene


class Accelerometer(eqx.Module):
    """Three accelerometers at a point of a body, along its axes: the specific force `R' (a - g)` in m/s^2, at rest upwards by g.

        imu = jj.Sensor(jj.Accelerometer("frame", (0.3, 0.0, 0.1)), bias=jj.Estimate((0.0, 0.0, 0.0)))
        jj.Measurements(ts, {"imu": a}, 0.1, start=start, sensors={"imu": imu})                        # a: (times, 3), m/s^2

    - `body`: its name. `point`: where it sits, in m, in the body's frame, from its mass centre.
    - `gravity`: g in m/s^2, in the inertial frame.

    A channel of shape (times, 3). Its accelerations are those of the scene at the states of the motion, not differences.

    **Raises** ValueError for what is no name, or no three components.
    """

    body: str = eqx.field(static=True)
    point: Float[Array, "3"]  # m
    gravity: Float[Array, "3"]  # m/s^2

    def __init__(self, body, point=(0.0, 0.0, 0.0), gravity=(0.0, 0.0, -9.81)):
        if not isinstance(body, str):
            raise ValueError(f"`body` of `Accelerometer` is {described(body)}, expected the name of a body")
        self.body = body
        self.point = checked_real(point, "`point` of `Accelerometer`", (3,), advice="give three components in the body's frame, m")
        self.gravity = checked_real(gravity, "`gravity` of `Accelerometer`", (3,), advice="give three components in the inertial frame, m/s^2")

    def over_times(self, motion: Trajectory) -> Float[Array, "times 3"]:
        """What it feels at all times of one motion."""
        return jax.vmap(lambda *state: self._felt(motion.scene, *state))(motion.ts, motion.q, motion.u, motion.accelerations().udot)

    def _felt(self, scene: Scene, t, q, u, udot) -> Float[Array, "3"]:
        def velocity(t, q, u):
            body = motion_at(scene, t, q, u)[self.body]
            return body.velocity_at(body.place(self.point)), body.orientation

        along = jnp.ones_like(t), coordinate_rates(scene, t, q, u), udot
        (_, orientation), (acceleration, _) = jax.jvp(velocity, (t, q, u), along)
        return orientation.T @ (acceleration - self.gravity.astype(q.dtype))
