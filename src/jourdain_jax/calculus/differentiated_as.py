"""Functions whose values are computed in one way and whose derivatives in another: by JAX, of a function that computes the same, or by rules.

A function and its rule of differentiation must agree on which results have lanes and where: JAX takes that from the one that it batches first.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero

from jourdain_jax.calculus.both_ways import BothWays
from jourdain_jax.calculus.lanes_first import lanes_first
from jourdain_jax.calculus.linear_maps import put, shapes
from jourdain_jax.calculus.promotion import with_usual_promotion


class Rules(NamedTuple):
    """Derivatives of a function; trees of tangents and cotangents have None where there is none. A rule that does not serve raises an error that says so."""

    push: Callable  # (arguments, tangents): the result and its tangents; JAX differentiates it forward
    pull: Callable  # (perturbed, arguments, result, cotangents): cotangents of those arguments that vary; JAX differentiates it forward
    reason_against_second: Callable[..., str] = lambda *_: ""  # (*perturbed): why JAX does not differentiate `pull`, in words; empty where it does


class _Leaves(NamedTuple):
    """The arguments of a function, split into arrays and the rest."""

    treedef: jax.tree_util.PyTreeDef
    rest: tuple

    def whole(self, leaves: Sequence):
        """Return the arguments with these arrays."""
        return eqx.combine(jax.tree.unflatten(self.treedef, leaves), self.rest)


def _parted(arguments: tuple) -> tuple[list, _Leaves]:
    arrays, rest = eqx.partition(arguments, eqx.is_array)
    leaves, treedef = jax.tree.flatten(arrays)
    return leaves, _Leaves(treedef, rest)


def is_zero(tangent) -> bool:
    """Return whether nothing changes, as a rule with symbolic zeros is told."""
    return isinstance(tangent, SymbolicZero)


def filled(tangent):
    """Return the tangent as an array."""
    return jnp.zeros(tangent.shape, tangent.dtype) if is_zero(tangent) else tangent


def _moving(tangents: Sequence) -> list[int]:
    return [i for i, t in enumerate(tangents) if not is_zero(t)]


def differentiated_as(differentiable: Callable, run: Callable) -> Callable:
    """Return `run` with the derivatives of `differentiable`, which computes the same and which JAX differentiates.

    Both take trees of arrays and of anything else, and return trees of arrays.
    """

    def called(*arguments):
        leaves, of = _parted(arguments)
        own = jax.custom_jvp(lambda *leaves: lanes_first(run(*of.whole(leaves))))

        @with_usual_promotion
        def rule(leaves, tangents):
            moving = _moving(tangents)
            new, along = tuple(leaves[i] for i in moving), tuple(tangents[i] for i in moving)
            _, rates = jax.jvp(lambda *new: differentiable(*of.whole(put(leaves, moving, new))), new, along)
            return own(*leaves), lanes_first(rates)

        own.defjvp(rule, symbolic_zeros=True)
        return own(*leaves)

    return called


def pushed_by_jax(run: Callable) -> Callable:
    """Return the `push` of a function that JAX differentiates forward."""

    def push(arguments: tuple, tangents: tuple):
        moving, fixed = eqx.partition(arguments, jax.tree.map(lambda d: d is not None, tangents, is_leaf=lambda d: d is None))
        return jax.jvp(lambda moving: run(*eqx.combine(moving, fixed)), (moving,), (tangents,))

    return push


def by_modes(forward: Callable, reverse: Callable, reason_against_second: str) -> Callable:
    """Return `forward`, which JAX differentiates forward, with the reverse mode of `reverse`, which computes the same.

    `reason_against_second`: why reverse mode takes part in no second derivative, in words.
    """

    def pull(perturbed: tuple, arguments: tuple, found, g):
        moving, fixed = eqx.partition(arguments, perturbed)
        back = jax.vjp(lambda moving: reverse(*eqx.combine(moving, fixed)), moving)[1]
        return back(jax.tree.map(lambda x, g: np.zeros(x.shape, jax.dtypes.float0) if g is None else g, found, g))[0]

    return with_rules(forward, Rules(pushed_by_jax(forward), pull, lambda *_: reason_against_second))


def with_rules(run: Callable, rules: Rules) -> Callable:
    """Return `run`, which JAX cannot differentiate, with derivatives by rules, in both modes and to the second order.

    It takes trees of arrays and of anything else, and returns trees of arrays.
    """

    def called(*arguments):
        leaves, of = _parted(arguments)
        own = jax.custom_jvp(lambda *leaves: lanes_first(run(*of.whole(leaves))))

        def pushed(moving: list[int], leaves, *along):
            tangents = jax.tree.unflatten(of.treedef, put([None] * len(leaves), moving, along))
            found, rates = rules.push(of.whole(leaves), tangents)
            return found, [x for x in jax.tree.leaves(rates) if x.dtype != jax.dtypes.float0]

        def rates_along(moving: list[int]) -> Callable:
            return lambda *x: pushed(moving, *x)[1]

        def perturbed(moving: list[int]):
            varies = jax.tree.unflatten(of.treedef, [i in moving for i in range(len(leaves))])
            return eqx.combine(varies, jax.tree.map(lambda _: False, of.rest))

        def pulled(structure, places: list[int], moving: list[int]) -> Callable:
            """Cotangents of the leaves that are moving, as a function of the leaves, of what is found and of cotangents of the numbers of that."""
            varies = perturbed(moving)

            def cotangents(leaves, found, given):
                g = jax.tree.unflatten(structure, put([None] * len(found), places, given))
                by_rules = rules.pull(varies, of.whole(leaves), jax.tree.unflatten(structure, found), g)
                return jax.tree.leaves(eqx.filter(by_rules, varies))  # rules may give more

            return cotangents

        @with_usual_promotion
        def rule(leaves, tangents):
            moving = _moving(tangents)
            along = [tangents[i] for i in moving]
            found = own(*leaves)
            ends = jax.lax.stop_gradient(jax.tree.leaves(found))
            places = [i for i, x in enumerate(ends) if _is_number(x)]
            pulls = partial(pulled, jax.tree.structure(found), places)
            way = BothWays(rates_along, pulls, lambda moving: rules.reason_against_second(*perturbed(moving)), shapes(leaves), shapes(ends), places)
            return found, _without_gaps(found, way.pushes(moving)([*leaves, *ends], along))

        own.defjvp(rule, symbolic_zeros=True)
        return own(*leaves)

    return called


def _without_gaps(found, rates: list):
    """The tangents of all that was found, given those of numbers."""
    left = iter(rates)
    return jax.tree.map(lambda x: next(left) if _is_number(x) else np.zeros(x.shape, jax.dtypes.float0), found)


def _is_number(x) -> bool:
    return jnp.issubdtype(x.dtype, jnp.inexact)
