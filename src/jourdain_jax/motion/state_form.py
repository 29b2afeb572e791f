"""What is integrated: the minimal state (q, privileged speeds) or the full state (q, u), and its rates.

    minimal: qdot = N u + nu,  u = C y + c,  ydot = privileged rows of udot     (velocity rows hold exactly)
    full:    qdot = N u + nu,  udot                                               (kept on the rows by projection)

Where some force or row does work that no potential accounts for, that work is integrated beside the state.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jourdain_jax.equations.accelerations import Baumgarte, bare_accelerations
from jourdain_jax.equations.kinematics import motion_at
from jourdain_jax.equations.minimal import minimal_accelerations, speeds_and_pivot, speeds_from_privileged
from jourdain_jax.equations.power import power
from jourdain_jax.equations.projection import project_positions, project_speeds
from jourdain_jax.equations.reductions import Privileged
from jourdain_jax.scene.scene import Scene


class Integrated(eqx.Module):
    """The integrated state: coordinates, speeds (all, or the privileged ones), work done so far (J) where it is tracked."""

    q: Float[Array, "coordinates"]
    v: Float[Array, "integrated_speeds"]
    work: Float[Array, ""] | None


class StateForm(eqx.Module):
    """How a scene's state is packed, unpacked, differentiated in time and projected. All choices are static."""

    independent: tuple[int, ...] | None = eqx.field(static=True)  # privileged speeds; None: the full state
    reduction: object
    stabilisation: Baumgarte | None
    with_work: bool = eqx.field(static=True)
    projects_positions: bool = eqx.field(static=True)
    projects_speeds: bool = eqx.field(static=True)

    @property
    def name(self) -> str:
        """ "minimal" or "full"."""
        return "full" if self.independent is None else "minimal"

    @property
    def _by_appell(self) -> bool:
        """Whether the reduction uses the same privileged speeds as the state."""
        return isinstance(self.reduction, Privileged) and self.reduction.independent == self.independent and self.stabilisation is None

    def pack(self, q, u) -> Integrated:
        """The integrated state of (q, u)."""
        v = u if self.independent is None else u[jnp.array(self.independent, jnp.int32)]
        return Integrated(q, v, jnp.zeros((), q.dtype) if self.with_work else None)

    def unpack(self, scene: Scene, t, y: Integrated, inputs) -> Float[Array, "speeds"]:
        """All speeds u."""
        return y.v if self.independent is None else speeds_from_privileged(scene, self.independent, t, y.q, y.v, inputs)

    def unpack_with_pivot(self, scene: Scene, t, y: Integrated, inputs) -> tuple[Float[Array, "speeds"], Float[Array, ""]]:
        """All speeds, and how well the privileged ones determine the others (1 for the full state, which has none)."""
        return (y.v, jnp.ones((), y.v.dtype)) if self.independent is None else speeds_and_pivot(scene, self.independent, t, y.q, y.v, inputs)

    def rates(self, scene: Scene, t, y: Integrated, inputs) -> Integrated:
        """Time derivative of the integrated state."""
        if self.independent is not None and self._by_appell:
            _, motion, found = minimal_accelerations(scene, self.independent, t, y.q, y.v, inputs)
        else:
            u = self.unpack(scene, t, y, inputs)
            motion = motion_at(scene, t, y.q, u, inputs)
            found = bare_accelerations(scene, t, y.q, u, inputs, reduction=self.reduction, stabilisation=self.stabilisation)
        v = found.udot if self.independent is None else found.udot[jnp.array(self.independent, jnp.int32)]
        return Integrated(motion.qdot.array, v, power(scene, motion, found).total if self.with_work else None)

    def project(self, scene: Scene, t, y: Integrated, inputs, iterations: int = 2) -> Integrated:
        """The state put back onto geometric rows, quaternion norms and (full state) velocity rows."""
        q = project_positions(scene, t, y.q, iterations=iterations) if self.projects_positions else y.q
        v = project_speeds(scene, t, q, y.v, inputs, iterations=iterations) if self.projects_speeds else y.v
        return Integrated(q, v, y.work)


def default_reduction(independent: tuple[int, ...] | None):
    """Privileged velocities for the minimal state, the null space by QR for the full one."""
    return "qr" if independent is None else Privileged(independent)
