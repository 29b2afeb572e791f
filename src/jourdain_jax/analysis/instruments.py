"""What shows accelerations and forces: accelerometers on bodies, load cells under contacts.

    f = R' (a_P - g),     a_P = d/dt (v + omega x (P - r)) along (1, qdot, udot)

Source: D. H. Titterton and J. L. Weston, Strapdown Inertial Navigation Technology, 2nd ed. (2004), section 3.
"""

from abc import abstractmethod

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jourdain_jax.analysis.channels import motion_shape
from jourdain_jax.build.reference_parameters import once_per_values
from jourdain_jax.build.sampling import sample_states
from jourdain_jax.calculus.reals import checked_real, described
from jourdain_jax.dynamics.accelerations import accelerations
from jourdain_jax.dynamics.reactions import contact_forces
from jourdain_jax.equations.kinematics import coordinate_rates, motion_at
from jourdain_jax.motion.trajectories.trajectory import Trajectory
from jourdain_jax.scene.names import nearest
from jourdain_jax.scene.scene import Scene


class Instrument(eqx.Module):
    """What shows three components that depend on the accelerations of a scene."""

    @abstractmethod
    def check(self, scene: Scene, channel: str, where: str) -> None:
        """ValueError, which names the channel and the run, where the scene has nothing that it could show."""

    @abstractmethod
    def over_times(self, motion: Trajectory) -> Float[Array, "times 3"]:
        """What it shows at all times of one motion."""


class Accelerometer(Instrument):
    """Three accelerometers at a point of a body, along its axes: the specific force `R' (a - g)` in m/s^2, at rest upwards by g.

        imu = jj.Sensor(jj.Accelerometer("frame", (0.3, 0.0, 0.1)), bias=jj.Estimate((0.0, 0.0, 0.0)))
        jj.Experiment(ts, {"imu": a}, 0.1, start=start, sensors={"imu": imu})                        # a: (times, 3), m/s^2

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

    def check(self, scene: Scene, channel: str, where: str) -> None:
        """ValueError, which names the `channel` and the run, where the scene has no such body."""
        bodies = motion_shape(scene).bodies
        if self.body not in bodies:
            raise ValueError(f"the accelerometer `{channel}` of {where} sits on body `{self.body}`, which is not there; {nearest(self.body, bodies)}")

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


class LoadCell(Instrument):
    """A load cell under a rolling contact: the force of the ground on the body, in N.

        jj.Experiment(ts, {"plate": force}, 2.0, start=start, sensors={"plate": jj.LoadCell("front")})                # force: (times, 3), N

    - `contact`: its name.

    A channel of shape (times, 3): two components along the tangents of the ground, then the one along its normal, as `Trajectory.contact_forces` has them.

    **Raises** ValueError for what is no name; with a scene, for a contact that is not there, or whose force the rows do not determine.
    """

    contact: str = eqx.field(static=True)

    def __init__(self, contact):
        if not isinstance(contact, str):
            raise ValueError(f"`contact` of `LoadCell` is {described(contact)}, expected the name of a contact")
        self.contact = contact

    def check(self, scene: Scene, channel: str, where: str) -> None:
        """ValueError, which names the `channel` and the run, where the scene has no such contact, or does not determine its force."""
        determined = _determined(scene)
        if self.contact not in determined:
            raise ValueError(f"the load cell `{channel}` of {where} is under contact `{self.contact}`, which is not there; {nearest(self.contact, determined)}")
        if not determined[self.contact]:
            raise ValueError(
                f"the load cell `{channel}` of {where} is under contact `{self.contact}`, whose force is not determined: others share it; leave the channel out"
            )

    def over_times(self, motion: Trajectory) -> Float[Array, "times 3"]:
        """What it shows at all times of one motion."""
        force = motion.contact_forces()[self.contact]
        return jnp.concatenate([force.tangential, force.normal[..., None]], axis=-1)


@once_per_values
def _determined(scene: Scene) -> dict[str, bool]:
    """Contact -> whether its force is determined at a state of the scene."""
    t, q, u = (x[0] for x in sample_states(scene, 1))
    return {name: bool(force.determined) for name, force in contact_forces(scene, t, q, u, accelerations(scene, t, q, u)).items()}
