"""Trajectories: motions over time, with access by name, diagnostics, and the small plots that notebooks
show.
"""

from collections.abc import Mapping
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jourdain_jax.calculus.compilation import nan_is_a_mark
from jourdain_jax.calculus.figures import MODEL, figure
from jourdain_jax.calculus.markers import nan_where
from jourdain_jax.calculus.reals import Vector, checked_real
from jourdain_jax.dynamics.accelerations import Accelerations
from jourdain_jax.dynamics.reactions import ContactForce, RowReactions, contact_forces, row_reactions
from jourdain_jax.equations.kinematics import motion_at
from jourdain_jax.equations.rows import names_of_bodies
from jourdain_jax.integrate import result_codes
from jourdain_jax.integrate.constraint_projection import known_faults_at
from jourdain_jax.integrate.inputs import inputs_at
from jourdain_jax.integrate.state import State
from jourdain_jax.lowering.sides import bent_load
from jourdain_jax.motion.start import consistent
from jourdain_jax.motion.trajectories import labels, values_in_time
from jourdain_jax.motion.trajectories.diagnostics import Energies, diagnose, lost_of, summary, warnings_of
from jourdain_jax.motion.trajectories.values_in_time import Record, map_over_times, map_with_accelerations
from jourdain_jax.scene.arguments import of_known_numbers
from jourdain_jax.scene.coordinates import (
    Labels,
    Sentences,
    UnknownNameError,
    check_name,
    nearest,
    parameter_faults,
)
from jourdain_jax.scene.motion_state import Motion
from jourdain_jax.scene.printing import Printed
from jourdain_jax.scene.scene import state_names


def sketch_of_lanes(record: Record) -> str:
    """Draw a batch of motions: the median, and bands that contain 50 % and 95 % of the samples still running.
    Return "" if samples have different saved times.
    """
    levels = 0.025, 0.25, 0.5, 0.75, 0.975  # the limits of two bands, with the median in the middle
    lanes = _spread(len(record.q), 1000)
    ts, q = np.asarray(record.ts[0]), np.asarray(record.q[lanes])
    if not np.all(np.asarray(record.ts) == ts):
        return ""
    reached = np.isfinite(q).all(axis=2).any(axis=0)
    found = np.full((len(levels), *q.shape[1:]), np.nan)
    chosen = np.flatnonzero(reached)[_spread(int(reached.sum()))]
    found[:, chosen] = np.nanquantile(q[:, chosen], levels, axis=0)
    return _drawn(record, ts, found)


def _spread(count: int, most: int = 120) -> np.ndarray:
    """Return at most `most` of the indices 0 to count - 1, evenly spaced."""
    return np.unique(np.linspace(0, max(count - 1, 0), min(most, count)).astype(int))


def _drawn(record: Record, ts: np.ndarray, levels: np.ndarray) -> str:
    """Draw each coordinate with its name and range, without unreached times. `levels` (levels, times,
    coordinates): the middle level is drawn as a line, the others as bands around it.
    """
    reached = np.flatnonzero(np.isfinite(levels).all(axis=(0, 2)))
    if reached.size < 2:
        return ""
    chosen, names = reached[_spread(reached.size)], record.scene.coordinate_names.entries
    half, shown = len(levels) // 2, min(len(names), 12)
    rows, columns = -(-shown // 4), min(shown, 4)

    def draw(whole) -> None:
        for k, name in enumerate(names[:shown]):
            axes, y = whole.add_subplot(rows, columns, k + 1), levels[:, chosen, k]
            for j in range(half):
                axes.fill_between(ts[chosen], y[j], y[-1 - j], color=MODEL, alpha=0.25, lw=0)
            axes.plot(ts[chosen], y[half], color=MODEL, lw=1.2)
            axes.set(
                title=f"{name}: {y.min():.3g} to {y.max():.3g}", xticks=[], yticks=[], xlim=(ts[0], ts[-1])
            )

    more = f"and {len(names) - shown} more" if len(names) > shown else ""
    return figure(draw, 190 * columns, 66 * rows, more)


class Trajectory(Record, Printed):
    """Motion over time. Values at times after an early end (event, failure) are NaN.

    `t_end`, `q_end`, `u_end` are the last state reached. If the motion failed, this is the state at the
    failure, with NaN derivatives. In a loss or other automatic computation, use `motion.nan_if_failed()` or
    check `motion.succeeded`.
    """

    def __getitem__(self, name: str) -> Float[Array, "times *shape"]:
        """Return the coordinate, speed, quaternion or angular velocity `name` at all times; `"t"` returns the
        times.
        """
        if name == "t":
            return self.ts
        for names, array in ((self.scene.coordinate_names, self.q), (self.scene.speed_names, self.u)):
            with nan_is_a_mark():
                if name in names.view(array):
                    return names.view(array)[name]
        if name in names_of_bodies(self.scene):
            raise UnknownNameError(
                f"`{name}` is a body of `{type(self.scene).__name__}`, not a coordinate or speed; "
                f'`motion.point("{name}")` is the path of its mass centre, `motion.motions()["{name}"]` its '
                "pose and velocities at all times"
            )
        valid = (*state_names(self.scene), "t")
        raise UnknownNameError(
            f"a trajectory of `{type(self.scene).__name__}` has no `{name}`; {nearest(name, valid)}"
        )

    def __contains__(self, name: str) -> bool:
        return name == "t" or name in self.scene.coordinate_names or name in self.scene.speed_names

    @property
    def succeeded(self) -> Bool[Array, "*lanes"]:
        """Return whether the motion reached the end of its span or an event. Works under jit and vmap."""
        return jnp.asarray(self.result) <= result_codes.EVENT

    @property
    def valid(self) -> Bool[Array, "*lanes times"]:
        """Return which times the motion reached."""
        return jnp.all(jnp.isfinite(self.q), axis=-1)

    @property
    def end(self) -> State:
        """Return the last state reached, projected onto the constraints; for a batch of motions, a batch of
        states. Another motion can start from it:

            motion = jj.simulate(scene, motion.end, t1=motion.t_end + 1.0)
        """
        if self.q_end.ndim > 1:
            return eqx.filter_vmap(lambda motion: motion.end)(self)
        return consistent(self.scene, self.t_end, self.q_end, self.u_end, inputs_at(self.inputs, self.t_end))

    def phase(self, mode: str) -> Float[Array, "*lanes times"]:
        """Return the index of the value of `mode` at all times; at an event that switches it, the index
        afterwards.
        """
        check_name(mode, self.scene.modes.names, f"`{type(self.scene).__name__}` has no mode `{mode}`")
        return map_over_times(values_in_time.InputOf(mode), self)

    def motions(self) -> Motion:
        """Return poses and velocities (inertial frame) of all bodies at all times (leading axis: times)."""
        return map_over_times(motion_at, self)

    def point(self, body: str, local: Vector = (0.0, 0.0, 0.0)) -> Float[Array, "*lanes times 3"]:
        """Return the path (m, inertial frame) of the point of `body` with body-frame coordinates
        `local` (m, from the mass centre).
        """
        local = checked_real(
            local, f"point of body `{body}`", (3,), advice="pass three components in its body frame, m"
        )
        return map_over_times(values_in_time.BodyPoint(body, local.astype(self.q.dtype)), self)

    def energies(self) -> Energies:
        """Return the kinetic and potential energy and the integrated work over time, in J. Their `.balance`
        is constant for a correct motion.
        """
        kinetic, potential = map_over_times(values_in_time.energies, self)
        return Energies(kinetic, potential, self.work, lost_of(self))

    def accelerations(self) -> Accelerations:
        """Return accelerations, multipliers, rank and smallest singular value at all times."""
        return map_with_accelerations(values_in_time.themselves, self)

    def constraint_forces(self) -> RowReactions:
        """Return constraint forces per constraint and per body at all times, eqs. (68)-(70).

        `.forces_on("disc")` of the result gives the forces on a body by constraint (N, inertial frame).
        """
        return map_with_accelerations(row_reactions, self)

    def contact_forces(self) -> dict[str, ContactForce]:
        """Return the normal and tangential force (N) on the body and the friction coefficient needed, for
        each rolling contact at all times.
        """
        return map_with_accelerations(contact_forces, self)

    def residuals(self) -> tuple[Float[Array, "*lanes times closures"], Float[Array, "*lanes times rows"]]:
        """Return residuals of the geometric constraints (and quaternion norms), and of the
        velocity constraints, at all times.
        """
        return map_over_times(values_in_time.residuals, self)

    def invariants(self) -> dict[str, Float[Array, "*lanes times"]]:
        """Return the quantities that the scene declares conserved, by name at all times. Energy is not
        included.
        """
        return map_over_times(values_in_time.invariants, self)

    def to_xarray(self, units: Mapping[str, str] | None = None) -> Any:
        """Return coordinates, speeds, result code and parameters as an `xarray.Dataset` along `time` (s).

        `units`: units of coordinates and speeds by name, stored as `attrs["units"]`; a scene states only
        units of parameters. Raises ImportError without xarray.
        """
        return labels.to_xarray(self, units)

    def to_pandas(self) -> Any:
        """Return coordinates and speeds as a `pandas.DataFrame`, one row per time (s). Raises ImportError
        without pandas.
        """
        return labels.to_pandas(self)

    def _text(self) -> str:
        with nan_is_a_mark():
            return (
                summary(self, self.message)
                if self.q.ndim == 2
                else f"Trajectories of {type(self.scene).__name__}, lanes {self.q.shape[:-2]}"
            )

    def _picture(self) -> str:
        return "" if self.q.ndim > 2 else _drawn(self, np.asarray(self.ts), np.asarray(self.q)[None])

    @property
    @of_known_numbers
    def message(self) -> str:
        """Return a sentence on how the motion ended."""
        code = int(self.result)
        text = result_codes.MESSAGES[code]
        if code == result_codes.EVENT:
            return f"{text} `{self.event_names[int(self.event)]}`"
        named = f" ({', '.join(faults)})" if (faults := self.faults) else ""
        return text + named + "; check where it was computed" * (code == result_codes.BAD_PARAMETER)

    @property
    @of_known_numbers
    def warnings(self) -> Sentences:
        """Return reasons to doubt the motion, the most serious first; empty if there are none. The printed
        summary shows them.

        Reasons are, among others: a failure; constraints that change or nearly lose their rank, so that
        constraint forces may not be unique; a reduction whose independent speeds do not determine the others
        in this precision; contacts that would have to pull. They are computed on each access, from concrete
        numbers, so not under jit or vmap.
        """
        failure = () if int(self.result) <= result_codes.EVENT else (self.message,)
        return (*failure, *warnings_of(diagnose(self), self))

    @property
    def wrong_parameters(self) -> Labels:
        """Return the names of parameters that are not finite or have the wrong sign."""
        return tuple(name for name, wrong in parameter_faults(self.scene).items() if bool(wrong))

    @property
    def faults(self) -> Sentences:
        """Return the known causes of a failure, as texts for messages.

        For a bad parameter: parameters that are not finite or have the wrong sign, or else impossible values
        of bodies, contacts and gravity. If steps became short: a load that jumps or has a kink.
        """
        code, inputs = int(self.result), inputs_at(self.inputs, self.t_end)
        if code in (
            result_codes.STICKS,
            result_codes.MAX_STEPS,
            result_codes.SHRANK,
            result_codes.STEP_TOO_SMALL,
            result_codes.STIFF,
        ):
            load = bent_load(self.scene, self.t_end, self.q_end, self.u_end, inputs)
            said = (
                " jumps, or has a kink, at the last state; smooth it over a short range, as with `jnp.tanh`"
            )
            return (f"{load}{'' if code == result_codes.STICKS else said}",) if load else ()
        if code != result_codes.BAD_PARAMETER:
            return ()
        if self.wrong_parameters:
            return tuple(f"`{name}`" for name in self.wrong_parameters)
        q, u, _ = self.scene.named()
        return tuple(
            fault
            for fault, wrong in known_faults_at(self.scene, self.t_end, q, u, inputs).items()
            if bool(wrong)
        )

    def nan_if_failed(self) -> "Trajectory":
        """Return the trajectory; if it failed, with NaN states. Works under `jit`, `vmap` and `grad`, and for
        each sample of a batch.

            motion = lambda radius: jj.simulate(disc.replace(radius=radius), start, t1=2.0)
            loss = lambda radius: motion(radius).nan_if_failed().q_end[0]

        Derivatives of NaN states are NaN, too. Failed samples that `jnp.where(motion.succeeded, ..., 0.0)`
        excludes from a loss do not affect the derivatives of the loss.
        """
        states = lambda m: [x for x in (m.q, m.u, m.q_end, m.u_end, m.work) if x is not None]
        failed = lambda x: jnp.broadcast_to(
            jnp.expand_dims(~self.succeeded, tuple(range(jnp.ndim(self.result), x.ndim))), x.shape
        )
        return eqx.tree_at(states, self, [nan_where(failed(x), x) for x in states(self)])

    @of_known_numbers
    def raise_if_failed(self) -> "Trajectory":
        """Return the trajectory unchanged. Raise a SimulationError with the reason and the time if it failed,
        that is, reached neither its end nor an event.

        Raises DifferentiationModeError under `jit` and `vmap`, where numbers are unknown; use `nan_if_failed`
        there.
        """
        if int(self.result) > result_codes.EVENT:
            raise result_codes.SimulationError(
                f"`{type(self.scene).__name__}` at t = {float(self.t_end):.6g} s: {self.message}"
            )
        return self
