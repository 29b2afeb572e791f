"""Compute quantities along a motion: map functions of one state over all saved times."""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jourdain_jax.calculus.compilation import with_nan_as_a_mark, with_usual_promotion
from jourdain_jax.calculus.reals import (
    Count,
    PerCoordinate,
    PerTime,
    Scalar,
    Speeds,
    Vector3,
    at_index,
    is_traced,
    static,
)
from jourdain_jax.dynamics.accelerations import Accelerations, accelerations
from jourdain_jax.dynamics.reactions import ContactForce, contact_forces
from jourdain_jax.equations.kinematics import motion_at
from jourdain_jax.equations.projection import closure_residual
from jourdain_jax.equations.reductions import NullSpaceSVD
from jourdain_jax.equations.rows import UsualRows, velocity_residual
from jourdain_jax.equations.virtual_power import energies_at
from jourdain_jax.integrate.inputs import Inputs, for_programs
from jourdain_jax.program.eager import eval_numpy
from jourdain_jax.scene.coordinates import Labels
from jourdain_jax.scene.modes import Modes
from jourdain_jax.scene.printing import Printed
from jourdain_jax.scene.scene import Scene
from jourdain_jax.scene.user_methods import invariants_of
from jourdain_jax.structure.structure import structure_whatever_its_faults, usual_rows


class Phases(eqx.Module, Printed):
    """Phases of a motion, separated by the events after which it continues."""

    ts: Float[Array, "transitions"]  # s, of these events; NaN after the last one
    events: Int[Array, "transitions"]  # index into `event_names`; -1 after the last one
    modes: Float[Array, "modes phases"]  # index of each mode's value in each phase
    lost: Float[Array, "transitions"]  # J, loss of T + V at each event
    event_names: Labels = static()
    named: Modes = static()

    @property
    def count(self) -> Count:
        """Return the number of events that separate the phases."""
        return jnp.sum(jnp.isfinite(self.ts), axis=-1)

    def texts(self) -> list[str]:
        """Return one line per event: its time, its name, the modes it switched, and the energy it took."""
        ts, events, modes, lost = (np.asarray(x) for x in (self.ts, self.events, self.modes, self.lost))
        lines = []
        for k in range(int(self.count)):
            pairs = zip(self.named.pairs, modes[:, k], modes[:, k + 1], strict=True)
            switched = [f"{name}: {values[int(new)]}" for (name, values), old, new in pairs if new != old]
            took = [f"took {lost[k]:.4g} J"] if abs(lost[k]) > 1e-12 * np.max(np.abs(lost)) else []
            lines.append(", ".join([f"{ts[k]:.6g} s `{self.event_names[events[k]]}`", *switched, *took]))
        return lines

    def _text(self) -> str:
        if self.ts.ndim > 1:
            return f"Phases of a batch of shape {self.ts.shape[:-1]}"
        return "\n".join(["Phases, which end at", *(f"  {line}" for line in self.texts())])

    def lost_until(self, ts: Float[Array, "*lanes times"]) -> Float[Array, "*lanes times"]:
        """Return the loss of T + V (J) in all events up to each time `ts` (s)."""
        ahead = (self.ts[..., None, :] - ts[..., None]) * jnp.sign(ts[..., -1:] - ts[..., :1])[..., None]
        return jnp.sum(jnp.where(ahead <= 0, self.lost[..., None, :], 0.0), axis=-1)


def one_phase(event_names: Labels) -> Phases:
    """Return the phases of a motion that has a single phase and no modes."""
    none = jnp.zeros(0)
    return Phases(none, none.astype(jnp.int32), jnp.zeros((0, 1)), none, event_names, Modes())


class Record(eqx.Module):
    """Numbers of a motion; NaN at unreached times."""

    scene: Scene
    ts: PerTime  # s
    q: Float[Array, "times coordinates"]
    u: Float[Array, "times speeds"]
    # J, since the start; None if all forces have potentials and no constraint does work
    work: PerTime | None
    t_end: Scalar  # s
    q_end: PerCoordinate
    u_end: Speeds
    result: Count  # code, see `jourdain_jax.integrate.result_codes`
    event: Count  # index into `event_names`, -1: none
    accepted: Count  # steps
    rejected: Count
    last_step: Scalar  # s, proposed by step-size control for the next step; NaN if unknown
    # number of sign changes of relations (`<`, `abs`, ...) in loads, poses and constraints; -1: not monitored
    crossings: Count
    fallback: Count  # how the motion was retried, see `result_codes.FALLBACKS`; 0: not retried
    moved_q: Scalar  # change of the start by its projection
    moved_u: Scalar
    # smallest pivot along the motion, negative if it changed sign. With a scalar program: of the elimination,
    # relative to its typical size. With dense matrices: of the independent speeds; for the full state, of the
    # reduction (1 if it has none)
    smallest_pivot: Scalar
    inputs: Inputs
    phases: Phases
    state_form: str = static()  # "minimal" or "full"
    reduction: str = static()
    solver: str = static()
    projected: bool = static()
    unwatched: str = static()  # why relations are not monitored; empty if they are, or if there are none
    event_names: Labels = static()


def first_scene(record: Record) -> Scene:
    """Return the scene of a motion, or of the first sample of a batch of motions."""
    return at_index(record.scene, (0,) * (record.q.ndim - 2))


def map_with_accelerations(f: Callable, record: Record):
    """Evaluate `f(scene, t, q, u, accelerations, inputs)` at all times, as `map_over_times` does."""
    usual = usual_rows(first_scene(record), varied=record.q.ndim > 2)
    return map_over_times(_OfAccelerations(f, jax.tree.map(jnp.asarray, usual)), record, by_inputs=True)


@with_usual_promotion
def map_over_times(f, record: Record, by_inputs: bool = False):
    """Evaluate `f(scene, t, q, u, inputs)` at all times; NaN at unreached times. `f` must be a named function
    or a module, because it is a cache key.

    `by_inputs`: f needs the rates of inputs if constraints depend on varying inputs. For a batch of motions,
    the batch axes come first.
    """
    # accelerations then depend on the rates of the inputs
    by_inputs = (
        by_inputs
        and not record.inputs.constant
        and structure_whatever_its_faults(first_scene(record)).rows_of_inputs
    )
    known = not is_traced((f, record))
    # for one concrete motion, NumPy takes less time than compilation (contact forces of a bicycle at 101
    # times: 1 s instead of 7)
    if known and record.q.ndim == 2 and len(record.ts) <= 1000:
        return _on_numpy(f, record, by_inputs)
    mapped = _compiled(record.inputs.programs)
    # if all times were reached, NaN is not a marker
    whole = jax.config.jax_debug_nans and known and bool(jnp.all(jnp.isfinite(record.q)))
    return (mapped if whole else with_nan_as_a_mark(mapped))(f, record, by_inputs)


def _mapped(f, record: Record, by_inputs: bool):
    if record.q.ndim > 2:
        return eqx.filter_vmap(lambda record: _mapped(f, record, by_inputs))(record)

    one = partial(_at_one_time, f, record, by_inputs)
    count, most = len(record.ts), _largest_block(record)
    if count <= most:
        return jax.vmap(one)(record.ts, record.q, record.u)
    # a divisor, because a remainder would be compiled separately
    block = next(k for k in range(most, 0, -1) if count % k == 0)
    return jax.lax.map(lambda state: one(*state), (record.ts, record.q, record.u), batch_size=block)


_compiled = for_programs(_mapped)


def _at_one_time(f, record: Record, by_inputs: bool, t, q, u):
    """Return `f` at one state. At an unreached time, evaluate f at the end state and replace its result by
    NaN.
    """
    reached = jnp.all(jnp.isfinite(q))
    t, q, u = (jnp.where(reached, a, b) for a, b in ((t, record.t_end), (q, record.q_end), (u, record.u_end)))
    values = f(record.scene, t, q, u, record.inputs.near(t) if by_inputs else record.inputs(t))
    return jax.tree.map(lambda x: jnp.where(reached, x, jnp.nan) if eqx.is_inexact_array(x) else x, values)


def _largest_block(record: Record) -> int:
    """Return the number of times at which quantities are computed together."""
    # limit on the entries of all (coordinates x coordinates) matrices: for 200 trailers at 201 times,
    # derivatives of all poses took more than 23 GB
    return max(1, 4_000_000 // record.q.shape[-1] ** 2)


@with_nan_as_a_mark
def _on_numpy(f, record: Record, by_inputs: bool):
    by_time, size = (record.ts, record.q, record.u), _largest_block(record)
    blocks = [
        _uncompiled(f, record, by_inputs, lanes=[x[k : k + size] for x in by_time])
        for k in range(0, len(record.ts), size)
    ]
    return jax.tree.map(lambda *parts: jax.device_put(np.concatenate(parts)), *blocks)


_uncompiled = eval_numpy(_at_one_time)


class BodyPoint(eqx.Module):
    """Position (m, inertial frame) of the point of a body with body-frame coordinates `local` (m, from the
    mass centre).
    """

    body: str = static()
    local: Vector3

    def __call__(self, scene, t, q, u, inputs):
        return motion_at(scene, t, q, u, inputs)[self.body].place(self.local)


def energies(scene, t, q, u, inputs):
    """Return the kinetic and potential energy, J."""
    return energies_at(scene, motion_at(scene, t, q, u, inputs))


class InputOf(eqx.Module):
    """Value of the input `name`."""

    name: str = static()

    def __call__(self, scene, t, q, u, inputs) -> Scalar:
        return inputs[scene.inputs.entries.index(self.name)]


class _OfAccelerations(eqx.Module):
    """A quantity that depends on accelerations; `usual`: typical constraint rows."""

    f: Callable = static()
    usual: UsualRows

    def __call__(self, scene, t, q, u, inputs):
        found = accelerations(scene, t, q, u, inputs, reduction=NullSpaceSVD(), usual=self.usual)
        return self.f(scene, t, q, u, found, inputs)


def themselves(scene, t, q, u, found: Accelerations, inputs) -> Accelerations:
    """Return accelerations, multipliers, rank and smallest singular value."""
    return found


def residuals(scene, t, q, u, inputs):
    """Return residuals of the geometric constraints and quaternion norms, and of the velocity constraints."""
    return closure_residual(scene, t, q), velocity_residual(scene, t, q, u, inputs)


def invariants(scene, t, q, u, inputs):
    """Return the quantities that the scene declares conserved."""
    return invariants_of(scene, motion_at(scene, t, q, u, inputs))


class Checked(NamedTuple):
    """Diagnostic quantities along a motion."""

    energies: tuple[Array, Array]  # kinetic and potential
    residuals: tuple[Array, Array]  # of the geometric and of the velocity constraints
    invariants: dict[str, Array]
    rank: Array
    smallest_singular_value: Array
    contacts: dict[str, ContactForce]


def checked(scene, t, q, u, found: Accelerations, inputs) -> Checked:
    """Return diagnostic quantities at one state."""
    T, g, constant = (f(scene, t, q, u, inputs) for f in (energies, residuals, invariants))
    forces = contact_forces(scene, t, q, u, found, inputs)
    return Checked(T, g, constant, found.rank, found.smallest_singular_value, forces)
