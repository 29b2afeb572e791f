"""An iteration x <- step(a, x) that ends where it changes nothing more, differentiable in any mode and to any order.

    D <- d step/da + d step/dx D,      D = dx/d(a, x_0)

The derivative is carried along with x, for those entries of a and x_0 that vary, so that both modes of differentiation run one loop. Where the iteration
converges quadratically, each further step doubles the order of derivatives that are right: two steps that change nothing give those up to the third.
Steps left out cost nothing, under `vmap` neither once all lanes have settled.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from jourdain_jax.calculus.promotion import with_usual_promotion

QUIET = 2  # steps in a row
ROUND_OFF = 1e3  # units of it, relative to 1 + |x|: a change


def fixed_point(step: Callable, a: Any, x: Float[Array, "entries"], most: int, prepare: Callable | None = None) -> Float[Array, "entries"]:
    """x after at most so many steps; what is not a number has settled.

    `prepare`: takes a to what steps are given in its place, a pair whose second has no derivatives.
    """
    return _iterated((a, x), step=step, most=most, prepare=prepare)


@eqx.filter_custom_jvp
def _iterated(of: tuple, *, step: Callable, most: int, prepare: Callable | None):
    a, x = of
    given = a if prepare is None else prepare(a)
    return _loop(lambda carry: (step(given, carry[0]),), (x,), most)[0]


@_iterated.def_jvp
@with_usual_promotion
def _iterated_jvp(primals, tangents, *, step, most, prepare):
    (of,), (along,) = primals, tangents
    (moving, _), (fixed, _) = moves, _ = eqx.partition(of, jax.tree.map(lambda d: d is not None, along, is_leaf=lambda d: d is None))
    flat, restored = ravel_pytree(moves)
    units, first = jax.vmap(restored)(jnp.eye(flat.size, dtype=flat.dtype))
    D = jnp.zeros((flat.size, *of[1].shape), of[1].dtype) if first is None else first
    along_each = partial(jax.vmap, axis_size=flat.size)
    if prepare is None:
        at, dat, taken = moving, units, lambda at: eqx.combine(at, fixed)
    else:
        of_units = along_each(lambda da: jax.jvp(lambda a: prepare(eqx.combine(a, fixed)), (moving,), (da,), has_aux=True), out_axes=(None, 0, None))
        at, dat, rest = of_units(units)
        taken = lambda at: (at, rest)  # noqa: E731

    def both(carry):
        x, D = carry
        return along_each(lambda da, dx: jax.jvp(lambda a, x: step(taken(a), x), (at, x), (da, dx)), out_axes=(None, 0))(dat, D)

    x, D = _loop(both, (of[1], D), most)
    return x, ravel_pytree(along)[0] @ D


def _loop(step: Callable, carry: tuple, most: int) -> tuple:
    """So many steps of a tuple; the first of it tells when it has settled."""
    if most <= QUIET:
        return jax.lax.scan(lambda carry, _: (step(carry), None), carry, length=most)[0]

    def once(state, _):
        carry, quiet = state
        going = quiet < QUIET
        new = jax.lax.cond(eqxi.unvmap_any(going), step, lambda carry: carry, carry)
        old_value, value = jax.lax.stop_gradient((carry[0], new[0]))
        changed = jnp.any(jnp.abs(value - old_value) > ROUND_OFF * jnp.finfo(value.dtype).eps * (1 + jnp.abs(old_value)))
        kept = tuple(jnp.where(going, *pair) for pair in zip(new, carry, strict=True))
        return (kept, jnp.where(going & changed, 0, jnp.minimum(quiet + 1, QUIET))), None

    return jax.lax.scan(once, (carry, jnp.zeros((), jnp.int32)), length=most)[0][0]
