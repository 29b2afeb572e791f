"""The integrated state, and the interface of its rates.

    minimal: qdot = N u + nu,  u = C y + c,  ydot = independent rows of udot
    full:    qdot = N u + nu,  udot

The minimal state satisfies velocity constraints exactly; the full state is projected onto all constraints.
Work of forces or constraints without a potential is integrated along with the state.
"""

import abc
from typing import Any, Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jourdain_jax.calculus.reals import Indices, PerLane, Scalar, Speeds, check_kind, described, static
from jourdain_jax.dynamics.accelerations import Baumgarte
from jourdain_jax.equations.gibbs_appell import GibbsAppell
from jourdain_jax.equations.kinematics import motion_at
from jourdain_jax.equations.phases import At, contacts_at_start
from jourdain_jax.equations.reductions import Reduction
from jourdain_jax.equations.virtual_power import energies_at
from jourdain_jax.integrate.loop import value_kernels
from jourdain_jax.lowering.lowered_equations import Lowered
from jourdain_jax.scene.coordinates import Labels, check_name
from jourdain_jax.scene.motion_state import Motion
from jourdain_jax.scene.scene import Scene
from jourdain_jax.structure.load_power import stored_by_inputs
from jourdain_jax.structure.structure import Structure
from jourdain_jax.structure.trace import event_resets, event_values

_STATES = ("auto", "minimal", "full")


class Formulation(eqx.Module):
    """Form of the equations that `simulate` integrates. The default is chosen for the scene.

    - `state`: "minimal", coordinates q and independent speeds y; "full", coordinates and all speeds u; "auto"
      (default), the minimal state if the independent speeds are well conditioned over the scene's domain and
      the constraints are linear or affine, otherwise the full state.
    - `reduction`: method for the accelerations, a name or an object as in `accelerations` (default: the
      scene's scalar program if there is one).
    - `stabilisation`: method to satisfy constraints that the integrated state does not satisfy by
      construction: "projection" (default) projects the state after each step; `jj.Baumgarte(alpha, beta)`
      adds its terms to the constraints, for comparison; None does nothing.

    Raises ValueError for anything else.

    **Examples**

        rods = jj.models.DoublePendulumRods()
        dense = jj.Formulation("full", reduction="kkt")   # all speeds, multipliers by one linear system
        motion = jj.simulate(rods, t1=0.2, formulation=dense)
        print(motion.state_form, motion.reduction)
    """

    state: Literal["auto", "minimal", "full"] = static(default="auto")
    reduction: Reduction | GibbsAppell | str | None = None
    stabilisation: Baumgarte | Literal["projection"] | None = "projection"

    def __check_init__(self) -> None:
        check_name(self.state, _STATES, f"unknown state form `{self.state}`")
        stabilisation = self.stabilisation
        if not (
            stabilisation is None
            or isinstance(stabilisation, Baumgarte)
            or (isinstance(stabilisation, str) and stabilisation == "projection")
        ):
            raise ValueError(
                f'`stabilisation` is {described(stabilisation)}, expected "projection", '
                "`jj.Baumgarte(alpha, beta)` or None"
            )

    @property
    def projects(self) -> bool:
        """Return whether the state is projected onto the constraints after each step."""
        return isinstance(self.stabilisation, str)

    @property
    def baumgarte(self) -> Baumgarte | None:
        """Return Baumgarte's terms, which are added to the constraints, or None."""
        return self.stabilisation if isinstance(self.stabilisation, Baumgarte) else None


_DEFAULT = Formulation()


def as_formulation(formulation) -> Formulation:
    """Return the formulation, or the default for None. Raises ValueError for anything else."""
    if formulation is None:
        return _DEFAULT
    check_kind(
        formulation, Formulation, "`formulation`", "`jj.Formulation(state, reduction, stabilisation)` or None"
    )
    return formulation


def reason_for_matrices(structure: Structure, constant: bool) -> str:
    """Return why a scene with a scalar program is integrated by dense matrices; empty if the program is used.
    `constant`: whether all inputs are constant.
    """
    if structure.rows_of_inputs and not constant:
        return "velocity constraints with inputs that change with time need dense matrices"
    return ""


class Integrated(eqx.Module):
    """Integrated state: coordinates, speeds (all or the independent ones), and integrated work (J)."""

    q: Float[Array, "coordinates *lanes"]
    v: Float[Array, "integrated_speeds *lanes"]
    work: PerLane | None

    @property
    def rows(self) -> Float[Array, "rows *lanes"]:
        """Return all values as one array."""
        return jnp.concatenate([self.q, self.v, *([] if self.work is None else [self.work[None]])])

    def with_rows(self, rows: Float[Array, "rows *lanes"]) -> "Integrated":
        """Return a state with the values `rows` and the same numbers of coordinates and speeds."""
        # the transpose of a split is one concatenation; slices would be padded and added
        sizes = len(self.q), len(self.v)
        q, v, *work = jax.lax.split(rows, (*sizes, *[1] * (len(rows) - sum(sizes))))
        return Integrated(q, v, work[0][0] if work else None)

    @staticmethod
    def of(rows: Float[Array, "rows *lanes"], form) -> "Integrated":
        """Return the state with the values `rows`. `form`: has the numbers of coordinates and speeds."""
        return Integrated(rows[: (n := form.coordinates)], rows[n : form.q_and_v], None).with_rows(rows)


class Watched(NamedTuple):
    """Rates and monitored quantities: pivots, which must keep their signs; directions of constraints that are
    nonlinear in the speeds, which must not reverse; and a sine that is small near a loss of rank.
    """

    rates: Integrated
    pivots: Float[Array, "pivots *lanes"]
    directions: Float[Array, "rows speeds *lanes"]
    # smallest sine of the angle between a constraint and the earlier ones; None if constraints are
    # eliminated, or if there are none
    sine: PerLane | None = None


class Instant(NamedTuple):
    """Arguments of a vector field."""

    scene: Scene
    fixed: tuple  # part of the rates that depends on parameters only, computed once per motion
    t: PerLane  # s
    y: Integrated
    inputs: Any  # values at this time; for `rates` and `rates_and_pivots` the result of `now`

    @property
    def of_program(self) -> tuple[tuple, Any, Any, Any, Any]:
        """Return the arguments of a scalar program."""
        return self.fixed, self.t, self.y.q, self.y.v, self.inputs


class VectorField(eqx.Module):
    """Interface of the integrated state of a scene: packing, unpacking, rates and projection. All fields are
    static, except the arrays of the reduction.
    """

    independent: Indices | None = static()  # indices of the independent speeds; None: the full state
    reduction: Reduction | GibbsAppell
    with_work: bool = static()
    conserves: bool = static()  # T + V is constant along every motion
    projects_positions: bool = static()
    projects_speeds: bool = static()
    # whether constraints that the start satisfies may contradict each other later (`motion/integration.py`)
    rows_may_contradict: bool = static()
    of_inputs: Indices = static()  # indices of loads whose potential depends on inputs
    event_names: Labels = static()  # sorted
    stops: tuple[bool, ...] = static()  # whether each event ends the motion

    @property
    def name(self) -> str:
        """Return "minimal" or "full"."""
        return "full" if self.independent is None else "minimal"

    @property
    def reduction_name(self) -> str:
        """Return the name of the reduction, as shown in a trajectory."""
        return getattr(self.reduction, "name", "")

    @property
    def lowered(self) -> Lowered | None:
        """Return the scalar program of the rates; None: dense matrices."""
        return None

    @property
    def lowers_events(self) -> bool:
        """Return whether events are part of the scalar program."""
        return False

    @property
    def projects(self) -> bool:
        """Return whether steps project the state onto constraints."""
        return self.projects_positions or self.projects_speeds

    @property
    def needs_pivot(self) -> bool:
        """Return whether a motion ends when a pivot is small or changes its sign. With the full state by
        dense matrices it continues, with a warning.
        """
        return True

    @property
    @abc.abstractmethod
    def has_pivots(self) -> bool:
        """Return whether pivots are monitored. A step in which a pivot changes its sign is repeated, because
        the speeds or a constraint become undetermined within it.
        """

    @property
    def near_rank_loss(self) -> bool:
        """Return whether `rates_and_pivots` also computes how close the constraints are to a loss of rank."""
        return False

    def fixed(self, *scenes: Scene) -> tuple:
        """Return what depends on parameters only, computed once per motion (`Beside.fixed_values`)."""
        return ()

    def now(self, inputs, t):
        """Return the inputs at a time, in the form that the rates need."""
        return inputs(t)

    def pack(self, q, u) -> Integrated:
        """Return the integrated state of (q, u)."""
        every = np.arange(len(u)) if self.independent is None else np.array(self.independent, int)
        runs = np.split(every, np.flatnonzero(np.diff(every) != 1) + 1)
        v = jnp.concatenate([u[run[0] : run[-1] + 1] if run.size else u[:0] for run in runs])
        return Integrated(q, v, jnp.zeros((), q.dtype) if self.with_work else None)

    def stored(self, scene: Scene, t, q, inputs) -> Scalar:
        """Return the energy (J) stored in loads whose potential depends on inputs. The work done is the
        integrated work plus the change of this energy.
        """
        return stored_by_inputs(
            scene, motion_at(scene, t, q, jnp.zeros(len(scene.speed_names), q.dtype), inputs), self.of_inputs
        )

    @abc.abstractmethod
    def speeds(self, at: Instant) -> Speeds:
        """Return all speeds."""

    @abc.abstractmethod
    def speeds_and_pivot(self, at: Instant, plain: tuple) -> tuple[Speeds, Scalar | None]:
        """Return all speeds, and a pivot that measures how well the independent speeds determine the others.
        Where they cease to determine them, the pivot passes through zero and changes its sign.

        For the full state it is the pivot of the reduction, without a sign. It is None if no speed is
        eliminated. `plain`: `at.fixed` without derivatives; numbers that all lanes share have no batch axis.
        """

    def motion(self, at: Instant) -> Motion:
        """Return the motion with all speeds."""
        return motion_at(at.scene, at.t, at.y.q, self.speeds(at), at.inputs)

    def events(self, at: Instant) -> Float[Array, "events *lanes"]:
        """Return the values of the events, in the order of their names. Batches are supported only if
        `lowers_events`.
        """
        return event_values(at.scene, self.motion(at))

    def resets(self, at: Instant) -> Float[Array, "events rows *lanes"]:
        """Return `event_resets` for the integrated speeds. Batches are supported only if `lowers_events`."""
        found = event_resets(at.scene, self.motion(at), self.of_inputs)
        every = range(len(at.scene.speed_names))
        left_out = [
            len(at.y.q) + k for k in every if self.independent is not None and k not in self.independent
        ]
        return jnp.delete(found, np.array(left_out, int), axis=1)

    def at_start(self, scene: Scene, t, q, u, inputs) -> Float[Array, "numbers"]:
        """Return the switching contacts at the start (q, u) of a motion (`contacts_at_start`)."""
        return contacts_at_start(At(scene, motion_at(scene, t, q, u, inputs)))

    def energies(self, at: Instant) -> Float[Array, "2"]:
        """Return the kinetic and potential energy (J). They have no derivatives."""
        at = jax.lax.stop_gradient(at)
        return jnp.stack(energies_at(at.scene, self.motion(at)))

    def rates(self, at: Instant) -> Integrated:
        """Return the time derivative of the integrated state."""
        return self.rates_and_pivots(at).rates

    @abc.abstractmethod
    def rates_and_pivots(self, at: Instant) -> Watched:
        """Return the rates and the quantities monitored at all stages of a step."""

    @abc.abstractmethod
    def project(self, at: Instant) -> Integrated:
        """Return the state projected onto geometric constraints, quaternion norms, and, for the full state,
        velocity constraints.
        """


class ByProgram(VectorField):
    """Minimal or full state of a lowered scene."""

    program: Lowered = static()
    affine: bool = static()  # constraints are affine in the speeds
    native: value_kernels.Beside | None = static(default=None)

    @property
    def lowered(self) -> Lowered:
        """Return the scalar program."""
        return self.program

    @property
    def reduction_name(self) -> str:
        return f"{super().reduction_name}, lowered"

    @property
    def lowers_events(self) -> bool:
        return bool(self.program.events)

    @property
    def has_pivots(self) -> bool:
        """Return whether elimination or coordinate rates divide by numbers that must not vanish."""
        return self.pivots > 0 or bool(self.program.directions) or self.near_rank_loss

    @property
    def pivots(self) -> int:
        """Return the number of monitored pivots. With multipliers, only coordinate rates have pivots."""
        if self.independent is None and not self.program.by_partition:
            return self.program.divisors
        return len(self.program.pivots)

    @property
    def needs_pivot(self) -> bool:
        """Return whether a small pivot ends a motion. With multipliers it need not, because all speeds are
        integrated.
        """
        return self.independent is not None or self.program.by_partition

    @property
    def near_rank_loss(self) -> bool:
        """Return whether multipliers and projection enforce constraints."""
        return self.projects and bool(self.program.squares)

    def fixed(self, *scenes: Scene) -> tuple:
        return self.native.fixed_values(*scenes) if self.native else self.program.fixed_values(scenes[0])

    def speeds(self, at: Instant) -> Speeds:
        return self.program.all_speeds(*at.of_program)

    def speeds_and_pivot(self, at: Instant, plain: tuple) -> tuple[Speeds, Scalar | None]:
        if self.native:
            return self.native.speeds_and_pivot(plain, *at.of_program)
        return self.program.speeds_and_pivot(*at.of_program)

    def at_start(self, scene: Scene, t, q, u, inputs) -> Float[Array, "numbers"]:
        state = self.fixed(scene), t, q, u, inputs
        if self.native:
            return self.native.at_start(*state)
        return self.program.values(self.program.at_start, *state)

    def energies(self, at: Instant) -> Float[Array, "2"]:
        return self.program.energies_at(*at.of_program)

    def events(self, at: Instant) -> Float[Array, "events *lanes"]:
        if self.program.events:
            return self.program.values(self.program.events, *at.of_program)
        return super().events(at)

    def resets(self, at: Instant) -> Float[Array, "events rows *lanes"]:
        if self.program.events:
            found = self.program.values(self.program.resets, *at.of_program)
            return found.reshape(len(self.program.events), -1, *found.shape[1:])
        return super().resets(at)

    def rates_and_pivots(self, at: Instant) -> Watched:
        """Return the rates, the pivots of the elimination, and the directions of nonlinear constraints."""
        y = at.y
        qdot, vdot, power, pivots, directions, sine = self.program.rates_and_pivots(
            *at.of_program, self.with_work
        )
        pivots = pivots[: self.pivots]
        monitored = jnp.stack(pivots) if pivots else jnp.zeros((0, *y.q.shape[1:]))
        rows = (
            jnp.reshape(jnp.stack(directions), (-1, *y.v.shape)) if directions else jnp.zeros((0, *y.v.shape))
        )
        return Watched(
            Integrated(jnp.stack(qdot), jnp.stack(vdot) if vdot else y.v, power), monitored, rows, sine
        )

    def project(self, at: Instant) -> Integrated:
        """Return the state projected onto the constraints."""
        q, v = self.program.projected(*at.of_program, self.affine)
        return Integrated(jnp.stack(q), jnp.stack(v) if v else at.y.v, at.y.work)
