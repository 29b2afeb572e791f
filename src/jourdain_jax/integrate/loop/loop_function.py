"""The loop of `loop.py` as a differentiable JAX function.

The derivative of a motion is a motion whose state includes tangents. The loop itself computes the tangent of
an event's time; all other times are constant here (`native_motion.py`). Tolerances, the first step and
samples have no derivatives.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import lru_cache, partial

import jax
import jax.numpy as jnp

from jourdain_jax.calculus.derivative_errors import DifferentiationModeError
from jourdain_jax.calculus.derivatives import filled, is_zero
from jourdain_jax.integrate.explicit_steps import Method
from jourdain_jax.integrate.loop.form import Form
from jourdain_jax.integrate.loop.handover import Found, Start, constant_rows
from jourdain_jax.integrate.loop.lanes import arguments_of_samples
from jourdain_jax.integrate.loop.loop import write_loop
from jourdain_jax.integrate.loop.rate_functions import check_derivatives
from jourdain_jax.integrate.loop.taylor import TaylorSteps, products
from jourdain_jax.integrate.loop.value_kernels import called

Loop = Callable[[Start], Found]
MOST_KERNELS = 64  # number of cached kernels; their machine code lives as long as the process


@lru_cache(maxsize=MOST_KERNELS)
def kernel(form: Form, method: Method, order: int | None = None) -> Loop:
    """Return the kernel for a form, by a tableau, or by Taylor series if an `order` is given."""
    steps = method if order is None else TaylorSteps(order)

    def shapes(*arguments):
        return (arguments[-1].shape[-1], form.integrated), (form.returned + 1,)

    run = called(
        lambda w: write_loop(w, form, steps), shapes, arguments_of_samples(form), constant=constant_rows(form)
    )

    @jax.custom_batching.custom_vmap
    def motion(start: Start) -> Found:
        states, end = run(*start.of_samples, (*start.y, *start.numbers()), start.goals)
        return Found.of(form, states, end[:-1], end[-1:])

    @motion.def_vmap
    def motions(count, batched: Sequence, start: Start):
        (given,) = batched
        found = jax.vmap(
            motion.fun, [jax.tree.map(lambda has_axis: 0 if has_axis else None, given)], axis_size=count
        )(start)
        return found.shared(given)

    return motion


OF_SAMPLES = (
    "machine code does not differentiate with respect to samples of an input; use `jj.simulate(...,"
    ' backend="xla")`'
)


def flow(form: Form, method: Method, order: int | None) -> Loop:
    """Return the motion as a function of its start. `order`: order of Taylor series, used in place of the
    tableau.
    """

    def motion(form: Form) -> Loop:
        # for second derivatives, the tableau replaces Taylor series of more than 36_000 products
        too_many = order is not None and len(form.moving) > 1 and products(form, order) > 36_000
        return kernel(form, method, None if too_many else order)

    def check(form: Form, along: Start) -> None:
        if not all(map(is_zero, along.of_samples[:1])):
            raise DifferentiationModeError(OF_SAMPLES)
        check_derivatives(replace(form, moving=(), time_moves=False), (len(form.moving) + 1).bit_length())

    return differentiated(motion, form, check)


def differentiated(motion: Callable[[Form], Loop], form: Form, check: Callable[[Form, Start], None]) -> Loop:
    """Return the motion of a form as a differentiable function. Its derivative is the motion of a form with
    more tangents; `check` raises an error if that form is not supported.
    """
    own = jax.custom_jvp(motion(form))

    @partial(own.defjvp, symbolic_zeros=True)
    def rule(primals, tangents):
        (start,), (along,) = primals, tangents
        check(form, along)
        raised, more = with_tangents(form, start, along)
        both = differentiated(
            motion, replace(raised, time_moves=form.has_events and len(start.y) > 1), check
        )(more)
        found, d = (
            Found(*(part[half] for part in both[:4]), both.rest)
            for half in (slice(len(start.y)), slice(len(start.y), None))
        )
        return found, d._replace(rest=jnp.zeros_like(found.rest))

    return own


def with_tangents(form: Form, start: Start, along: Start) -> tuple[Form, Start]:
    """Return the form and the start, with the tangents `along` added."""
    every = (tuple(range(len(start.known[0]))), *form.moving)
    moves = [[not is_zero(dx) for dx in part] for part in along.known]
    moving = tuple(
        tuple(i for i, does in zip(of, part, strict=True) if does)
        for of, part in zip(every, moves, strict=True)
    )
    known = tuple(tuple(dx for dx in part if not is_zero(dx)) for part in along.known)
    more = start._replace(y=(*start.y, *map(filled, along.y)), known=(*start.known, *known))
    return replace(form, moving=(*form.moving, *moving)), more
