"""A function by two ways of computing it: one that runs, and one that is differentiated."""

from collections.abc import Callable

import equinox as eqx
import jax
from jax.custom_derivatives import SymbolicZero


def differentiated_as(differentiable: Callable, quick: Callable) -> Callable:
    """`quick`, which JAX cannot differentiate, with the derivatives of `differentiable`, which computes the same and takes its place in any derivative.

    Both take and return trees of arrays and of anything else.
    """

    def run(*arguments):
        arrays, rest = eqx.partition(arguments, eqx.is_array)
        leaves, treedef = jax.tree.flatten(arrays)
        shape: list = []

        def of(function):
            def on_leaves(leaves):
                found, kept = eqx.partition(function(*eqx.combine(jax.tree.unflatten(treedef, leaves), rest)), eqx.is_array)
                shape[:] = [kept]
                return found

            return on_leaves

        own = jax.custom_jvp(lambda *leaves: of(quick)(leaves))

        def rule(leaves, tangents):
            moving = [i for i, t in enumerate(tangents) if not isinstance(t, SymbolicZero)]

            def of_moving(*values):
                every = list(leaves)
                for i, value in zip(moving, values, strict=True):
                    every[i] = value
                return of(differentiable)(every)

            return jax.jvp(of_moving, tuple(leaves[i] for i in moving), tuple(tangents[i] for i in moving))

        own.defjvp(rule, symbolic_zeros=True)
        found = own(*leaves)
        return eqx.combine(found, shape[0])

    return run
