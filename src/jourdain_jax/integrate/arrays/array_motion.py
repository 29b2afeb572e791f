"""The loop in JAX (`array_loop.py`) as a function with derivatives in forward and reverse mode.

If the rates support batches, `vmap` of this function runs blocks of samples.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, PyTree

from jourdain_jax.calculus.reals import at_index, eps_of
from jourdain_jax.integrate import integrands
from jourdain_jax.integrate.arrays.array_functions import ArrayForm, split
from jourdain_jax.integrate.arrays.array_loop import Loop, cotangents
from jourdain_jax.integrate.explicit_steps import Method
from jourdain_jax.integrate.implicit_steps import ImplicitMethod
from jourdain_jax.integrate.loop.adjoint import moved
from jourdain_jax.integrate.loop.form import Form
from jourdain_jax.integrate.loop.loop_function import Found, Start, control_of, differentiated, modes_at_start
from jourdain_jax.integrate.setup import Begun, Setup
from jourdain_jax.integrate.vector_fields.field import Integrated


def loop_of(
    method: Method | ImplicitMethod, setup: Setup, begun: Begun, of_events: dict[str, Any]
) -> tuple[Loop, Start]:
    """Return the loop and the start of one motion. `of_events`: fields of the form that describe events."""
    goals, knots, field, y0 = setup.times.goals, setup.knots, setup.field, begun.y0
    args, most, eps = (integrands.within(goals[0], begun.args), setup.most_steps(knots), float(eps_of(y0.q)))
    count = lambda f: len(jax.eval_shape(f, goals[0], y0, args))
    seen = jax.eval_shape(integrands.rates_and_pivots, goals[0], y0, args) if field.has_pivots else None
    modes = modes_at_start(setup.inputs)
    form = ArrayForm(
        None,
        field.with_work,
        field.projects,
        True,
        pivots=len(seen.pivots) if seen else 0,
        coordinates=len(y0.q),
        speeds=len(y0.v),
        events=count(integrands.events) if of_events["has_events"] else 0,
        turning=seen.directions.size if seen else 0,
        squares=range(2 * field.near_rank_loss),
        switched=range(len(modes)),
        stops=field.stops if of_events["has_events"] else (),
        sides=field.lowered.sides if field.lowered else (),
        **of_events,
        compensated=most * eps > eps**0.5,  # after so many steps, round-off may exceed half of the digits
    )
    known, rest = split(begun.args)
    samples = () if knots is None else (knots,)
    numbers = jax.lax.stop_gradient((samples, control_of(setup, knots), goals, jnp.zeros_like(goals[0])))
    return Loop(form, method, rest, most), Start(
        *numbers, y=(y0.rows,), known=(known,), modes=modes, code=begun.code
    )


def flow(of: Loop, at_once: int) -> Callable[[Start], Found]:
    """Return the motion as a function of its start. `at_once`: samples per block; 0: all together."""

    def motion(form: Form) -> Callable[[Start], Found]:
        run = of._replace(form=form).run
        return _blocked(run, at_once, run, Found.shared)

    return differentiated(motion, of.form, lambda form, along: None)


def _blocked(run: Callable, at_once: int, lanes_last: Callable, result: Callable) -> Callable:
    """Return `run`; under `vmap`, it runs `lanes_last` in blocks. `result`: result of `vmap` from the results
    of all samples and the flags of batched arguments.
    """
    if not at_once:
        return run
    motion = jax.custom_batching.custom_vmap(run)

    @motion.def_vmap
    def motions(count, batched: Sequence, *given):
        return result(_in_blocks(count, at_once, lanes_last, batched, *given), *batched)

    return motion


def flow_back(of: Loop, at_once: int, asked: Sequence[int], memory: int) -> Callable:
    """Return the reverse mode of `flow` as a function of the start and of the cotangents of the motion
    (`array_loop.py`).
    """
    back = partial(cotangents, of, asked, memory)

    def lanes_last(*given):
        by_y, by_known = back(*given)
        return by_y, [jnp.moveaxis(x, 0, -1) for x in by_known]

    return _blocked(back, at_once, lanes_last, lambda found, *_: (found, jax.tree.map(lambda _: True, found)))


def _in_blocks(count, at_once: int, run: Callable, batched: Sequence, *given):
    """Run blocks of samples one after the other. The batch axis is first outside a block, and last inside it,
    except in known arrays.
    """
    given = jax.tree.map(
        lambda x, has: x if has else jnp.broadcast_to(x, (count, *x.shape)), given, tuple(batched)
    )
    blocks = -(-count // at_once)
    last = lambda tree: jax.tree.map(lambda x: jnp.moveaxis(x, 0, -1), tree)

    def block(given):
        start, *others = given
        return jax.tree.map(
            lambda x: jnp.moveaxis(x, -1, 0), run(last(start)._replace(known=start.known), *last(others))
        )

    if blocks == 1:
        return block(given)
    index = jnp.minimum(jnp.arange(blocks * at_once), count - 1).reshape(blocks, at_once)
    found = jax.lax.map(block, at_index(given, index))
    return jax.tree.map(lambda x: x.reshape(blocks * at_once, *x.shape[2:])[:count], found)


def mover(args: PyTree, shared: PyTree) -> Callable[[Integrated, Array, Array], Integrated]:
    """Return a function of a state, its time t and a shift d, which shifts the state along its rates by d.
    The value of d is zero: it only carries derivatives.
    """
    known, others = eqx.partition(args, eqx.is_inexact_array)

    def moved_by(y, t, d):
        z, unravel = ravel_pytree((y, t, known))

        def rates(_, z):
            y, t, known = unravel(z)
            found = integrands.rates(
                t, y, integrands.within(jnp.full_like(t, jnp.inf), eqx.combine(known, others))
            )
            return ravel_pytree((found, jnp.ones_like(t), jax.tree.map(jnp.zeros_like, known)))[0]

        return unravel(moved(rates)((), z, d))[0]

    return moved_by
