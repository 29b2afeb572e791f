"""Diagnostics of a motion: drifts, residuals, conditioning, contact forces, and their printed summary."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jourdain_jax.build.structure import structure_of, usual_rows
from jourdain_jax.calculus.reals import Count, Scalar, eps_of, largest, passing_cutoff, static, with_nan_as_a_mark
from jourdain_jax.dynamics.power import needs_work
from jourdain_jax.dynamics.reactions import ContactForce
from jourdain_jax.eager.eager import eager_if_concrete
from jourdain_jax.motion.inputs import Constant, Mode, Sampled
from jourdain_jax.motion.trajectories.over_times import Checked, Checks, Record, map_over_times
from jourdain_jax.motion.trajectories.results import FALLBACKS, SINGULAR_PARTITION
from jourdain_jax.motion.vector_fields.field import reason_for_matrices

OverTimes = Float[Array, "*lanes times"]


class Energies(eqx.Module):
    """Energies along a motion, in J. `balance`, which is T + V minus the work done (if that is integrated),
    is constant for a correct motion.
    """

    kinetic: OverTimes
    potential: OverTimes
    work: OverTimes | None
    lost: OverTimes | None = None  # by events until then; None where no event lets a motion continue

    @property
    @with_nan_as_a_mark
    def balance(self) -> OverTimes:
        """Return T - W + V + D: W is the work of forces without potential and of constraints that do work, D
        the energy lost in events.
        """
        return sum((x for x in (self.potential, self.lost) if x is not None), start=self.kinetic) - (0.0 if self.work is None else self.work)

    @property
    def kind(self) -> str:
        """Description of `balance`."""
        return "T + V" + " less the work done" * (self.work is not None) + " and what events took" * (self.lost is not None)


class Diagnostics(eqx.Module):
    """Extremes of diagnostic quantities along a motion."""

    energy_drift: Scalar  # J, max - min of T + V, less the work done where it is tracked
    energy_kind: str = static()
    energy_size: Scalar  # J, largest kinetic energy, and max - min of the potential one: what a drift is judged against
    position_residual: Scalar  # largest residual of the geometric rows and quaternion norms
    velocity_residual: Scalar  # largest residual of the velocity rows
    smallest_singular_value: Scalar  # of the scaled rows, smallest along the motion
    rank: tuple[Count, Count]  # lowest and highest rank of the rows
    invariant_drifts: dict[str, Scalar]
    contacts: dict[str, "ContactExtremes"]


class ContactExtremes(eqx.Module):
    """Extreme forces of a rolling contact."""

    lowest_normal: Scalar  # N; negative: it would have had to pull
    highest_normal: Scalar  # N
    friction_needed: Scalar  # largest |tangential| / normal
    pulls: Array  # whether it would have had to pull at any time, beyond round-off
    determined: Array  # whether the rows determine these forces all along
    normal_determined: Array  # whether they determine the normal force all along

    @property
    def honest(self) -> bool:
        """Whether the contact only ever pushed, or bore nothing."""
        return not bool(self.pulls)


def diagnose(trajectory: Record) -> Diagnostics:
    """Return drifts, residuals, conditioning and contact extremes of one `trajectory` (for a batch:
    `jax.vmap` or `rollout.lane(i)`).

    Times that were not reached do not count. Raises ValueError for anything but a trajectory.
    """
    if not hasattr(trajectory, "scene"):
        raise ValueError(f"`diagnose` was given a {type(trajectory).__name__}, expected a `Trajectory`; for "
            "a rollout give one lane: `rollout.lane(0)`")
    checks = Checks(jax.device_put(usual_rows(trajectory.scene)))
    return _diagnosed(trajectory, map_over_times(checks, trajectory, by_inputs=True), _lacks_work(trajectory))


DRIFTED = 1e-2  # of the energy that moves


@eager_if_concrete
def _diagnosed(trajectory: Record, found: Checked, lacks_work: bool) -> Diagnostics:
    energy = Energies(*found.energies, trajectory.work, lost_of(trajectory))
    geometric, rows = found.residuals
    reached = jnp.all(jnp.isfinite(trajectory.q), axis=-1)
    return Diagnostics(
        energy_drift=_span(energy.balance),
        energy_kind=energy.kind + (", changed by work that was not integrated" if lacks_work else ""),
        # of the whole energy: where less than that moves, as at rest, nothing is said of its drift
        energy_size=jnp.nanmax(energy.kinetic) + _span(energy.potential) + 1e-6 * jnp.nanmax(jnp.abs(energy.balance)),
        position_residual=_largest(geometric),
        velocity_residual=_largest(rows),
        smallest_singular_value=jnp.nanmin(jnp.where(reached, found.smallest_singular_value, jnp.nan)),
        rank=(jnp.min(found.rank), jnp.max(found.rank)),
        invariant_drifts={name: _span(values) for name, values in found.invariants.items()},
        contacts={name: _extremes(force) for name, force in found.contacts.items()},
    )


def lost_of(trajectory: Record) -> OverTimes | None:
    """Return the energy lost in events until each saved time, J; None without events at which the motion
    continues.
    """
    return trajectory.phases.lost_until(trajectory.ts) if trajectory.phases.ts.shape[-1] else None


def _lacks_work(trajectory: Record) -> bool:
    """Return whether work was done that was not integrated, so that T + V is not constant."""
    return trajectory.work is None and needs_work(trajectory.scene, structure_of(trajectory.scene))


def _extremes(force: ContactForce) -> ContactExtremes:
    friction = jnp.where(jnp.isnan(force.normal), 0.0, force.friction_needed)
    known = jnp.all(force.determined), jnp.all(force.normal_determined)
    return ContactExtremes(jnp.nanmin(force.normal), jnp.nanmax(force.normal), jnp.max(friction), jnp.any(force.pulls), *known)


def _span(values) -> Scalar:
    return jnp.nanmax(values) - jnp.nanmin(values)


def _largest(values) -> Scalar:
    return jnp.max(jnp.where(jnp.isnan(values), 0.0, jnp.abs(values)), initial=0.0)


def warnings_of(found: Diagnostics, trajectory: Record) -> tuple[str, ...]:
    """Return warnings from the diagnostics of a motion, in words."""
    low, high = (int(rank) for rank in found.rank)
    smallest, usual = float(found.smallest_singular_value), int(usual_rows(trajectory.scene).rank)
    warned = []
    if low != high:
        warned.append(f"rows change their rank along the motion, {low} to {high}: constraint forces and the "
            "motion beyond may not be unique")
    elif high < usual:
        warned.append(
            f"rows have rank {high} on the whole motion, but {usual} at generic states: a singular "
            "configuration, or another assembly of the scene; state a `domain` around the motion to decide"
        )
    elif smallest < np.sqrt(eps_of(trajectory.q)):
        warned.append(f"rows come within {smallest:.1e} of a loss of rank: digits are lost there")
    for kind, residual, state in (("geometric", found.position_residual, trajectory.q), ("velocity", found.velocity_residual, trajectory.u)):
        # residual of a row, relative to the state
        if float(residual) > 1e-4 * (1.0 + float(_largest(state))):
            warned.append(
                f"{kind} rows are violated by up to {float(residual):.1e}: take projection or smaller "
                "tolerances, or look for rows that contradict each other"
            )
    drift, size = float(found.energy_drift), float(found.energy_size)
    if drift > DRIFTED * size and not _lacks_work(trajectory):
        share = f"{drift:.1e} J, {drift / size:.0%} of the energy that moves"
        warned.append(
            f"{found.energy_kind}, which is constant for a right motion, drifts by {share}: tighten `rtol`, "
            "or let `verify` look at potentials and rows"
        )
    pivot, dense = float(trajectory.smallest_pivot), "lowered" not in trajectory.reduction
    # round-off over the square of the pivot is the error of an acceleration; other states than the full one end there
    if trajectory.state_form == "full" and dense and pivot < passing_cutoff(trajectory.q.dtype):
        warned.append(
            f"the privileged speeds of the reduction hardly determine the others, pivot {pivot:.1e}: no "
            f"digit of the accelerations is sure in {trajectory.q.dtype}; leave `reduction` at its default, "
            "or take float64"
        )
    ts, steps = np.asarray(trajectory.ts), max(int(trajectory.accepted), 1)
    resolved, step = float(np.spacing(largest(ts))), abs(float(trajectory.t_end) - float(ts[0])) / steps
    by_clock = not trajectory.inputs.constant or bool(structure_of(trajectory.scene).timed)
    # of a step: a clock that resolves less rounds times visibly
    if by_clock and resolved > 1e-3 * step > 0:
        warned.append(
            f"the clock resolves {resolved:.0e} s at these times, and steps are of {step:.0e} s: loads, "
            "poses and inputs that depend on time are given rounded times; count time from zero, or take "
            "float64"
        )
    pulled = [name for name, contact in found.contacts.items() if not contact.honest]
    return (*warned, *(f"contact `{name}` would have to pull: a real one lifts off" for name in pulled))


def summary(trajectory: Record, message: str) -> str:
    """Return a printed summary: steps, drift, residuals, contacts, result."""
    found = diagnose(trajectory)
    ts = np.asarray(trajectory.ts)
    reached = int(np.sum(np.isfinite(np.asarray(trajectory.q)).all(axis=-1)))
    saved, several = f"{reached} of {len(ts)} times saved", reached > 1
    pivot = "" if trajectory.state_form == "full" else f"; pivot of the privileged speeds at least {float(trajectory.smallest_pivot):.1e}"
    dense = reason_for_matrices(structure_of(trajectory.scene), trajectory.inputs.constant)
    low, high = (int(r) for r in found.rank)
    moved, left = (float(trajectory.moved_q), float(trajectory.moved_u)), _left_domain(trajectory)
    lost = left if int(trajectory.result) == SINGULAR_PARTITION else ""
    inputs = [f"{name} {_channel_text(channel)}" for name, channel in zip(trajectory.scene.inputs, trajectory.inputs.channels, strict=True)]
    rows = [
        ("motion", f"t {float(ts[0]):.6g} to {float(trajectory.t_end):.6g} s, {saved}; {message}{lost}"),
        ("solver", f"{trajectory.solver}, {int(trajectory.accepted)} steps accepted, {int(trajectory.rejected)} rejected"),
        ("run again", FALLBACKS[int(trajectory.fallback)].removeprefix("run again ") + left if int(trajectory.fallback) else ""),
        ("state", f"{trajectory.state_form}, reduction: {trajectory.reduction}" + (", projected after each step" if trajectory.projected else "") + pivot),
        ("dense", dense),
        ("relations", f"{int(trajectory.crossings)} crossings" if int(trajectory.crossings) > 0 else ""),
        ("relations", f"not watched: {trajectory.unwatched}" if trajectory.unwatched else ""),
        ("phases", _phases_text(trajectory) if trajectory.phases.ts.size else ""),
        ("energy", f"drift {float(found.energy_drift):.2e} J of {found.energy_kind}" if several else "drift is not seen: one time was saved"),
        ("residuals", f"position {float(found.position_residual):.1e}, velocity {float(found.velocity_residual):.1e}"),
        ("rows", f"rank {low if low == high else f'{low} to {high}'}, smallest singular value {float(found.smallest_singular_value):.2e}"),
        ("start", f"put onto the rows: coordinates changed by {moved[0]:.1e}, speeds by {moved[1]:.1e}; named values are kept"),
        ("inputs", ", ".join(inputs)),
    ]
    rows += [(f"invariant {name}", f"drift {float(drift):.2e}") for name, drift in found.invariant_drifts.items() if several]
    rows += [(f"contact {name}", _contact_text(contact)) for name, contact in found.contacts.items()]
    rows += [("warning", text) for text in warnings_of(found, trajectory) if not text.startswith("contact")]
    width = max(len(name) for name, text in rows if text)
    return "\n".join([f"Trajectory of {type(trajectory.scene).__name__}", *(f"  {name:<{width}}  {text}" for name, text in rows if text)])


def _phases_text(trajectory: Record) -> str:
    """Return the first events after which a motion continued."""
    lines = trajectory.phases.texts()
    return ("; ".join(lines[:6]) or "no event") + f"; and {len(lines) - 6} more" * (len(lines) > 6)


def _left_domain(trajectory: Record) -> str:
    """Return which coordinate or speed left the scene's `domain` first, and when."""
    scene, first = trajectory.scene, []
    for names, values in ((scene.coordinate_names, trajectory.q), (scene.speed_names, trajectory.u)):
        for k, name in enumerate(names.entries):
            if name in scene.domain:
                low, high = scene.domain[name]
                outside = np.flatnonzero((np.asarray(values)[:, k] < low) | (np.asarray(values)[:, k] > high))
                first += [(int(i), name, float(np.asarray(values)[i, k]), low, high) for i in outside[:1]]
    if not first:
        return ""
    i, name, value, low, high = min(first)
    return f"; `{name}` leaves its domain, {low:.4g} to {high:.4g}: {value:.4g} at t = {float(trajectory.ts[i]):.4g} s"


def _channel_text(channel) -> str:
    """Return the text of an input; missing ones are zero."""
    if isinstance(channel, Mode):
        return "a mode"
    if isinstance(channel, Constant):
        return f"= {float(channel.value):.6g}"
    return f"of {channel.ts.shape[0]} samples" if isinstance(channel, Sampled) else "a function of time"


def _contact_text(contact: ContactExtremes) -> str:
    text = f"normal force {float(contact.lowest_normal):.5g} to {float(contact.highest_normal):.5g} N"
    text += f", friction coefficient needed {float(contact.friction_needed):.3g}"
    if not contact.honest:
        text += "; WOULD HAVE TO PULL: a real contact lifts off"
    if bool(contact.determined):
        return text
    if bool(contact.normal_determined):
        return f"{text}; the tangential force is not determined by the rows (minimum norm)"
    hint = "" if contact.honest else "; if this contact does not hold up all bodies, name those that it does in `carried=`"
    return f"{text}; not determined by the rows (minimum norm){hint}"
