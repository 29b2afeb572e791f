"""What is integrated: the minimal state (q, privileged speeds) or the full state (q, u), and its rates.

    minimal: qdot = N u + nu,  u = C y + c,  ydot = privileged rows of udot     (velocity rows hold exactly)
    full:    qdot = N u + nu,  udot                                               (kept on the rows by projection)

The rates of a lowered scene also take states with a last axis of lanes.
Where some force or row does work that no potential accounts for, that work is integrated beside the state.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jourdain_jax.build.explicit_power import stored_by_inputs
from jourdain_jax.build.structure import WELL_CONDITIONED, Structure
from jourdain_jax.build.trace import event_values
from jourdain_jax.build.usual_lengths import UsualLengths
from jourdain_jax.calculus.pseudo_inverse import passing_cutoff, undecided
from jourdain_jax.dynamics.accelerations import Baumgarte, bare_accelerations
from jourdain_jax.dynamics.power import rate_of_work
from jourdain_jax.equations.gibbs_appell import GibbsAppell
from jourdain_jax.equations.kinematics import motion_at
from jourdain_jax.equations.minimal import accelerations_of, minimal_kinematics, speeds_and_pivot, speeds_from_privileged
from jourdain_jax.equations.projection import project_positions, project_speeds
from jourdain_jax.equations.reductions import Multipliers, NullSpaceQR, Privileged, Reduction
from jourdain_jax.lowering.lowered import Lowered
from jourdain_jax.scene.scene import Scene


class Integrated(eqx.Module):
    """The integrated state: coordinates, speeds (all, or the privileged ones), work done so far (J) where it is tracked."""

    q: Float[Array, "coordinates *lanes"]
    v: Float[Array, "integrated_speeds *lanes"]
    work: Float[Array, "*lanes"] | None


class StateForm(eqx.Module):
    """How a scene's state is packed, unpacked, differentiated in time and projected. All choices are static."""

    independent: tuple[int, ...] | None = eqx.field(static=True)  # privileged speeds; None: the full state
    reduction: object
    stabilisation: Baumgarte | None
    with_work: bool = eqx.field(static=True)
    projects_positions: bool = eqx.field(static=True)
    projects_speeds: bool = eqx.field(static=True)
    lowered: Lowered | None = eqx.field(static=True, default=None)  # the scalar program of the rates; None: dense matrices
    of_inputs: tuple[int, ...] = eqx.field(static=True, default=())  # numbers of the loads whose potential depends on inputs
    affine: bool = eqx.field(static=True, default=True)  # rows are, in the speeds
    own_equations: str = eqx.field(static=True, default="")  # of a solver that takes no accelerations: what it solves instead
    inputs_in_rows: bool = eqx.field(static=True, default=False)  # some change in time, and rows depend on them: their rates are needed
    usual: UsualLengths | None = None  # of the rows, for dense matrices
    may_branch: bool = eqx.field(static=True, default=False)  # where geometric rows lose rank, a cut-off leaves one out, and branches cross
    cutoff: float | None = eqx.field(static=True, default=None)  # of the projection of speeds: below it rows count as dependent; None: round-off

    @property
    def name(self) -> str:
        """ "minimal" or "full"."""
        return "full" if self.independent is None else "minimal"

    @property
    def reduction_name(self) -> str:
        """Name of the reduction, as it stands in a trajectory."""
        if self.own_equations:
            return f"none, {self.own_equations}"
        name = getattr(self.reduction, "name", "")
        return f"{name}, lowered" if self.lowered is not None else name if self.cutoff is None else f"{name}, cut-off {self.cutoff:.0e}"

    @property
    def _by_appell(self) -> bool:
        """Whether the reduction uses the same privileged speeds as the state."""
        return isinstance(self.reduction, Privileged) and self.reduction.independent == self.independent and self.stabilisation is None

    def fixed(self, scene: Scene) -> tuple:
        """What the lowered rates need of the scene: computed once per motion."""
        return () if self.lowered is None else self.lowered.fixed_values(scene)

    def now(self, inputs, t):
        """What the rates need of the inputs at a time: the values, with their own rates where rows depend on them."""
        return inputs.near(t) if self.inputs_in_rows else inputs(t)

    def pack(self, q, u) -> Integrated:
        """The integrated state of (q, u)."""
        v = u if self.independent is None else u[jnp.array(self.independent, jnp.int32)]
        return Integrated(q, v, jnp.zeros((), q.dtype) if self.with_work else None)

    def unpack(self, scene: Scene, fixed, t, y: Integrated, inputs) -> tuple[Float[Array, "coordinates"], Float[Array, "speeds"]]:
        """Coordinates and all speeds."""
        if self.lowered is not None:
            return y.q, self.lowered.speeds_and_pivot(fixed, t, tuple(y.q), tuple(y.v), inputs)[0]
        return y.q, y.v if self.independent is None else speeds_from_privileged(scene, self.independent, t, y.q, y.v, inputs)

    def stored(self, scene: Scene, t, q, inputs) -> Float[Array, ""]:
        """What loads whose potential depends on inputs store, J: with its change, the integrated work is the work done."""
        if not (self.with_work and self.of_inputs):
            return jnp.zeros((), q.dtype)
        return stored_by_inputs(scene, motion_at(scene, t, q, jnp.zeros(len(scene.speed_names), q.dtype), inputs), self.of_inputs)

    def pivot(self, scene: Scene, fixed, t, y: Integrated, inputs) -> Float[Array, ""]:
        """How well the privileged speeds determine the others, with a sign that changes where they do not.

        For the full state those of its reduction, without a sign; 1 where it has none.
        """
        if self.lowered is not None:
            return self.lowered.speeds_and_pivot(fixed, t, tuple(y.q), tuple(y.v), inputs)[1]
        if self.independent is not None:
            return speeds_and_pivot(scene, self.independent, t, y.q, y.v, inputs)[1]
        partitioned = isinstance(self.reduction, Privileged | GibbsAppell)
        return bare_accelerations(scene, t, y.q, y.v, inputs, reduction=self.reduction).pivot if partitioned else jnp.ones(())

    @property
    def needs_pivot(self) -> bool:
        """Whether a small pivot, or one that changes sign, ends a motion: a state that is all there goes on, with a warning."""
        return self.lowered is not None or self.independent is not None

    def events(self, scene: Scene, fixed, t, y: Integrated, inputs) -> Float[Array, "events *lanes"]:
        """Values of the stop events, sorted by name; lanes only where `lowers_events`."""
        if self.lowered is not None and self.lowered.events:
            return self.lowered.event_values(fixed, t, tuple(y.q), tuple(y.v), inputs)
        return event_values(scene, motion_at(scene, t, *self.unpack(scene, fixed, t, y, inputs), inputs))

    @property
    def lowers_events(self) -> bool:
        """Whether stop events are part of the scalar program."""
        return self.lowered is not None and bool(self.lowered.events)

    def rates(self, scene: Scene, fixed, t, y: Integrated, inputs) -> Integrated:
        """Time derivative of the integrated state."""
        return self.rates_and_pivots(scene, fixed, t, y, inputs)[0]

    @property
    def has_pivots(self) -> bool:
        """Whether steps in which some pivot changes its sign are tried again: in them the state, or a row that it is kept on, is lost."""
        if self.lowered is not None:
            return self.independent is not None and bool(self.lowered.pivots)
        return self.independent is not None or self.may_branch

    @staticmethod
    def _decided(pivot: Float[Array, ""]) -> Float[Array, ""]:
        """1 where the rows say on which branch the motion goes on, -1 where round-off does."""
        return jnp.where(pivot > undecided(pivot.dtype), 1.0, -1.0).astype(pivot.dtype)

    def rates_and_pivots(self, scene: Scene, fixed, t, y: Integrated, inputs) -> tuple[Integrated, Float[Array, "pivots *lanes"]]:
        """As `rates`, and what must keep its sign.

        These are the pivots of a lowered elimination relative to their usual sizes, the sign of det A_z, or, for the full state by the null space, 1 where all
        rows count and -1 where one is round-off.
        """
        if self.lowered is not None:
            qdot, vdot, power_now, pivots = self.lowered.rates_and_pivots(fixed, t, tuple(y.q), tuple(y.v), inputs, self.with_work)
            return Integrated(jnp.stack(qdot), jnp.stack(vdot) if vdot else y.v, power_now), jnp.stack(pivots) if pivots else jnp.zeros((0, *y.q.shape[1:]))
        known = None if self.independent is None else minimal_kinematics(scene, self.independent, t, y.q, y.v, inputs)
        if known is not None and self._by_appell:
            motion, found = accelerations_of(scene, known, t, y.q, inputs)
        else:
            u = y.v if known is None else known.u
            motion = motion_at(scene, t, y.q, u, inputs)
            usual = None if self.usual is None else self.usual.rows
            found = bare_accelerations(scene, t, y.q, u, inputs, reduction=self.reduction, stabilisation=self.stabilisation, usual=usual)
        v = found.udot if self.independent is None else found.udot[jnp.array(self.independent, jnp.int32)]
        rates = Integrated(motion.qdot.array, v, rate_of_work(scene, motion, found, self.of_inputs) if self.with_work else None)
        if known is not None:
            return rates, known.split.orientation()[None]
        return rates, self._decided(found.pivot)[None] if self.may_branch else jnp.zeros(0, y.q.dtype)

    def project(self, scene: Scene, fixed, t, y: Integrated, inputs, iterations: int = 2) -> Integrated:
        """The state put back onto geometric rows, quaternion norms and (full state) velocity rows; lanes only where it is lowered."""
        if self.lowered is not None:
            q, v = self.lowered.projected(fixed, t, tuple(y.q), tuple(y.v), inputs, self.affine)
            return Integrated(jnp.stack(q), jnp.stack(v) if v else y.v, y.work)
        assert self.usual is not None  # where matrices are dense
        q = project_positions(scene, t, y.q, iterations=iterations, typical=self.usual.closures) if self.projects_positions else y.q
        v = y.v
        if self.projects_speeds:
            v = project_speeds(scene, t, q, v, inputs, iterations=iterations, cutoff=self.cutoff, typical=self.usual.rows.lengths)
        return Integrated(q, v, y.work)


def cutoff_of(structure: Structure) -> float | None:
    """Where rows that are well conditioned at most states lose rank, motions pass more safely with a wider cut-off; None: round-off."""
    return passing_cutoff(jnp.result_type(float)) if structure.typical_pivot >= WELL_CONDITIONED else None


def default_reduction(structure: Structure, independent: tuple[int, ...] | None, program: Lowered | None) -> Reduction:
    """Privileged velocities for the minimal state; for the full one what a lowered program does, otherwise the null space by QR."""
    if independent is not None:
        return Privileged(independent)
    if program is None:
        return NullSpaceQR(cutoff_of(structure))
    return Privileged(structure.independent) if program.by_partition else Multipliers()
