"""The state at the start of a motion."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from jourdain_jax.calculus.reals import PerCoordinate, Scalar, Speeds, as_real, real_type, static
from jourdain_jax.scene.coordinates import Names
from jourdain_jax.scene.printing import Printed, in_digits
from jourdain_jax.scene.scene import Scene


class State(Printed, eqx.Module):
    """State on the constraints, and its distance from the guess: `state["yaw"]`, `print(state)`.

    q and u are in the units of the scene's coordinates and speeds (SI, rad).
    """

    t: Scalar  # s
    q: PerCoordinate
    u: Speeds
    moved_q: Scalar  # largest change of a coordinate by the projection
    moved_u: Scalar  # largest change of a speed by the projection
    residual: Scalar  # remaining residual of constraints and quaternion norms
    names: tuple[Names, Names] = static()
    # index of the successful guess: 0 for the given values, higher for others (`start`). A float, so that
    # losses can be differentiated with respect to a whole state
    guess: Scalar = eqx.field(default=0, converter=as_real)

    def __getitem__(self, name: str):
        """Return a coordinate, speed, quaternion or angular velocity by name."""
        coordinates, speeds = (names.view(x) for names, x in zip(self.names, (self.q, self.u), strict=True))
        return coordinates[name] if name in coordinates else speeds[name]

    def __contains__(self, name: str) -> bool:
        return any(name in names for names in self.names)

    def _text(self) -> str:
        if self.q.ndim > 1:
            return (
                f"States of shape {self.q.shape[:-1]}:"
                f" {', '.join((*self.names[0].entries, *self.names[1].entries))}"
            )
        entries = (*self.names[0].entries, *self.names[1].entries)
        values = in_digits(np.concatenate([self.q, self.u]))
        pairs = [f"{name} = {value}" for name, value in zip(entries, values, strict=True)]
        moved = (
            f"moved by {self.moved_q:.2e} (q), {self.moved_u:.2e} (u) onto the constraints; residual"
            f" {self.residual:.1e}"
        )
        if int(self.guess):
            moved += (
                f"; from guess {int(self.guess)}: the search for omitted coordinates failed and began again"
                " elsewhere in the domain"
            )
        return f"State at t = {self.t:.6g} s: " + ", ".join(pairs) + f"\n{moved}"


def state_of(scene: Scene, t, q, u, moved_q=0.0, moved_u=0.0, residual=0.0) -> State:
    """Return a state of a scene before projection."""
    t, moved_q, moved_u, residual = (jnp.asarray(x, real_type()) for x in (t, moved_q, moved_u, residual))
    return State(t, q, u, moved_q, moved_u, residual, (scene.coordinate_names, scene.speed_names))
