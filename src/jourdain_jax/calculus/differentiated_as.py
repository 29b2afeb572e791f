"""A function by two ways of computing it: one that runs, and one that is differentiated.

A function and its rule of differentiation must agree on which results have lanes and where: JAX takes that from the one that it batches first.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero

from jourdain_jax.calculus.both_ways import BothWays
from jourdain_jax.calculus.elsewhere import or_elsewhere
from jourdain_jax.calculus.guards import SECOND_ORDER_BY_XLA_MESSAGE
from jourdain_jax.calculus.lanes_first import lanes_first
from jourdain_jax.calculus.linear_maps import put, shapes
from jourdain_jax.calculus.promotion import with_usual_promotion


class Rules(NamedTuple):
    """Derivatives of the function that runs, by itself; trees of tangents and cotangents have None where there is none."""

    serve: Callable[..., bool]  # (order, *perturbed): whether they serve derivatives of an order, given for each array of the arguments whether it varies
    push: Callable  # (arguments, tangents): the result and its tangents; JAX can differentiate it where derivatives of a higher order are served
    pull: Callable | None = None  # (perturbed, arguments, result, cotangents): cotangents of those arguments that vary; of the reverse kind
    together: bool = False  # whether `push` gives the result as well where tangents are asked for, to the first order, by `jvp` and `jacfwd` alone


def differentiated_as(
    differentiable: Callable, quick: Callable, kind: Literal["forward", "reverse", "both"], rules: Rules | None = None, backwards: Callable | None = None
) -> Callable:
    """A function that runs `quick`, which JAX cannot differentiate. Its derivatives are by `rules` where these serve, otherwise those of `differentiable`.

    Both compute the same; they take trees of arrays and of anything else, and return trees of arrays. `kind`: the mode of differentiation of `differentiable`;
    "both": that is forward mode, and `backwards` computes the same for reverse mode. Derivatives of an order that the rules do not serve, of what they
    compute, are again those of `differentiable`, but for second ones that are in reverse mode first or last: these are by rules or an error.
    """
    if kind == "reverse":
        return _reverse(differentiable, quick, rules)
    return _forward(differentiable, quick, rules, backwards if kind == "both" else None)


def derivatives_of(function: Callable) -> Rules:
    """Rules by the function that is differentiated: what `quick` returns then stays the value, also where a derivative is taken."""

    def push(arguments, tangents):
        moving, fixed = eqx.partition(arguments, jax.tree.map(lambda d: d is not None, tangents, is_leaf=lambda d: d is None))
        return jax.jvp(lambda moving: function(*eqx.combine(moving, fixed)), (moving,), (tangents,))

    return Rules(lambda *_: True, push)


def _forward(differentiable: Callable, quick: Callable, rules: Rules | None, backwards: Callable | None = None) -> Callable:
    def run(*arguments):
        arrays, rest = eqx.partition(arguments, eqx.is_array)
        leaves, treedef = jax.tree.flatten(arrays)
        nothing = [False] * len(leaves)  # functions that JAX keeps do not see the leaves

        def given(leaves: Sequence):
            return eqx.combine(jax.tree.unflatten(treedef, leaves), rest)

        own = jax.custom_jvp(lambda *leaves: lanes_first(quick(*given(leaves))))

        def pushed(moving, leaves, *along):
            return jax.jvp(lambda *new: differentiable(*given(put(leaves, moving, new))), tuple(leaves[i] for i in moving), along)

        def pushed_by_rules(moving, leaves, *along):
            assert rules is not None
            return rules.push(given(leaves), jax.tree.unflatten(treedef, put([None] * len(nothing), moving, along)))

        def serve(moving, order: int, varies: Sequence[bool], *_) -> bool:
            varying = [i in moving or does for i, does in enumerate(varies)]
            return rules is not None and rules.serve(order, *jax.tree.unflatten(treedef, varying))

        def rates_along(moving) -> Callable:
            """Tangents of what is found that has some, as a function of the leaves and of the tangents of those that are moving."""

            def by_jax(*x):
                return _with_tangents(pushed(moving, *x)[1])

            def by_rules(*x):
                return _with_tangents(pushed_by_rules(moving, *x)[1])

            again = Rules(lambda order, *varies: serve(moving, order + 1, *varies), derivatives_of(by_rules).push)
            return _forward(by_jax, by_rules, again) if serve(moving, 1, nothing) else lambda *x: lanes_first(by_jax(*x))

        def pulled(structure, places, moving) -> Callable:
            """Cotangents of the leaves that are moving, as a function of the leaves, of what is found and of cotangents of the numbers of that."""
            perturbed = eqx.combine(jax.tree.unflatten(treedef, [i in moving for i in range(len(nothing))]), jax.tree.map(lambda _: False, rest))

            def by_either(leaves, found, cotangents):
                g = jax.tree.unflatten(structure, put([None] * len(found), places, cotangents))
                found = jax.tree.unflatten(structure, found)
                return jax.tree.leaves(_pulled(backwards, rules, perturbed, given(leaves), found, g))

            return by_either

        def reason_against_second(moving) -> str:
            return "" if serve(moving, 2, nothing) else SECOND_ORDER_BY_XLA_MESSAGE

        @with_usual_promotion
        def rule(leaves, tangents):
            moving = [i for i, t in enumerate(tangents) if not isinstance(t, SymbolicZero)]
            along = [tangents[i] for i in moving]
            if backwards is not None:
                found = own(*leaves)
                ends = jax.lax.stop_gradient(jax.tree.leaves(found))
                places = [i for i, x in enumerate(ends) if _is_number(x)]
                way = BothWays(rates_along, partial(pulled, jax.tree.structure(found), places), reason_against_second, shapes(leaves), shapes(ends), places)
                return found, _without_gaps(found, way.pushes(moving)([*leaves, *ends], along))
            if not serve(moving, 1, nothing):
                found, rates = pushed(moving, leaves, *along)
                return lanes_first(found), lanes_first(rates)
            if rules.together:
                found, rates = pushed_by_rules(moving, leaves, *along)
                return lanes_first(found), _without_gaps(found, lanes_first(_with_tangents(rates)))
            found = own(*leaves)
            return found, _without_gaps(found, rates_along(moving)(list(leaves), *along))

        own.defjvp(rule, symbolic_zeros=True)
        return own(*leaves)

    return run


def _with_tangents(rates) -> list:
    """The tangents of numbers, without those of what has none."""
    return [x for x in jax.tree.leaves(rates) if x.dtype != jax.dtypes.float0]


def _without_gaps(found, rates: list):
    """The tangents of all that was found, given those of numbers."""
    left = iter(rates)
    return jax.tree.map(lambda x: next(left) if _is_number(x) else np.zeros(x.shape, jax.dtypes.float0), found)


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
        return _pulled(differentiable, rules, perturbed, arguments, found, jax.tree.map(_filled, found, cotangents, is_leaf=lambda x: x is None))

    return lambda *arguments: own(arguments)


def _pulled(differentiable: Callable, rules: Rules | None, perturbed, arguments, found, g):
    """Cotangents of the arguments that vary, from those of what is found."""

    def by_autodiff(perturbed, arguments, found, g):
        moving, fixed = eqx.partition(arguments, perturbed)
        _, pull = eqx.filter_vjp(lambda moving: differentiable(*eqx.combine(moving, fixed)), moving)
        return pull(g)[0]

    if rules is None or rules.pull is None or not rules.serve(1, *perturbed):
        return by_autodiff(perturbed, arguments, found, g)
    return or_elsewhere(rules.pull, by_autodiff)(perturbed, arguments, found, g)


def _is_number(x) -> bool:
    return jnp.issubdtype(x.dtype, jnp.inexact)


def _filled(found, cotangent):
    """Zeros in place of a cotangent that is missing; none where there can be none."""
    if cotangent is None and found is not None and _is_number(found):
        return jnp.zeros_like(found)
    return cotangent
