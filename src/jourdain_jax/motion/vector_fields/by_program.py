"""The rates of a lowered scene, by its scalar program; states may have a last axis of lanes."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jourdain_jax.lowering.lowered import Lowered
from jourdain_jax.motion.native import seen
from jourdain_jax.motion.vector_fields.field import Integrated, VectorField, Watched
from jourdain_jax.scene.scene import Scene


class ByProgram(VectorField):
    """The minimal or the full state of a lowered scene."""

    program: Lowered = eqx.field(static=True)
    affine: bool = eqx.field(static=True)  # rows are, in the speeds
    native: bool = eqx.field(static=True, default=False)  # machine code of our own works out what stands beside the steps

    @property
    def lowered(self) -> Lowered:
        """The scalar program."""
        return self.program

    @property
    def reduction_name(self) -> str:
        return f"{super().reduction_name}, lowered"

    @property
    def lowers_events(self) -> bool:
        return bool(self.program.events)

    @property
    def has_pivots(self) -> bool:
        """Whether an elimination, or the rates of the coordinates, divide by numbers that must not vanish."""
        return self.pivots > 0 or bool(self.program.directions) or self.near_rank_loss

    @property
    def pivots(self) -> int:
        """Return how many are monitored: all, or with multipliers only those of the coordinate rates."""
        return self.program.divisors if self.independent is None and not self.program.by_partition else len(self.program.pivots)

    @property
    def needs_pivot(self) -> bool:
        """Whether a small pivot ends a motion: with multipliers a state is all there."""
        return self.independent is not None or self.program.by_partition

    @property
    def near_rank_loss(self) -> bool:
        """Whether rows are kept by multipliers, and put back onto."""
        return self.projects and bool(self.program.squares)

    def fixed(self, scene: Scene) -> tuple:
        """What depends on parameters alone."""
        return seen.fixed_values(self.program, scene) if self.native else self.program.fixed_values(scene)

    def speeds(self, scene: Scene, fixed, t, y: Integrated, inputs) -> Float[Array, "speeds"]:
        return self.program.speeds_and_pivot(fixed, t, tuple(y.q), tuple(y.v), inputs)[0]

    def speeds_and_pivot(self, scene: Scene, fixed, t, y: Integrated, inputs) -> tuple[Float[Array, "speeds"], Float[Array, ""]]:
        """All speeds, and the smallest pivot of the elimination relative to its usual size."""
        if self.native:
            return seen.speeds_and_pivot(self.program, fixed, t, y.q, y.v, inputs)
        return self.program.speeds_and_pivot(fixed, t, tuple(y.q), tuple(y.v), inputs)

    def energies(self, scene: Scene, fixed, t, y: Integrated, inputs) -> Float[Array, "2"]:
        return self.program.energy_values(fixed, t, tuple(y.q), tuple(y.v), inputs)

    def events(self, scene: Scene, fixed, t, y: Integrated, inputs) -> Float[Array, "events *lanes"]:
        if self.program.events:
            return self.program.event_values(fixed, t, tuple(y.q), tuple(y.v), inputs)
        return super().events(scene, fixed, t, y, inputs)

    def rates_and_pivots(self, scene: Scene, fixed, t, y: Integrated, inputs) -> Watched:
        """Return `rates`, the pivots of the elimination relative to their usual sizes, and the eliminated rows."""
        qdot, vdot, power, pivots, directions, sine = self.program.rates_and_pivots(fixed, t, tuple(y.q), tuple(y.v), inputs, self.with_work)
        pivots = pivots[: self.pivots]
        monitored = jnp.stack(pivots) if pivots else jnp.zeros((0, *y.q.shape[1:]))
        rows = jnp.reshape(jnp.stack(directions), (-1, *y.v.shape)) if directions else jnp.zeros((0, *y.v.shape))
        return Watched(Integrated(jnp.stack(qdot), jnp.stack(vdot) if vdot else y.v, power), monitored, rows, sine)

    def project(self, scene: Scene, fixed, t, y: Integrated, inputs) -> Integrated:
        """The state put back onto the rows."""
        q, v = self.program.projected(fixed, t, tuple(y.q), tuple(y.v), inputs, self.affine)
        return Integrated(jnp.stack(q), jnp.stack(v) if v else y.v, y.work)
