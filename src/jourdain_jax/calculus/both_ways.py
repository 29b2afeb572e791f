"""Derivatives of a function f(x) of arrays in both modes, to the second order, from two functions that JAX differentiates forward:

    pushes   w -> f'(x) w                          pulls   g -> g f'(x)
    turns    v -> f''(x)(v, w)                     bends   v -> g f''(x)(., v)

Pulls transpose pushes. As f'' is symmetric, bends along v transpose bends, and turns, whose w is that v. What f(x) is counts as a number at which these
are taken, beside x: a derivative along x is the whole one.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import jax

from jourdain_jax.calculus.guards import DifferentiationModeError
from jourdain_jax.calculus.linear_maps import LinearMap, by_jax, no_further, put


class BothWays(NamedTuple):
    """x is a list of arrays like the `leaves`, what is found one like `found`, with numbers at the `places`."""

    rates: Callable[[list[int]], Callable]  # which leaves move -> function of the leaves and of their tangents: tangents of numbers
    pulled: Callable[[list[int]], Callable]  # which leaves move -> function of the leaves, of what is found, and of cotangents of numbers: those of the leaves
    reason_against_second: Callable[[list[int]], str]  # which leaves move -> why JAX does not differentiate `pulled`, in words; empty where it does
    leaves: Sequence[jax.ShapeDtypeStruct]
    found: Sequence[jax.ShapeDtypeStruct]
    places: list[int]

    def pushes(self, moving: list[int]) -> LinearMap:
        """The map of tangents of leaves, at the leaves and what is found."""

        def pushed(at, along):
            return self.rates(moving)(list(at[: len(self.leaves)]), *along)

        return LinearMap(pushed, [self.found[i] for i in self.places], lambda: self._pulls(moving), lambda others: self._turns(moving, others))

    def _pulls(self, moving: list[int]) -> LinearMap:
        def pulled(at, g):
            return self.pulled(moving)(at[: len(self.leaves)], at[len(self.leaves) :], g)

        return LinearMap(pulled, [self.leaves[i] for i in moving], lambda: self.pushes(moving), lambda others: self._bends(moving, others))

    def _turns(self, moving: list[int], others: list[int]) -> LinearMap:
        """The derivative of pushes along others of the leaves; it is taken at the tangents too."""
        count = len(self.leaves) + len(self.found)

        def pulled(at, g):
            return self._bends(others, moving).apply([*at[:count], *g], at[count:])

        own = by_jax(self.pushes(moving), count, others)
        return replace(own, transposed=lambda: LinearMap(pulled, [self.leaves[i] for i in others], lambda: own, no_further))

    def _bends(self, moving: list[int], others: list[int]) -> LinearMap:
        """The derivative of pulls along others of the leaves; it is taken at the cotangents too."""
        count, end = len(self.leaves), len(self.leaves) + len(self.found)
        if reason := self.reason_against_second([*moving, *others]):
            raise DifferentiationModeError(reason)

        def bent(at, along):
            leaves, found, g = list(at[:count]), at[count:end], at[end:]

            def pulled(new, numbers):
                return self.pulled(moving)(put(leaves, others, new), put(found, self.places, numbers), g)

            rates = self.rates(others)(leaves, *along)
            return jax.jvp(pulled, ([leaves[i] for i in others], [found[i] for i in self.places]), (list(along), list(rates)))[1]

        return LinearMap(bent, [self.leaves[i] for i in moving], lambda: self._bends(others, moving), no_further)
