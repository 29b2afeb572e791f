"""Retry failed motions if `retry=True`, by one rule for single motions and batches.

    FULL_STATE    full state and dense matrices, if the independent speeds or the program became invalid
    IMPLICIT      Radau's method, if an explicit solver ran out of steps because stability limited them

Each change is made at most once, and changes add up: a stiff motion with invalid independent speeds finally
runs with the full state by Radau's method.

A decaying mode exp(-r t), however small, limits the step h of an explicit method: h r is at most about 3 for
Tsit5 and 6 for Dopri8. A motion that ran out of steps near this limit is stiff. The criterion here is
`h r >= 1`.
"""

from collections.abc import Callable
from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, Int

from jourdain_jax.calculus.reals import all_finite, at_index, known_numbers
from jourdain_jax.integrate import result_codes
from jourdain_jax.integrate.discrete_gradient import DiscreteGradient
from jourdain_jax.integrate.explicit_steps import DOPRI8, Taylor
from jourdain_jax.integrate.implicit_steps import RadauIIA
from jourdain_jax.integrate.setup import Setup
from jourdain_jax.integrate.vector_fields.field import Instant, VectorField, as_formulation
from jourdain_jax.motion.options import AllOptions
from jourdain_jax.motion.sensitivity import numbers_where_known
from jourdain_jax.motion.trajectories.trajectory import Trajectory

OUT_OF_STEPS = (result_codes.MAX_STEPS, result_codes.SHRANK)

# static fields of a trajectory that describe how a sample was retried
RERUN_FIELDS = ("state_form", "reduction", "solver", "projected", "unwatched")


def retried(
    run: Callable[[AllOptions], tuple[Setup, Trajectory]],
    setup: Setup,
    motion: Trajectory,
    options: AllOptions,
) -> Trajectory:
    """Retry a motion until it succeeds or no retry is left. Return it unchanged if its result is traced."""
    while retries := _next_retry(setup.field, motion, setup.t0, options):
        setup, motion = run(_with_retries(retries, options))
        motion = _marked(motion, retries)
    return motion


def lanes_retried(
    run: Callable[[AllOptions, np.ndarray], Trajectory],
    form: Callable[[AllOptions], VectorField],
    lanes: Trajectory,
    begun,
    options: AllOptions,
    chunk: int,
):
    """Retry failed samples by the rule for single motions. Return all samples, and the `RERUN_FIELDS` of each
    kind of retry.

    `run(options, indices)`: motions of these samples; `form(options)`: their vector field; `begun`: start
    times of all samples; `chunk`: as in `rollout`.
    """
    reruns: dict[int, tuple] = {}
    while (again := _next_retries(form, lanes, begun, options)).any():
        for way in np.unique(again[again > 0]).tolist():
            chosen, changed = np.flatnonzero(again == way), _with_retries(way, options)
            for first in range(0, len(chosen), chunk):
                # a power of two, so that only few sizes are compiled
                size = min(chunk, max(8, 1 << (len(chosen) - 1).bit_length()))
                index = chosen[np.minimum(np.arange(first, first + size), len(chosen) - 1)]
                new = run(changed, index)
                lanes = _replaced(lanes, _marked(new, way), index)
                reruns[way] = tuple(getattr(new, name) for name in RERUN_FIELDS)
    return lanes, tuple(sorted(reruns.items()))


def _next_retries(
    form: Callable[[AllOptions], VectorField], lanes: Trajectory, begun, options: AllOptions
) -> Int[np.ndarray, "lanes"]:
    """Return the next retry of each sample, including all changes already made; AS_ASKED: none."""
    begun = np.broadcast_to(np.asarray(begun), lanes.result.shape)
    found = np.full(lanes.result.shape, result_codes.AS_ASKED)
    codes = np.asarray(lanes.result)
    fallback = np.asarray(lanes.fallback)
    for tried in np.unique(fallback).tolist():
        field = form(_with_retries(tried, options))
        again = np.flatnonzero((fallback == tried) & np.isin(codes, (*lost_codes(field), *OUT_OF_STEPS)))
        # copy to the host only samples that may be retried
        known = jax.tree.map(np.asarray, at_index(lanes, again)) if again.size else lanes
        for k, i in enumerate(again):
            found[i] = _next_retry(field, at_index(known, k), begun[i], options)
    return found


def _replaced(lanes: Trajectory, again: Trajectory, index: np.ndarray) -> Trajectory:
    """Replace the samples at `index` by the samples of `again`, on their device."""
    leaves, treedef = jax.tree.flatten(lanes)
    return jax.tree.unflatten(treedef, _put(leaves, jax.tree.leaves(again), index))


@jax.jit
def _put(leaves: list[Array], new: list[Array], index: Array) -> list[Array]:
    return [x.at[index].set(y) for x, y in zip(leaves, new, strict=True)]


def _next_retry(field: VectorField, motion: Trajectory, t0, options: AllOptions) -> int:
    """Return the changes for the next run of a `motion` from `t0`: those already made and one more; AS_ASKED
    if no retry is left. `field`: the integrated field; `options`: the original options.
    """
    if np.all(known_numbers(motion.result) <= result_codes.EVENT):
        return result_codes.AS_ASKED
    tried, solver, backend = int(motion.fallback), options.solver, options.backend
    another = field.name == "minimal" or field.lowered is not None  # the full state with dense matrices
    lost = another and not isinstance(solver, DiscreteGradient) and int(motion.result) in lost_codes(field)
    if lost and backend in ("auto", "dense") and not tried & result_codes.FULL_STATE:
        return tried | result_codes.FULL_STATE
    free = solver is None and backend != "native"
    if free and not tried & result_codes.IMPLICIT and _is_stiff(field, motion, t0):
        return tried | result_codes.IMPLICIT
    return result_codes.AS_ASKED


def _with_retries(retries: int, options: AllOptions) -> AllOptions:
    """Return the options with the changes that `retries` encodes."""
    if retries & result_codes.FULL_STATE:
        # dense matrices support no Taylor series
        solver = DOPRI8 if isinstance(options.solver, Taylor) else options.solver
        options = replace(
            options,
            formulation=replace(as_formulation(options.formulation), state="full"),
            backend="dense",
            solver=solver,
        )
    if retries & result_codes.IMPLICIT:
        # an implicit step costs as much as tens of explicit steps, so allow a tenth of the number
        options = replace(options, solver=RadauIIA(), max_steps=max(1, options.max_steps // 10))
    return options


def _marked(motion: Trajectory, retries: int) -> Trajectory:
    """Record `retries` in one motion or several. A motion that ran out of steps again gets the code STIFF."""
    code = motion.result
    if retries & result_codes.IMPLICIT:
        code = jnp.where(jnp.isin(code, jnp.array(OUT_OF_STEPS)), result_codes.STIFF, code).astype(code.dtype)
    return eqx.tree_at(
        lambda m: (m.result, m.fallback), motion, (code, jnp.full_like(motion.fallback, retries))
    )


def lost_codes(field: VectorField) -> tuple[int, ...]:
    """Return the result codes after which another form of the state may succeed."""
    guarded = field.lowered is not None and (field.lowered.guards or field.lowered.pivots)
    by_guards = (
        result_codes.STEP_TOO_SMALL,
        result_codes.NOT_FINITE,
        result_codes.UNSOLVED_STEP,
        result_codes.UNRESOLVED,
    )
    return result_codes.SINGULAR_PARTITION, *(by_guards if guarded else ())


def _is_stiff(field: VectorField, motion: Trajectory, t0) -> bool:
    """Return whether a `motion` from `t0` ran out of steps because stability limited their length. False if
    its numbers are traced.
    """
    known = numbers_where_known((field, motion, t0))
    if int(motion.result) not in OUT_OF_STEPS or int(motion.accepted) == 0 or known is None:
        return False
    field, motion, t0 = known
    step = float(motion.last_step)
    step = abs(float(motion.t_end) - float(t0)) / int(motion.accepted) if np.isnan(step) else step
    J = np.asarray(_jacobian(field, motion)) * np.sign(float(motion.t_end) - float(t0))
    return bool(all_finite(J) and step * np.max(-np.linalg.eigvals(J).real, initial=0.0) >= 1)


@eqx.filter_jit
def _jacobian(field: VectorField, motion: Trajectory) -> Float[Array, "state state"]:
    """Return the Jacobian of the rates at the end state, excluding the work."""
    scene, t, inputs = motion.scene, motion.t_end, motion.inputs
    y = field.pack(motion.q_end, motion.u_end)
    x, unravel = ravel_pytree((y.q, y.v))
    fixed = field.fixed(scene)

    def rates(x):
        q, v = unravel(x)
        found = field.rates(Instant(scene, fixed, t, replace(y, q=q, v=v), field.now(inputs, t)))
        return jnp.concatenate([found.q, found.v])

    return jax.jacfwd(rates)(x)
