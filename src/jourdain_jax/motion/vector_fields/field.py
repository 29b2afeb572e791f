"""The state that is integrated, and what every form of its rates can do.

    minimal: qdot = N u + nu,  u = C y + c,  ydot = privileged rows of udot     (velocity rows hold exactly)
    full:    qdot = N u + nu,  udot                                               (kept on the rows by projection)

Where some force or row does work that no potential accounts for, that work is integrated beside the state.
"""

import abc
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jourdain_jax.build.explicit_power import stored_by_inputs
from jourdain_jax.build.trace import event_values
from jourdain_jax.equations.gibbs_appell import GibbsAppell
from jourdain_jax.equations.kinematics import motion_at
from jourdain_jax.equations.reductions import Reduction
from jourdain_jax.equations.virtual_power import energies_at
from jourdain_jax.lowering.lowered import Lowered
from jourdain_jax.scene.scene import Scene


class Integrated(eqx.Module):
    """The integrated state: coordinates, speeds (all, or the privileged ones), work done so far (J) where it is tracked."""

    q: Float[Array, "coordinates *lanes"]
    v: Float[Array, "integrated_speeds *lanes"]
    work: Float[Array, "*lanes"] | None


class Watched(NamedTuple):
    """Rates; pivots that must keep their signs; directions of rows nonlinear in the speeds, which must not turn round; a sine, small near a loss of rank."""

    rates: Integrated
    pivots: Float[Array, "pivots *lanes"]
    directions: Float[Array, "rows speeds *lanes"]
    sine: Float[Array, "*lanes"] | None = None  # the smallest between a row and those before it; None: rows that are solved for speeds, or none


class VectorField(eqx.Module):
    """How a scene's state is packed, unpacked, differentiated in time and projected. All choices are static.

    `fixed`: what the rates need of the scene and computed once per motion; `inputs`: their values at the time, for `rates` and `rates_and_pivots` from `now`.
    """

    independent: tuple[int, ...] | None = eqx.field(static=True)  # privileged speeds; None: the full state
    reduction: Reduction | GibbsAppell
    with_work: bool = eqx.field(static=True)
    conserves: bool = eqx.field(static=True)  # T + V is constant along every motion
    projects_positions: bool = eqx.field(static=True)
    projects_speeds: bool = eqx.field(static=True)
    rows_may_contradict: bool = eqx.field(static=True)  # each other, although the start meets all (`motion/row_check.py`)
    of_inputs: tuple[int, ...] = eqx.field(static=True)  # numbers of the loads whose potential depends on inputs
    event_names: tuple[str, ...] = eqx.field(static=True)  # sorted

    @property
    def name(self) -> str:
        """ "minimal" or "full"."""
        return "full" if self.independent is None else "minimal"

    @property
    def reduction_name(self) -> str:
        """Name of the reduction, as it stands in a trajectory."""
        return getattr(self.reduction, "name", "")

    @property
    def lowered(self) -> Lowered | None:
        """The scalar program of the rates; None: dense matrices."""
        return None

    @property
    def lowers_events(self) -> bool:
        """Whether stop events are part of the scalar program."""
        return False

    @property
    def projects(self) -> bool:
        """Whether a step puts the state back onto rows."""
        return self.projects_positions or self.projects_speeds

    @property
    def needs_pivot(self) -> bool:
        """Whether a small pivot, or one that changes sign, ends a motion: a state that is all there goes on, with a warning."""
        return True

    @property
    @abc.abstractmethod
    def has_pivots(self) -> bool:
        """Whether steps in which some pivot changes its sign are tried again: in them the state, or a row that it is kept on, is lost."""

    @property
    def near_rank_loss(self) -> bool:
        """Whether `rates_and_pivots` says how far the rows, onto which steps are put back, are from losing rank."""
        return False

    def fixed(self, scene: Scene) -> tuple:
        """What the rates need of the scene: computed once per motion."""
        return ()

    def now(self, inputs, t):
        """What the rates need of the inputs at a time."""
        return inputs(t)

    def pack(self, q, u) -> Integrated:
        """The integrated state of (q, u)."""
        v = u if self.independent is None else u[jnp.array(self.independent, jnp.int32)]
        return Integrated(q, v, jnp.zeros((), q.dtype) if self.with_work else None)

    def stored(self, scene: Scene, t, q, inputs) -> Float[Array, ""]:
        """What loads whose potential depends on inputs store, J: with its change, the integrated work is the work done."""
        if not (self.with_work and self.of_inputs):
            return jnp.zeros((), q.dtype)
        return stored_by_inputs(scene, motion_at(scene, t, q, jnp.zeros(len(scene.speed_names), q.dtype), inputs), self.of_inputs)

    @abc.abstractmethod
    def speeds(self, scene: Scene, fixed, t, y: Integrated, inputs) -> Float[Array, "speeds"]:
        """All speeds."""

    @abc.abstractmethod
    def speeds_and_pivot(self, scene: Scene, fixed, t, y: Integrated, inputs) -> tuple[Float[Array, "speeds"], Float[Array, ""]]:
        """All speeds, and how well the privileged ones determine the others, with a sign that changes where they do not.

        For the full state the second is that of its reduction, without a sign, and 1 where it has none.
        """

    def events(self, scene: Scene, fixed, t, y: Integrated, inputs) -> Float[Array, "events *lanes"]:
        """Values of the stop events, in the order of their names; lanes only where `lowers_events`."""
        return event_values(scene, motion_at(scene, t, y.q, self.speeds(scene, fixed, t, y, inputs), inputs))

    def energies(self, scene: Scene, fixed, t, y: Integrated, inputs) -> Float[Array, "2"]:
        """Kinetic and potential energy, J; numbers to differentiation."""
        scene, fixed, t, y, inputs = jax.lax.stop_gradient((scene, fixed, t, y, inputs))
        return jnp.stack(energies_at(scene, motion_at(scene, t, y.q, self.speeds(scene, fixed, t, y, inputs), inputs)))

    def rates(self, scene: Scene, fixed, t, y: Integrated, inputs) -> Integrated:
        """Time derivative of the integrated state."""
        return self.rates_and_pivots(scene, fixed, t, y, inputs).rates

    @abc.abstractmethod
    def rates_and_pivots(self, scene: Scene, fixed, t, y: Integrated, inputs) -> Watched:
        """Return `rates` with what is watched at all stages of a step."""

    @abc.abstractmethod
    def project(self, scene: Scene, fixed, t, y: Integrated, inputs) -> Integrated:
        """The state put back onto geometric rows, quaternion norms and (full state) velocity rows."""
