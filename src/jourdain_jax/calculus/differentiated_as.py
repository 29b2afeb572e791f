"""A function by two ways of computing it: one that runs, and one that is differentiated."""

from collections.abc import Callable
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.custom_derivatives import SymbolicZero

from jourdain_jax.calculus.lanes_first import lanes_first


def differentiated_as(differentiable: Callable, quick: Callable, kind: Literal["forward", "reverse"]) -> Callable:
    """`quick`, which JAX cannot differentiate, with the derivatives of `differentiable`, which computes the same and takes its place in any derivative.

    Both take trees of arrays and of anything else, and return trees of arrays. `kind`: the mode of differentiation of `differentiable`.
    """
    return (_forward if kind == "forward" else _reverse)(differentiable, quick)


def _forward(differentiable: Callable, quick: Callable) -> Callable:
    def run(*arguments):
        arrays, rest = eqx.partition(arguments, eqx.is_array)
        leaves, treedef = jax.tree.flatten(arrays)

        def of(function, leaves):
            return function(*eqx.combine(jax.tree.unflatten(treedef, leaves), rest))

        own = jax.custom_jvp(lambda *leaves: lanes_first(of(quick, leaves)))

        def rule(leaves, tangents):
            moving = [i for i, t in enumerate(tangents) if not isinstance(t, SymbolicZero)]

            def of_moving(*values):
                return of(differentiable, [dict(zip(moving, values, strict=True)).get(i, leaf) for i, leaf in enumerate(leaves)])

            found, rates = jax.jvp(of_moving, tuple(leaves[i] for i in moving), tuple(tangents[i] for i in moving))
            return lanes_first(found), lanes_first(rates)

        own.defjvp(rule, symbolic_zeros=True)
        return own(*leaves)

    return run


def _reverse(differentiable: Callable, quick: Callable) -> Callable:
    @eqx.filter_custom_vjp
    def own(arguments):
        return lanes_first(quick(*arguments))

    @own.def_fwd
    def forth(perturbed, arguments):
        moving, fixed = eqx.partition(arguments, perturbed)
        found, pull = eqx.filter_vjp(lambda moving: differentiable(*eqx.combine(moving, fixed)), moving)
        return lanes_first(found), (pull, eqx.filter_eval_shape(lambda: found))

    @own.def_bwd
    def back(residuals, cotangents, perturbed, arguments):
        pull, shapes = residuals
        return pull(jax.tree.map(_filled, shapes, cotangents, is_leaf=lambda x: x is None))[0]

    return lambda *arguments: own(arguments)


def _filled(shape, cotangent):
    """Zeros in place of a cotangent that is missing; none where there can be none."""
    if cotangent is None and shape is not None and jnp.issubdtype(shape.dtype, jnp.inexact):
        return jnp.zeros(shape.shape, shape.dtype)
    return cotangent
