"""The states of a motion from one number to others, as a function that JAX differentiates: its derivative is a motion, of states with their tangents.

A time of an event has a tangent, which the loop itself finds; all other times are numbers (`times.py`). Tolerances and the first step change nothing, and
what samples say is a number at each time.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp

from jourdain_jax.calculus.derivatives import DifferentiationModeError, filled, is_zero
from jourdain_jax.motion.integrators.explicit_steps import Method
from jourdain_jax.motion.native.functions import Form
from jourdain_jax.motion.native.kernel import Found, Start, kernel
from jourdain_jax.motion.native.pulled import check_derivatives
from jourdain_jax.motion.native.taylor import products

OF_SAMPLES = 'machine code does not differentiate with respect to samples of an input; `jj.simulate(..., backend="xla")` does'


def flow(form: Form, method: Method, order: int | None) -> Callable[[Start], Found]:
    """The motion by a kernel; `order`: of Taylor series, in the place of the tableau."""
    # 36_000 of coefficients in a step by Taylor series of second derivatives; where there are more, steps are those of the tableau
    order = None if order is not None and len(form.moving) > 1 and products(form, order) > 36_000 else order
    own = jax.custom_jvp(kernel(form, method, order).motion)

    @partial(own.defjvp, symbolic_zeros=True)
    def rule(primals, tangents):
        (start,), (along,) = primals, tangents
        if not all(map(is_zero, along.of_samples[:1])):
            raise DifferentiationModeError(OF_SAMPLES)
        check_derivatives(replace(form, moving=(), time_moves=False), (len(form.moving) + 1).bit_length())
        raised, more = with_tangents(form, start, along)
        both = flow(replace(raised, time_moves=form.has_events and len(start.y) > 1), method, order)(more)
        found, d = (Found(*(part[half] for part in both[:3]), both.rest) for half in (slice(len(start.y)), slice(len(start.y), None)))
        return found, d._replace(rest=jnp.zeros_like(found.rest))

    return own


def with_tangents(form: Form, start: Start, along: Start) -> tuple[Form, Start]:
    """The form and the start that have these tangents too."""
    every = (tuple(range(len(start.known[0]))), *form.moving)
    moves = [[not is_zero(dx) for dx in part] for part in along.known]
    moving = tuple(tuple(i for i, does in zip(of, part, strict=True) if does) for of, part in zip(every, moves, strict=True))
    known = tuple(tuple(dx for dx in part if not is_zero(dx)) for part in along.known)
    more = start._replace(y=(*start.y, *map(filled, along.y)), known=(*start.known, *known))
    return replace(form, moving=(*form.moving, *moving)), more
