"""Diagnostics of a motion: drifts, residuals, conditioning, contact forces, and a printed summary."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jourdain_jax.calculus.compilation import with_nan_as_a_mark
from jourdain_jax.calculus.reals import Count, Scalar, eps_of, largest, passing_cutoff, static
from jourdain_jax.dynamics.reactions import ContactForce, needs_work
from jourdain_jax.integrate.inputs import Constant, Mode, Sampled
from jourdain_jax.integrate.result_codes import FALLBACKS, SINGULAR_PARTITION
from jourdain_jax.integrate.vector_fields.field import reason_for_matrices
from jourdain_jax.motion.trajectories.values_in_time import Checked, Record, checked, map_with_accelerations
from jourdain_jax.program.eager import eager_if_concrete
from jourdain_jax.structure.structure import structure_whatever_its_faults, usual_rows

OverTimes = Float[Array, "*lanes times"]


class Energies(eqx.Module):
    """Energies along a motion, in J. `balance` is constant for a correct motion."""

    kinetic: OverTimes
    potential: OverTimes
    work: OverTimes | None
    lost: OverTimes | None = None  # in all earlier events; None if no event can continue the motion

    @property
    @with_nan_as_a_mark
    def balance(self) -> OverTimes:
        """Return T + V - W + D. W is the work of forces without a potential and of constraints that do work;
        D is the energy lost in events.
        """
        return sum((x for x in (self.potential, self.lost) if x is not None), start=self.kinetic) - (
            0.0 if self.work is None else self.work
        )

    @property
    def kind(self) -> str:
        """Return a description of `balance`."""
        return (
            "T + V"
            + " less the work done" * (self.work is not None)
            + " plus losses in events" * (self.lost is not None)
        )


class Diagnostics(eqx.Module):
    """Extremes of diagnostic quantities along a motion."""

    energy_drift: Scalar  # J, max - min of T + V, less the work done if integrated
    energy_kind: str = static()
    # J, reference for the drift: largest kinetic energy plus max - min of the potential energy
    energy_size: Scalar
    position_residual: Scalar  # largest residual of the geometric constraints and quaternion norms
    velocity_residual: Scalar  # largest residual of the velocity constraints
    smallest_singular_value: Scalar  # of the scaled constraints, smallest along the motion
    rank: tuple[Count, Count]  # lowest and highest rank of the constraints
    invariant_drifts: dict[str, Scalar]
    contacts: dict[str, "ContactExtremes"]


class ContactExtremes(eqx.Module):
    """Extreme forces of a rolling contact."""

    lowest_normal: Scalar  # N; negative: the contact would have to pull
    highest_normal: Scalar  # N
    friction_needed: Scalar  # largest |tangential| / normal
    pulls: Array  # whether the contact would have to pull at any time, beyond round-off
    determined: Array  # whether the constraints always determine these forces
    normal_determined: Array  # whether the constraints always determine the normal force

    @property
    def honest(self) -> bool:
        """Return whether the contact never had to pull."""
        return not bool(self.pulls)


def diagnose(trajectory: Record) -> Diagnostics:
    """Return drifts, residuals, conditioning and extreme contact forces of one `trajectory`. For a batch use
    `jax.vmap`, or pass `rollout.lane(i)`.

    Unreached times are ignored. Raises ValueError if the argument is not a trajectory.
    """
    if not hasattr(trajectory, "scene"):
        raise ValueError(
            f"`diagnose` was given a {type(trajectory).__name__}, expected a `Trajectory`; for "
            "a rollout pass one lane: `rollout.lane(0)`"
        )
    return _diagnosed(trajectory, map_with_accelerations(checked, trajectory), _lacks_work(trajectory))


DRIFTED = 1e-2  # numerics: of the varying energy


@eager_if_concrete
def _diagnosed(trajectory: Record, found: Checked, lacks_work: bool) -> Diagnostics:
    energy = Energies(*found.energies, trajectory.work, lost_of(trajectory))
    geometric, rows = found.residuals
    reached = jnp.all(jnp.isfinite(trajectory.q), axis=-1)
    return Diagnostics(
        energy_drift=_span(energy.balance),
        energy_kind=energy.kind + (", changed by work that was not integrated" if lacks_work else ""),
        # plus a small share of the whole energy: no drift is reported if energies vary less, as at rest
        energy_size=jnp.nanmax(energy.kinetic)
        + _span(energy.potential)
        + 1e-6 * jnp.nanmax(jnp.abs(energy.balance)),
        position_residual=_largest(geometric),
        velocity_residual=_largest(rows),
        smallest_singular_value=jnp.nanmin(jnp.where(reached, found.smallest_singular_value, jnp.nan)),
        rank=(jnp.min(found.rank), jnp.max(found.rank)),
        invariant_drifts={name: _span(values) for name, values in found.invariants.items()},
        contacts={name: _extremes(force) for name, force in found.contacts.items()},
    )


def lost_of(trajectory: Record) -> OverTimes | None:
    """Return the energy lost in events up to each saved time (J); None if no event continues the motion."""
    return trajectory.phases.lost_until(trajectory.ts) if trajectory.phases.ts.shape[-1] else None


def _lacks_work(trajectory: Record) -> bool:
    """Return whether work was done but not integrated, so that T + V is not constant."""
    return trajectory.work is None and needs_work(
        trajectory.scene, structure_whatever_its_faults(trajectory.scene)
    )


def _extremes(force: ContactForce) -> ContactExtremes:
    friction = jnp.where(jnp.isnan(force.normal), 0.0, force.friction_needed)
    known = jnp.all(force.determined), jnp.all(force.normal_determined)
    return ContactExtremes(
        jnp.nanmin(force.normal), jnp.nanmax(force.normal), jnp.max(friction), jnp.any(force.pulls), *known
    )


def _span(values) -> Scalar:
    return jnp.nanmax(values) - jnp.nanmin(values)


def _largest(values) -> Scalar:
    return jnp.max(jnp.where(jnp.isnan(values), 0.0, jnp.abs(values)), initial=0.0)


def warnings_of(found: Diagnostics, trajectory: Record) -> tuple[str, ...]:
    """Return warnings from the diagnostics of a motion."""
    low, high = (int(rank) for rank in found.rank)
    smallest, usual = float(found.smallest_singular_value), int(usual_rows(trajectory.scene).rank)
    warned = []
    if low != high:
        warned.append(
            f"the rank of the constraints changes along the motion, {low} to {high}: constraint "
            "forces and the motion afterwards may not be unique"
        )
    elif high < usual:
        warned.append(
            f"constraints have rank {high} on the whole motion, but {usual} at generic states: a singular "
            "configuration or another assembly; declare a `domain` around the motion to find out"
        )
    elif smallest < np.sqrt(eps_of(trajectory.q)):
        warned.append(f"constraints nearly lose rank (singular value {smallest:.1e}): digits are lost there")
    for kind, residual, state in (
        ("geometric", found.position_residual, trajectory.q),
        ("velocity", found.velocity_residual, trajectory.u),
    ):
        # residual of a constraint, relative to the state
        if float(residual) > 1e-4 * (1.0 + float(_largest(state))):
            warned.append(
                f"{kind} constraints are violated by up to {float(residual):.1e}: use projection or smaller "
                "tolerances, or check for constraints that contradict each other"
            )
    drift, size = float(found.energy_drift), float(found.energy_size)
    if drift > DRIFTED * size and not _lacks_work(trajectory):
        share = f"{drift:.1e} J, {drift / size:.0%} of the varying energy"
        warned.append(
            f"{found.energy_kind}, which should be constant, drifts by {share}: tighten `rtol`, or check "
            "potentials and constraints with `verify`"
        )
    pivot, dense = float(trajectory.smallest_pivot), "lowered" not in trajectory.reduction
    # the error of an acceleration is round-off divided by the square of the pivot; motions with a minimal
    # state or a scalar program end with a result code instead
    if trajectory.state_form == "full" and dense and pivot < passing_cutoff(trajectory.q.dtype):
        warned.append(
            f"the independent speeds of the reduction hardly determine the others (pivot {pivot:.1e}), "
            f"so no digit of the accelerations is reliable in {trajectory.q.dtype}; use the "
            "default `reduction` or float64"
        )
    ts, steps = np.asarray(trajectory.ts), max(int(trajectory.accepted), 1)
    resolved, step = float(np.spacing(largest(ts))), abs(float(trajectory.t_end) - float(ts[0])) / steps
    by_clock = not trajectory.inputs.constant or bool(structure_whatever_its_faults(trajectory.scene).timed)
    # rounding of times matters if it exceeds this part of a step
    if by_clock and resolved > 1e-3 * step > 0:
        warned.append(
            f"times are resolved to {resolved:.0e} s, but steps are {step:.0e} s: loads, poses and inputs "
            "receive rounded times; count time from zero, or use float64"
        )
    pulled = [name for name, contact in found.contacts.items() if not contact.honest]
    return (*warned, *(f"contact `{name}` would have to pull; a real one lifts off" for name in pulled))


def summary(trajectory: Record, message: str) -> str:
    """Return the summary that `print` shows: result, steps, drift, residuals, contacts, warnings."""
    found = diagnose(trajectory)
    ts = np.asarray(trajectory.ts)
    reached = int(np.sum(np.isfinite(np.asarray(trajectory.q)).all(axis=-1)))
    saved, several = f"{reached} of {len(ts)} times saved", reached > 1
    pivot = (
        ""
        if trajectory.state_form == "full"
        else f"; pivot of the independent speeds at least {float(trajectory.smallest_pivot):.1e}"
    )
    dense = reason_for_matrices(structure_whatever_its_faults(trajectory.scene), trajectory.inputs.constant)
    low, high = (int(r) for r in found.rank)
    moved, left = (float(trajectory.moved_q), float(trajectory.moved_u)), _left_domain(trajectory)
    lost = left if int(trajectory.result) == SINGULAR_PARTITION else ""
    inputs = [
        f"{name} {_channel_text(channel)}"
        for name, channel in zip(trajectory.scene.inputs, trajectory.inputs.channels, strict=True)
    ]
    rows = [
        ("motion", f"until t = {float(trajectory.t_end):.6g} s, {saved}; {message}{lost}"),
        (
            "solver",
            (
                f"{trajectory.solver}, {int(trajectory.accepted)} steps accepted, {int(trajectory.rejected)}"
                " rejected"
            ),
        ),
        (
            "run again",
            (
                FALLBACKS[int(trajectory.fallback)].removeprefix("run again ") + left
                if int(trajectory.fallback)
                else ""
            ),
        ),
        (
            "state",
            f"{trajectory.state_form}, reduction: {trajectory.reduction}"
            + (", projected after each step" if trajectory.projected else "")
            + pivot,
        ),
        ("dense", dense),
        ("relations", f"{int(trajectory.crossings)} crossings" if int(trajectory.crossings) > 0 else ""),
        ("relations", f"not monitored: {trajectory.unwatched}" if trajectory.unwatched else ""),
        ("phases", _phases_text(trajectory) if trajectory.phases.ts.size else ""),
        (
            "energy",
            (
                f"drift {float(found.energy_drift):.2e} J of {found.energy_kind}"
                if several
                else "no drift from one saved time"
            ),
        ),
        (
            "residuals",
            f"position {float(found.position_residual):.1e}, velocity {float(found.velocity_residual):.1e}",
        ),
        (
            "rows",
            (
                f"rank {low if low == high else f'{low} to {high}'}, smallest singular value"
                f" {float(found.smallest_singular_value):.2e}"
            ),
        ),
        (
            "start",
            (
                f"projected onto the constraints: coordinates changed by {moved[0]:.1e}, speeds by "
                f"{moved[1]:.1e}; named values are kept"
            ),
        ),
        ("inputs", ", ".join(inputs)),
    ]
    rows += [
        (f"invariant {name}", f"drift {float(drift):.2e}")
        for name, drift in found.invariant_drifts.items()
        if several
    ]
    rows += [(f"contact {name}", _contact_text(contact)) for name, contact in found.contacts.items()]
    rows += [("warning", text) for text in warnings_of(found, trajectory) if not text.startswith("contact")]
    width = max(len(name) for name, text in rows if text)
    return "\n".join(
        [
            f"Trajectory of {type(trajectory.scene).__name__}",
            *(f"  {name:<{width}}  {text}" for name, text in rows if text),
        ]
    )


def _phases_text(trajectory: Record) -> str:
    """Return a text on the first six events after which a motion continued, and the number of others."""
    lines = trajectory.phases.texts()
    return ("; ".join(lines[:6]) or "no event") + f"; and {len(lines) - 6} more" * (len(lines) > 6)


def _left_domain(trajectory: Record) -> str:
    """Return a text on the coordinate or speed that first left the scene's `domain`, and when, or ""."""
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
    return (
        f"; `{name}` leaves its domain, {low:.4g} to {high:.4g}: {value:.4g} at t ="
        f" {float(trajectory.ts[i]):.4g} s"
    )


def _channel_text(channel) -> str:
    """Return a text on an input: its value or its kind."""
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
        return f"{text}; the constraints do not determine the tangential force (minimum norm)"
    hint = (
        ""
        if contact.honest
        else "; if this contact does not carry all bodies, name those it carries in `carried=`"
    )
    return f"{text}; the constraints do not determine it (minimum norm){hint}"
