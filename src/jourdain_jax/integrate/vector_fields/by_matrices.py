"""Rates by dense matrices that JAX differentiates, with the minimal or the full state. They serve scenes
without a scalar program, and reductions chosen by the user.
"""

from dataclasses import fields

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jourdain_jax.calculus.reals import Indices, PerRow, Scalar, Speeds, is_traced, static
from jourdain_jax.dynamics.accelerations import Baumgarte, bare_accelerations, reduced_at
from jourdain_jax.dynamics.reactions import rate_of_work
from jourdain_jax.equations.gibbs_appell import (
    GibbsAppell,
    MinimalKinematics,
    accelerations_of,
    minimal_kinematics,
)
from jourdain_jax.equations.kinematics import motion_at, rates_by_own_speeds
from jourdain_jax.equations.phases import At, put_back
from jourdain_jax.equations.projection import project_positions, project_speeds
from jourdain_jax.equations.reductions import Partition, Privileged, Reduced, scaled, speed_scale
from jourdain_jax.equations.rows import UsualRows, names_of_position_rows, velocity_residual
from jourdain_jax.equations.virtual_power import coordinate_rates_in_modes, mass_matrix_at
from jourdain_jax.integrate.vector_fields.field import Instant, Integrated, VectorField, Watched
from jourdain_jax.scene.identity import with_reference_parameters
from jourdain_jax.scene.motion_state import Motion
from jourdain_jax.scene.scene import Scene
from jourdain_jax.structure.probes import generic_inputs
from jourdain_jax.structure.structure import closure_lengths, structure_whatever_its_faults, trust, usual_rows


class UsualLengths(eqx.Module):
    """Typical lengths of matrix rows: of velocity constraints in scaled speeds (with their rank), and of
    geometric constraints and quaternion norms in the coordinates.
    """

    rows: UsualRows
    closures: Float[Array, "closures"]
    own_speeds: Float[Array, "own_speeds"]  # size of the coordinate rates due to each own speed of the scene


def usual_lengths(scene: Scene) -> UsualLengths:
    """Return the typical lengths for the parameters of `scene`. They have no derivatives."""
    with jax.ensure_compile_time_eval():  # the results are cached, so they must be concrete even inside `jit`
        own_speeds = _of_own_speeds(scene)
        if not is_traced(scene):
            return UsualLengths(
                jax.tree.map(jnp.asarray, usual_rows(scene)), jnp.asarray(closure_lengths(scene)), own_speeds
            )
    return UsualLengths(*_of_traced(scene), own_speeds)


def _of_traced(scene: Scene) -> tuple[UsualRows, Float[Array, "closures"]]:
    """Return the lengths for traced parameters, at states that were probed with parameters near the class's
    defaults. They are computed in the program of the motion.
    """
    known, still = structure_whatever_its_faults(scene), jax.lax.stop_gradient(scene)
    count = min(12, known.random)
    t = jnp.asarray(known.times[:count])
    q = jnp.asarray(known.coordinates[:count])
    inputs = jnp.asarray(generic_inputs(scene))
    u = jnp.ones(len(scene.speed_names), q.dtype)

    def lengths(t, q):
        A = jax.jacfwd(lambda u: velocity_residual(still, t, q, u, inputs.astype(q.dtype)))(u)
        return jnp.linalg.norm(A * speed_scale(mass_matrix_at(still, t, q)), axis=1), jnp.linalg.norm(
            A, axis=1
        )

    scaled, plain = (_usual(x) for x in jax.vmap(lengths)(t, q))
    norms = jnp.ones(len(scene.coordinates.quaternions), plain.dtype)
    rank = jnp.asarray(known.rank, jnp.int32)
    return UsualRows(scaled, rank), jnp.concatenate([plain[: len(names_of_position_rows(scene))], norms])


def _usual(sizes: Float[Array, "states rows"]) -> PerRow:
    """Return the median over states, or the largest value if the median is zero. NaN is ignored."""
    median = jnp.nanmedian(sizes, axis=0)
    return jax.lax.stop_gradient(jnp.where(median > 0, median, jnp.nanmax(sizes, axis=0, initial=0.0)))


def _of_own_speeds(scene: Scene) -> Float[Array, "own_speeds"]:
    """Return the size of the coordinate rates due to each of the scene's own speeds, as the median over
    probed states (a thousand times larger for traced parameters). A rate far above this size counts as
    infinite.
    """
    known, reference = structure_whatever_its_faults(scene), with_reference_parameters(scene)
    t, q = jnp.asarray(known.times), jnp.asarray(known.coordinates)
    lengths = jnp.nanmedian(
        jax.vmap(lambda t, q: jnp.linalg.norm(rates_by_own_speeds(reference, t, q), axis=1))(t, q), axis=0
    )
    return jnp.where(lengths > 0, lengths, jnp.inf) / trust(scene)


class ByMatrices(VectorField):
    """Base class of the minimal and the full state by dense matrices."""

    stabilisation: Baumgarte | None
    usual: UsualLengths  # of the constraints
    # whether constraints depend on inputs that change with time, so that rates of inputs are needed
    inputs_in_rows: bool = static()
    # indices of all constraints, if some are nonlinear in the speeds and none is redundant; otherwise empty
    nonlinear_rows: Indices = static()
    # singular values below the cutoff count as zero when speeds are projected; None: round-off
    cutoff: float | None = static()

    def now(self, inputs, t):
        """Return the values of the inputs, and their rates if constraints depend on them."""
        return inputs.near(t) if self.inputs_in_rows else inputs(t)

    def solved(self, at: Instant, u) -> tuple[Motion, Reduced, Float[Array, "rows speeds"]]:
        """Return the motion with the speeds u, its accelerations, and the directions of the constraints
        `nonlinear_rows`, each orthogonal to the earlier ones.
        """
        state = at.scene, at.t, at.y.q, u, at.inputs
        found, equations, rows = reduced_at(*state, self.reduction, self.stabilisation, self.usual.rows)
        return (
            motion_at(*state),
            found,
            _left_by_elimination(scaled(equations, rows).A[jnp.array(self.nonlinear_rows, int)]),
        )

    def watched(self, at: Instant, motion: Motion, found: Reduced, v, pivots, rows) -> Watched:
        """Return rates, pivots and directions. Coordinate rates due to the scene's own speeds, which must
        stay finite, are added to the pivots and to the directions `rows`.
        """
        power = rate_of_work(at.scene, motion, found, self.of_inputs) if self.with_work else None
        N = jax.lax.stop_gradient(rates_by_own_speeds(at.scene, at.t, at.y.q))
        width = max(rows.shape[1], N.shape[1])
        padded = [jnp.pad(x, ((0, 0), (0, width - x.shape[1]))) for x in (rows, N)]
        pivots = jnp.append(pivots, self.usual.own_speeds / jnp.linalg.norm(N, axis=1))
        return Watched(
            Integrated(coordinate_rates_in_modes(at.scene, motion), v, power), pivots, jnp.concatenate(padded)
        )

    def project(self, at: Instant) -> Integrated:
        scene, _, t, y, inputs = at
        q, v = y.q, y.v
        if scene.switching.contacts and self.projects_speeds:
            q, v = put_back(At(scene, motion_at(scene, t, q, v, inputs)))
        if self.projects_positions:
            q = project_positions(scene, t, q, iterations=2, typical=self.usual.closures)
        if self.projects_speeds:
            v = project_speeds(
                scene, t, q, v, inputs, iterations=2, cutoff=self.cutoff, typical=self.usual.rows.lengths
            )
        return Integrated(q, v, y.work)


class MinimalByMatrices(ByMatrices):
    """Minimal state: coordinates and independent speeds."""

    independent: Indices = static()
    rows: Indices = static()  # constraints that determine the dependent speeds

    @property
    def has_pivots(self) -> bool:
        """Return True: the sign of det A_z is monitored."""
        return True

    def speeds(self, at: Instant) -> Speeds:
        return self._kinematics(at).u

    def speeds_and_pivot(self, at: Instant, plain: tuple) -> tuple[Speeds, Scalar]:
        """Return all speeds, and the pivot with the sign of det A_z."""
        found = self._kinematics(at)
        return found.u, Partition(jax.lax.stop_gradient(found.split.A), self.independent).signed_pivot()

    def rates_and_pivots(self, at: Instant) -> Watched:
        """Return the rates and, as a pivot, the sign of det A_z."""
        known = self._kinematics(at)
        own = (
            isinstance(self.reduction, Privileged)
            and self.reduction.independent == self.independent
            and self.stabilisation is None
        )
        motion, found = (
            accelerations_of(at.scene, known, at.t, at.y.q, at.inputs)
            if own
            else self.solved(at, known.u)[:2]
        )
        v = found.udot[np.array(self.independent, np.uint32)]
        return self.watched(
            at, motion, found, v, known.split.orientation()[None], jnp.zeros((0, len(known.u)))
        )

    def _kinematics(self, at: Instant) -> MinimalKinematics:
        return minimal_kinematics(at.scene, self.independent, self.rows, at.t, at.y.q, at.y.v, at.inputs)


class FullByMatrices(ByMatrices):
    """Full state: coordinates and all speeds."""

    # pivot below which round-off decides between branches that cross at a loss of rank; None: no branches
    undecided: float | None = static()
    own_equations: str = static(default="")  # equations that a solver uses instead of accelerations

    @property
    def reduction_name(self) -> str:
        if self.own_equations:
            return f"none, {self.own_equations}"
        if self.cutoff is None:
            return super().reduction_name
        return f"{super().reduction_name}, cutoff {self.cutoff:.0e}"

    @property
    def needs_pivot(self) -> bool:
        """Return False: the full state continues, with a warning."""
        return False

    @property
    def has_pivots(self) -> bool:
        """Return whether pivots or directions are monitored, because the motion might change to another
        branch.
        """
        return self.undecided is not None or bool(self.nonlinear_rows) or len(self.usual.own_speeds) > 0

    @property
    def near_rank_loss(self) -> bool:
        """Return whether steps are projected onto constraints at which branches of motion may cross."""
        return self.projects and self.undecided is not None

    def speeds(self, at: Instant) -> Speeds:
        return at.y.v

    def speeds_and_pivot(self, at: Instant, plain: tuple) -> tuple[Speeds, Scalar | None]:
        if not isinstance(self.reduction, Privileged | GibbsAppell):
            return at.y.v, None
        found = bare_accelerations(at.scene, at.t, at.y.q, at.y.v, at.inputs, reduction=self.reduction)
        return at.y.v, found.pivot

    def rates_and_pivots(self, at: Instant) -> Watched:
        """Return the rates, directions of constraints, and as a pivot 1 if the constraints determine the
        branch of the motion, -1 if round-off does.
        """
        motion, found, directions = self.solved(at, at.y.v)
        branch = (
            jnp.zeros(0)
            if self.undecided is None
            else jnp.where(found.pivot > self.undecided, 1.0, -1.0)[None]
        )
        watched = self.watched(at, motion, found, found.udot, branch.astype(at.y.q.dtype), directions)
        return watched._replace(sine=found.pivot) if self.near_rank_loss else watched


def _left_by_elimination(A: Float[Array, "rows speeds"]) -> Float[Array, "rows speeds"]:
    """Return the component of each row that is orthogonal to the earlier rows."""
    Q, R = jnp.linalg.qr(jax.lax.stop_gradient(A).T)
    return (Q * jnp.diagonal(R)).T


def full_without_projection(field: VectorField, scene: Scene, own_equations: str) -> FullByMatrices:
    """Return the field with the full state and without projection, for a solver that satisfies the
    constraints by its `own_equations`.
    """
    kept = {part.name: getattr(field, part.name) for part in fields(VectorField)}
    kept |= dict.fromkeys(("projects_positions", "projects_speeds", "rows_may_contradict"), False)
    return FullByMatrices(
        **kept | dict.fromkeys(("independent", "cutoff", "undecided")),
        nonlinear_rows=(),
        stabilisation=field.stabilisation if isinstance(field, ByMatrices) else None,
        usual=usual_lengths(scene),
        inputs_in_rows=isinstance(field, ByMatrices) and field.inputs_in_rows,
        own_equations=own_equations,
    )
