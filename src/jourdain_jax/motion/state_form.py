"""What is integrated: the minimal state (q, privileged speeds) or the full state (q, u), and its rates.

    minimal: qdot = N u + nu,  u = C y + c,  ydot = privileged rows of udot     (velocity rows hold exactly)
    full:    qdot = N u + nu,  udot                                               (kept on the rows by projection)

In a batch the minimal state of a lowered scene is a tuple of scalars, a structure of arrays under `vmap`; all others are vectors.
Where some force or row does work that no potential accounts for, that work is integrated beside the state.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jourdain_jax.calculus.pseudo_inverse import passing_cutoff
from jourdain_jax.equations.accelerations import Baumgarte, bare_accelerations
from jourdain_jax.equations.kinematics import motion_at
from jourdain_jax.equations.minimal import minimal_accelerations, speeds_and_pivot, speeds_from_privileged
from jourdain_jax.equations.power import power
from jourdain_jax.equations.projection import project_positions, project_speeds
from jourdain_jax.equations.reductions import NullSpaceQR, Privileged, Reduction
from jourdain_jax.equations.structure import WELL_CONDITIONED, Structure
from jourdain_jax.lowering.lowered import Lowered
from jourdain_jax.scene.scene import Scene


class Integrated(eqx.Module):
    """The integrated state: coordinates, speeds (all, or the privileged ones), work done so far (J) where it is tracked."""

    q: Float[Array, "coordinates"] | tuple[Float[Array, ""], ...]
    v: Float[Array, "integrated_speeds"] | tuple[Float[Array, ""], ...]
    work: Float[Array, ""] | None


class StateForm(eqx.Module):
    """How a scene's state is packed, unpacked, differentiated in time and projected. All choices are static."""

    independent: tuple[int, ...] | None = eqx.field(static=True)  # privileged speeds; None: the full state
    reduction: object
    stabilisation: Baumgarte | None
    with_work: bool = eqx.field(static=True)
    projects_positions: bool = eqx.field(static=True)
    projects_speeds: bool = eqx.field(static=True)
    lowered: Lowered | None = eqx.field(static=True, default=None)  # the scalar program of the rates; None: dense matrices
    as_scalars: bool = eqx.field(static=True, default=False)  # the state of a lowered scene as a tuple of scalars: best for batches
    cutoff: float | None = eqx.field(static=True, default=None)  # of the projection of speeds: below it rows count as dependent; None: round-off

    @property
    def name(self) -> str:
        """ "minimal" or "full"."""
        return "full" if self.independent is None else "minimal"

    @property
    def reduction_name(self) -> str:
        """Name of the reduction, as it stands in a trajectory."""
        detail = "" if self.lowered is None else ", lowered"
        return getattr(self.reduction, "name", "") + (detail if self.cutoff is None else f", cut-off {self.cutoff:.0e}")

    @property
    def _by_appell(self) -> bool:
        """Whether the reduction uses the same privileged speeds as the state."""
        return isinstance(self.reduction, Privileged) and self.reduction.independent == self.independent and self.stabilisation is None

    def fixed(self, scene: Scene) -> tuple:
        """What the lowered rates need of the scene: computed once per motion."""
        return () if self.lowered is None else self.lowered.fixed_values(scene)

    def pack(self, q, u) -> Integrated:
        """The integrated state of (q, u)."""
        v = u if self.independent is None else u[jnp.array(self.independent, jnp.int32)]
        return self._like_state(Integrated(q, v, jnp.zeros((), q.dtype) if self.with_work else None))

    def _like_state(self, y: Integrated) -> Integrated:
        return Integrated(tuple(y.q), tuple(y.v), y.work) if self.as_scalars else y

    def vectors(self, y: Integrated) -> Integrated:
        """The state with q and v as vectors."""
        if not self.as_scalars:
            return y
        return Integrated(jnp.stack(y.q), jnp.stack(y.v) if y.v else jnp.zeros(0, y.q[0].dtype), y.work)

    def unpack(self, scene: Scene, fixed, t, y: Integrated, inputs) -> tuple[Float[Array, "coordinates"], Float[Array, "speeds"]]:
        """Coordinates and all speeds."""
        if self.lowered is not None:
            return self.vectors(y).q, self.lowered.speeds_and_pivot(fixed, t, tuple(y.q), tuple(y.v), inputs)[0]
        return y.q, y.v if self.independent is None else speeds_from_privileged(scene, self.independent, t, y.q, y.v, inputs)

    def pivot(self, scene: Scene, fixed, t, y: Integrated, inputs) -> Float[Array, ""]:
        """How well the privileged speeds determine the others, with a sign that changes where they do not (1 for the full state)."""
        if self.lowered is not None:
            return self.lowered.speeds_and_pivot(fixed, t, tuple(y.q), tuple(y.v), inputs)[1]
        return jnp.ones(()) if self.independent is None else speeds_and_pivot(scene, self.independent, t, y.q, y.v, inputs)[1]

    def rates(self, scene: Scene, fixed, t, y: Integrated, inputs) -> Integrated:
        """Time derivative of the integrated state."""
        if self.lowered is not None:
            found = Integrated(*self.lowered.rates(fixed, t, tuple(y.q), tuple(y.v), inputs, self.with_work))
            return found if self.as_scalars else Integrated(jnp.stack(found.q), jnp.stack(found.v) if found.v else y.v, found.work)
        if self.independent is not None and self._by_appell:
            _, motion, found = minimal_accelerations(scene, self.independent, t, y.q, y.v, inputs)
        else:
            _, u = self.unpack(scene, fixed, t, y, inputs)
            motion = motion_at(scene, t, y.q, u, inputs)
            found = bare_accelerations(scene, t, y.q, u, inputs, reduction=self.reduction, stabilisation=self.stabilisation)
        v = found.udot if self.independent is None else found.udot[jnp.array(self.independent, jnp.int32)]
        return Integrated(motion.qdot.array, v, power(scene, motion, found).total if self.with_work else None)

    def project(self, scene: Scene, t, y: Integrated, inputs, iterations: int = 2) -> Integrated:
        """The state put back onto geometric rows, quaternion norms and (full state) velocity rows."""
        y = self.vectors(y)
        q = project_positions(scene, t, y.q, iterations=iterations) if self.projects_positions else y.q
        v = project_speeds(scene, t, q, y.v, inputs, iterations=iterations, cutoff=self.cutoff) if self.projects_speeds else y.v
        return self._like_state(Integrated(q, v, y.work))


def cutoff_of(structure: Structure) -> float | None:
    """Where rows that are well conditioned at most states lose rank, motions pass more safely with a wider cut-off; None: round-off."""
    return passing_cutoff(jnp.result_type(float)) if structure.typical_pivot >= WELL_CONDITIONED else None


def default_reduction(structure: Structure, independent: tuple[int, ...] | None) -> Reduction:
    """Privileged velocities for the minimal state, the null space by QR for the full one."""
    return NullSpaceQR(cutoff_of(structure)) if independent is None else Privileged(independent)
