"""The loop over steps of one of our own methods, explicit (`explicit_steps.py`) or implicit (`implicit_steps.py`), with little besides.

A batch of lanes runs in lockstep: all try a step (`erk_step`), each towards the next time asked for that
it has not reached. Every lane carries its own result code, and a lane that has ended stands still. A lane whose step
ended beyond a stop event goes back to it in further steps of the same loop, so that there is one copy of the rates to
compile (`event_search`). In reverse mode the loop keeps a record of its steps, which are then gone back over
(`recorded_adjoint`).
"""

from collections.abc import Callable
from functools import partial
from typing import Literal

import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PyTree

from jourdain_jax.motion.integrators import recorded_adjoint
from jourdain_jax.motion.integrators.erk_step import Progress, advanced, begun, running
from jourdain_jax.motion.integrators.event_search import LOCATING
from jourdain_jax.motion.integrators.explicit_steps import Method, code_at_end
from jourdain_jax.motion.integrators.implicit_steps import ImplicitMethod
from jourdain_jax.motion.integrators.problem import Problem, in_lanes, passed


def integrate(
    problem: Problem, method: Method | ImplicitMethod, y0: PyTree, t0, goals: Float[Array, "times *lanes"], dt0, kind: Literal["forward", "reverse"]
) -> tuple[PyTree, Bool[Array, "times *lanes"], Progress]:
    """States at the goals (monotonic; what was not reached repeats the last state), which were reached, and where the lane ended.

    `kind`: which mode of differentiation it is for; "forward" to any order, "reverse" to the first.
    """
    motion = _motion if kind == "forward" else partial(recorded_adjoint.motion, _motion)
    ys, reached, end, *_ = motion(problem, method, y0, t0, goals, dt0)
    return ys, reached, eqx.tree_at(lambda p: p.code, end, code_at_end(end.code, end.h, end.accepted, end.t - t0))


def _motion(
    problem: Problem,
    method: Method | ImplicitMethod,
    y0: PyTree,
    t0,
    goals,
    dt0,
    begin: Callable = lambda *_: None,
    noted: Callable = lambda *_: None,
) -> tuple:
    """`integrate` but for the code, with a record: `begin(progress, k)`, then `noted(record, progress, k)`.

    k: how many goals a lane has reached, not counting the last one.
    """
    # lanes come first in what is saved, so that a state of one is written in one piece
    direction, lanes = jnp.sign(goals[-1] - t0), jnp.ndim(t0)
    put, first, last = jax.vmap(_put, (0, 0, -1)) if lanes else _put, range(lanes), range(-lanes, 0)

    def step(carry):
        p, k, ys, record = carry
        goal = in_lanes(goals, k)
        p = advanced(problem, method, p, goal, goals[-1], direction)
        ys = jax.tree.map(lambda ys, y: put(ys, k, y), ys, p.y)
        k = jnp.minimum(k + ((p.t == goal) & (p.code != LOCATING)), len(goals) - 1)
        return p, k, ys, noted(record, p, k)

    start, k = begun(problem, y0, t0, dt0, direction), passed(goals, t0, direction)
    ys = jax.tree.map(lambda y: jnp.moveaxis(jnp.broadcast_to(y, (len(goals), *y.shape)), last, first), y0)
    carry = start, k, ys, begin(start, k)
    goes_on = lambda carry: eqxi.unvmap_any(running(carry[0], goals[-1]))  # noqa: E731
    end, _, ys, record = jax.lax.while_loop(goes_on, step, carry)
    ahead = (goals - end.t) * direction
    filled = jax.vmap(jnp.where, (0, None, 0))
    ys = jax.tree.map(lambda ys, y: filled(ahead >= 0, y, jnp.moveaxis(ys, first, last)), ys, end.y)
    return ys, ahead <= 0, end, record


def _row(x, k, row):
    """Return x with this row as its row k."""
    return jax.lax.dynamic_update_index_in_dim(x, row, k, 0)


_put_one = jax.custom_batching.custom_vmap(_row)
_put = jax.custom_jvp(_put_one)
_put.defjvp(lambda given, along: (_put(*given), _put(along[0], given[1], along[2])))


@_put_one.def_vmap
def _put_each(count, batched, *given):
    arrays = [a if one else jnp.broadcast_to(a, (count, *a.shape)) for a, one in zip(given, batched, strict=True)]
    # with a scatter XLA makes no function of the loop around it on a CPU
    return jax.lax.platform_dependent(*arrays, cpu=_put_in_turn, default=jax.vmap(_row)), True


def _put_in_turn(x, k, row):
    """Return x, which has lanes first, with the row k of each."""
    count, length, *shape = x.shape
    places = jnp.arange(count) * length + k
    flat = jax.lax.fori_loop(0, count, lambda i, flat: _row(flat, places[i], row[i]), x.reshape(count * length, *shape))
    return flat.reshape(x.shape)
