"""Functions whose values and derivatives come from separate computations: an equivalent function or
explicit rules.

The derivatives are given as two functions, `f'(x) w` of tangents w and `g f'(x)` of cotangents g, which JAX
differentiates in forward mode. Together they give first and second derivatives in both modes
(`linear_maps.py`).

A function and its rule must agree on which results have a batch axis and where, because JAX assumes the
layout of whichever is batched first.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero

from jourdain_jax.calculus.compilation import with_usual_promotion
from jourdain_jax.calculus.linear_maps import BothWays, put, shapes
from jourdain_jax.calculus.markers import lanes_first


class Rules(NamedTuple):
    """Derivative rules of a function. JAX differentiates the rules in forward mode. Trees of tangents and
    cotangents have None for zeros. A rule that does not apply raises an error with the reason.
    """

    push: Callable  # (arguments, tangents) -> result and its tangents
    pull: Callable  # (perturbed, arguments, result, cotangents) -> cotangents of the perturbed arguments
    # (*perturbed) -> why JAX cannot differentiate `pull`; empty if it can
    reason_against_second: Callable[..., str] = lambda *_: ""


class _Leaves(NamedTuple):
    """Arguments of a function, split into arrays and the rest."""

    treedef: jax.tree_util.PyTreeDef
    rest: tuple

    def whole(self, leaves: Sequence):
        """Return the arguments with `leaves` as their arrays."""
        return eqx.combine(jax.tree.unflatten(self.treedef, leaves), self.rest)


def _parted(arguments: tuple) -> tuple[list, _Leaves]:
    arrays, rest = eqx.partition(arguments, eqx.is_array)
    leaves, treedef = jax.tree.flatten(arrays)
    return leaves, _Leaves(treedef, rest)


def is_zero(tangent) -> bool:
    """Return whether a tangent that JAX passes to a derivative rule is known to be zero."""
    return isinstance(tangent, SymbolicZero) or tangent.dtype == jax.dtypes.float0


def filled(tangent):
    """Return the tangent as an array, with zeros for a symbolic zero."""
    return jnp.zeros(tangent.shape, tangent.dtype) if is_zero(tangent) else tangent


def _with_rates(run: Callable, rates: Callable) -> Callable:
    """Return `run` with a derivative. `rates`: (structure of the arguments, leaves, indices of moving leaves,
    tangents, result) -> tangents of the result.
    """

    def called(*arguments):
        leaves, of = _parted(arguments)
        own = jax.custom_jvp(lambda *leaves: lanes_first(run(*of.whole(leaves))))

        @with_usual_promotion
        def rule(leaves, tangents):
            moving, found = [i for i, t in enumerate(tangents) if not is_zero(t)], own(*leaves)
            return found, rates(of, leaves, moving, [tangents[i] for i in moving], found)

        own.defjvp(rule, symbolic_zeros=True)
        return own(*leaves)

    return called


def differentiated_as(differentiable: Callable, run: Callable) -> Callable:
    """Return `run` with the derivatives of `differentiable`, which computes the same values and can be
    differentiated by JAX.

    Both take trees of arrays and other objects, and return trees of arrays.
    """

    def rates(of: _Leaves, leaves: Sequence, moving: list[int], along: list, found):
        return lanes_first(
            jax.jvp(
                lambda *new: differentiable(*of.whole(put(leaves, moving, new))),
                [leaves[i] for i in moving],
                along,
            )[1]
        )

    return _with_rates(run, rates)


def with_derivatives_of(function: Callable, value, *arguments):
    """Return `value`, which equals `function(value, *arguments)`, with the derivatives of this function.
    `value` must have a batch axis if an argument has one.
    """
    return differentiated_as(function, lambda value, *_: value)(value, *arguments)


def pushed_by_jax(run: Callable) -> Callable:
    """Return the forward rule (`push`) of a function that JAX can differentiate in forward mode."""

    def push(arguments: tuple, tangents: tuple):
        moving, fixed = eqx.partition(
            arguments, jax.tree.map(lambda d: d is not None, tangents, is_leaf=lambda d: d is None)
        )
        return jax.jvp(lambda moving: run(*eqx.combine(moving, fixed)), (moving,), (tangents,))

    return push


def by_modes(forward: Callable, reverse: Callable, reason_against_second: str) -> Callable:
    """Return `forward` with derivatives by JAX: forward mode differentiates `forward`, reverse mode the
    equivalent function `reverse`.

    `reason_against_second`: why there is no second derivative with reverse mode.
    """

    def pull(perturbed: tuple, arguments: tuple, found, g):
        moving, fixed = eqx.partition(arguments, perturbed)
        back = jax.vjp(lambda moving: reverse(*eqx.combine(moving, fixed)), moving)[1]
        return back(
            jax.tree.map(lambda x, g: np.zeros(x.shape, jax.dtypes.float0) if g is None else g, found, g)
        )[0]

    return with_rules(forward, Rules(pushed_by_jax(forward), pull, lambda *_: reason_against_second))


def with_rules(run: Callable, rules: Rules) -> Callable:
    """Return `run`, which JAX cannot differentiate, with first and second derivatives in both
    modes by `rules`.

    The returned function takes trees of arrays and other objects, and returns trees of arrays.
    """

    def rates(of: _Leaves, leaves: Sequence, moving: list[int], along: list, found):
        def pushed(moving: list[int], leaves, *along):
            tangents = jax.tree.unflatten(of.treedef, put([None] * len(leaves), moving, along))
            return [
                x
                for x in jax.tree.leaves(rules.push(of.whole(leaves), tangents)[1])
                if x.dtype != jax.dtypes.float0
            ]

        def perturbed(moving: list[int]):
            varies = jax.tree.unflatten(of.treedef, [i in moving for i in range(len(leaves))])
            return eqx.combine(varies, jax.tree.map(lambda _: False, of.rest))

        def pulled(moving: list[int]) -> Callable:
            """Return the function `BothWays.pulled` for these moving leaves."""
            varies = perturbed(moving)

            def cotangents(leaves, ends, given):
                g = jax.tree.unflatten(structure, put([None] * len(ends), places, given))
                by_rules = rules.pull(varies, of.whole(leaves), jax.tree.unflatten(structure, ends), g)
                # rules may return cotangents of other arguments too
                return jax.tree.leaves(eqx.filter(by_rules, varies))

            return cotangents

        ends, structure = jax.tree.flatten(jax.lax.stop_gradient(found))
        places = [i for i, x in enumerate(ends) if _is_number(x)]
        reason = lambda moving: rules.reason_against_second(*perturbed(moving))
        way = BothWays(
            lambda moving: partial(pushed, moving), pulled, reason, shapes(leaves), shapes(ends), places
        )
        return _without_gaps(found, way.pushes(moving)([*leaves, *ends], along))

    return _with_rates(run, rates)


def _without_gaps(found, rates: list):
    """Return the tangents of all arrays of `found`: `rates` for real arrays, zeros for integer arrays."""
    left = iter(rates)
    return jax.tree.map(
        lambda x: next(left) if _is_number(x) else np.zeros(x.shape, jax.dtypes.float0), found
    )


def _is_number(x) -> bool:
    return jnp.issubdtype(x.dtype, jnp.inexact)
