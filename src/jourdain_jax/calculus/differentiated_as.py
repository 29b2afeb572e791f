"""A function by two ways of computing it: one that runs, and one that is differentiated.

A function and its rule of differentiation must agree on which results have lanes and where: JAX takes that from the one that it batches first.
"""

from collections.abc import Callable
from typing import Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir

from jourdain_jax.calculus.elsewhere import or_elsewhere
from jourdain_jax.calculus.promotion import with_usual_promotion


class Rules(NamedTuple):
    """Derivatives of the function that runs, by itself; trees of tangents and cotangents have None where there is none."""

    serve: Callable[..., bool]  # (order, *perturbed): whether they serve derivatives of an order, given for each array of the arguments whether it varies
    push: Callable  # (arguments, tangents): the result and its tangents; JAX can differentiate it where derivatives of a higher order are served
    pull: Callable | None = None  # (perturbed, arguments, result, cotangents): cotangents of those arguments that vary; of the reverse kind
    together: bool = False  # whether `push` gives the result as well where tangents are asked for, to the first order, by `jvp` and `jacfwd` alone


def differentiated_as(differentiable: Callable, quick: Callable, kind: Literal["forward", "reverse"], rules: Rules | None = None) -> Callable:
    """A function that runs `quick`, which JAX cannot differentiate. Its derivatives are by `rules` where these serve, otherwise those of `differentiable`.

    Both compute the same; they take trees of arrays and of anything else, and return trees of arrays. `kind`: the mode of differentiation of `differentiable`.
    Derivatives of an order that the rules do not serve, of what they compute, are again those of `differentiable`.
    """
    return (_forward if kind == "forward" else _reverse)(differentiable, quick, rules)


def derivatives_of(function: Callable) -> Rules:
    """Rules by the function that is differentiated: what `quick` returns then stays the value, also where a derivative is taken."""

    def push(arguments, tangents):
        moving, fixed = eqx.partition(arguments, jax.tree.map(lambda d: d is not None, tangents, is_leaf=lambda d: d is None))
        return jax.jvp(lambda moving: function(*eqx.combine(moving, fixed)), (moving,), (tangents,))

    return Rules(lambda *_: True, push)


def _forward(differentiable: Callable, quick: Callable, rules: Rules | None) -> Callable:
    def run(*arguments):
        arrays, rest = eqx.partition(arguments, eqx.is_array)
        leaves, treedef = jax.tree.flatten(arrays)

        def of(function, leaves):
            return function(*eqx.combine(jax.tree.unflatten(treedef, leaves), rest))

        own = jax.custom_jvp(lambda *leaves: lanes_first(of(quick, leaves)))

        @with_usual_promotion
        def rule(leaves, tangents):
            moving = [i for i, t in enumerate(tangents) if not isinstance(t, SymbolicZero)]

            def pushed(leaves, *along):
                def of_moving(*values):
                    return of(differentiable, [dict(zip(moving, values, strict=True)).get(i, leaf) for i, leaf in enumerate(leaves)])

                return jax.jvp(of_moving, tuple(leaves[i] for i in moving), along)

            def serve(order: int, varies: list, *_) -> bool:
                varying = [i in moving or does for i, does in enumerate(varies)]
                return rules is not None and rules.serve(order, *jax.tree.unflatten(treedef, varying))

            along = [tangents[i] for i in moving]
            if not serve(1, [False] * len(leaves)):
                found, rates = pushed(leaves, *along)
                return lanes_first(found), lanes_first(rates)

            def pushed_by_rules(leaves, *along):
                given = jax.tree.unflatten(treedef, [dict(zip(moving, along, strict=True)).get(i) for i in range(len(leaves))])
                return rules.push(eqx.combine(jax.tree.unflatten(treedef, leaves), rest), given)

            if rules.together:
                found, rates = pushed_by_rules(leaves, *along)
                return lanes_first(found), _without_gaps(found, lanes_first(_with_tangents(rates)))

            def rates_by_rules(*x):
                return _with_tangents(pushed_by_rules(*x)[1])

            again = Rules(lambda order, *varies: serve(order + 1, *varies), derivatives_of(rates_by_rules).push)
            found = own(*leaves)
            rates = _forward(lambda *x: _with_tangents(pushed(*x)[1]), rates_by_rules, again)(list(leaves), *along)
            return found, _without_gaps(found, rates)

        own.defjvp(rule, symbolic_zeros=True)
        return own(*leaves)

    return run


def _with_tangents(rates) -> list:
    """The tangents of numbers, without those of what has none."""
    return [x for x in jax.tree.leaves(rates) if x.dtype != jax.dtypes.float0]


def _without_gaps(found, rates: list):
    """The tangents of all that was found, given those of numbers."""
    left = iter(rates)
    return jax.tree.map(lambda x: next(left) if jnp.issubdtype(x.dtype, jnp.inexact) else np.zeros(x.shape, jax.dtypes.float0), found)


def _reverse(differentiable: Callable, quick: Callable, rules: Rules | None) -> Callable:
    @eqx.filter_custom_vjp
    def own(arguments):
        return lanes_first(quick(*arguments))

    # What is kept for the way back is the same whatever varies: under `jit`, JAX keeps one structure of it for all calls that share a trace.
    @own.def_fwd
    @with_usual_promotion
    def forth(perturbed, arguments):
        found = own(arguments)
        return found, found

    @own.def_bwd
    @with_usual_promotion
    def back(found, cotangents, perturbed, arguments):
        g = jax.tree.map(_filled, found, cotangents, is_leaf=lambda x: x is None)

        def by_autodiff(perturbed, arguments, found, g):
            moving, fixed = eqx.partition(arguments, perturbed)
            _, pull = eqx.filter_vjp(lambda moving: differentiable(*eqx.combine(moving, fixed)), moving)
            return pull(g)[0]

        serve = rules is not None and rules.serve(1, *perturbed)
        return (or_elsewhere(rules.pull, by_autodiff) if serve else by_autodiff)(perturbed, arguments, found, g)

    return lambda *arguments: own(arguments)


def _filled(found, cotangent):
    """Zeros in place of a cotangent that is missing; none where there can be none."""
    if cotangent is None and found is not None and jnp.issubdtype(found.dtype, jnp.inexact):
        return jnp.zeros_like(found)
    return cotangent


def lanes_first(tree):
    """The tree, unchanged; under `vmap` all its arrays get their axis of lanes first. Values without a tangent space pass."""
    leaves, treedef = jax.tree.flatten(tree)
    moved = [i for i, x in enumerate(leaves) if x.dtype != jax.dtypes.float0]
    for i, x in zip(moved, lanes_first_p.bind(*(leaves[i] for i in moved)) if moved else (), strict=True):
        leaves[i] = x
    return jax.tree.unflatten(treedef, leaves)


def with_lanes_first(values, axes) -> list:
    """Arrays of which each has its lanes along an axis, or none (None), as a batching rule is given them: all have the first axis of lanes."""
    count = next(x.shape[axis] for x, axis in zip(values, axes, strict=True) if axis is not None)
    return [jnp.broadcast_to(x, (count, *x.shape)) if axis is None else jnp.moveaxis(x, axis, 0) for x, axis in zip(values, axes, strict=True)]


def _batched(values, axes):
    return lanes_first_p.bind(*with_lanes_first(values, axes)), [0] * len(values)


lanes_first_p = Primitive("jourdain_lanes_first")
lanes_first_p.multiple_results = True
lanes_first_p.def_impl(lambda *values: list(values))
lanes_first_p.def_abstract_eval(lambda *avals: list(avals))
ad.primitive_jvps[lanes_first_p] = lambda primals, tangents: (lanes_first_p.bind(*primals), list(tangents))
ad.primitive_transposes[lanes_first_p] = lambda cotangents, *values: list(cotangents)
batching.primitive_batchers[lanes_first_p] = _batched
mlir.register_lowering(lanes_first_p, mlir.lower_fun(lambda *values: list(values), multiple_results=True))
