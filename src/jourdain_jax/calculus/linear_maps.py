"""Linear maps as a primitive of JAX: forward mode evaluates a map, reverse mode transposes it.

One function computes the values of a map, another the values of its transpose, so that neither mode traces
operations that only the other needs. First and second derivatives of f(x) are four maps, here of vectors v, w
and of cotangents g:

    pushes   w -> f'(x) w                          pulls   g -> g f'(x)
    turns    v -> f''(x)(v, w)                     bends   v -> g f''(x)(., v)

Pulls are the transposes of pushes. Because f'' is symmetric, the transpose of bends in v is bends, and the
transpose of turns is bends at v = w, as a map of g. The maps depend on x and on f(x) as separate arguments; a
derivative along x accounts for both.
"""

import operator
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import reduce
from typing import NamedTuple, Optional

import jax
import jax.numpy as jnp
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir

from jourdain_jax.calculus.compilation import with_usual_promotion
from jourdain_jax.calculus.derivative_errors import THIRD_ORDER_MESSAGE, DifferentiationModeError
from jourdain_jax.calculus.markers import lanes_of, with_lanes_first


@dataclass(frozen=True, eq=False)
class LinearMap:
    """A linear map of arrays, which also depends on other arrays, `at`."""

    apply: Callable[[Sequence, Sequence], list]  # (at, arrays) -> values
    shapes: Sequence[jax.ShapeDtypeStruct]  # of the values
    # the transpose at the same point; None: it does not exist, as beyond second order
    transposed: Callable[[], "LinearMap"] | None = None
    # (indices) -> derivative with respect to these arrays of `at`; its point is (*at, *arrays); None: by JAX
    along: Callable[[list[int]], Optional["LinearMap"]] = lambda _: None
    # whether `along` also takes the indices of `arrays`, after those of `at`
    jointly: bool = False

    def __call__(self, at: Sequence, arrays: Sequence) -> list:
        """Return the values of the map."""
        return linear_map_p.bind(*at, *arrays, linear=self, count=len(at))


def shapes(arrays: Sequence) -> list[jax.ShapeDtypeStruct]:
    """Return the shapes and types of arrays."""
    return [jax.ShapeDtypeStruct(x.shape, x.dtype) for x in arrays]


def no_further(*_):
    """Raise the error for an unsupported third derivative."""
    raise DifferentiationModeError(THIRD_ORDER_MESSAGE)


def put(values: Sequence, which: Sequence[int], new: Sequence) -> list:
    """Return the values with new ones at some indices."""
    found = list(values)
    for i, x in zip(which, new, strict=True):
        found[i] = x
    return found


def by_jax(own: LinearMap, count: int, which: list[int]) -> LinearMap:
    """Return the forward derivative of a map with respect to some of its arguments, the first `count` of
    which are its point.
    """

    def pushed(at, arrays):
        def moved(*new):
            every = put(at, which, new)
            return own.apply(every[:count], every[count:])

        return jax.jvp(moved, tuple(at[i] for i in which), tuple(arrays))[1]

    return LinearMap(pushed, own.shapes)


def _in_lanes(own: LinearMap, axes: list, count: int, size: int) -> LinearMap:
    """Return the map for a batch. `axes`: batch axis of each array of `at`; in the arrays that are mapped it
    comes first.
    """
    transposed, every = own.transposed, [*axes, *[0] * count]

    def along(which: list[int]) -> LinearMap | None:
        further = own.along(which)
        return further and _spread(
            _in_lanes(further, every, len(which), size), [every[i] for i in which], size
        )

    return LinearMap(
        lambda at, arrays: jax.vmap(own.apply, in_axes=(axes, 0), axis_size=size)(list(at), list(arrays)),
        [jax.ShapeDtypeStruct((size, *x.shape), x.dtype) for x in own.shapes],
        transposed and (lambda: _in_lanes(transposed(), axes, len(own.shapes), size)),
        along,
        own.jointly,
    )


def _spread(own: LinearMap, axes: list, size: int) -> LinearMap:
    """Return a second derivative whose arrays have the given batch axes (None: shared by all samples).

    `own`: the same derivative of arrays with the batch axis first.
    """
    transposed = own.transposed

    def gathered(arrays: Sequence) -> list:
        return [
            jnp.sum(x, 0) if axis is None else jnp.moveaxis(x, 0, axis)
            for x, axis in zip(arrays, axes, strict=True)
        ]

    def back() -> LinearMap:
        assert transposed is not None
        inner = transposed()
        return LinearMap(
            lambda at, g: gathered(inner.apply(at, g)),
            jax.eval_shape(gathered, inner.shapes),
            lambda: forth,
            inner.along,
        )

    forth = LinearMap(
        lambda at, arrays: own.apply(at, with_lanes_first(arrays, axes, size)),
        own.shapes,
        transposed and back,
        own.along,
    )
    return forth


def _batched(values, axes, *, linear: LinearMap, count: int):
    size = lanes_of(values, axes)
    arrays = with_lanes_first(values[count:], axes[count:], size)
    found = _in_lanes(linear, list(axes[:count]), len(arrays), size)(values[:count], arrays)
    return found, [0] * len(found)


def _pushed(values, tangents, *, linear: LinearMap, count: int):
    found, along = linear(values[:count], values[count:]), []
    which = [i for i, t in enumerate(tangents[:count]) if type(t) is not ad.Zero]
    if any(type(t) is not ad.Zero for t in tangents[count:]):
        if which and linear.jointly:  # one call of `apply` in place of two
            which += range(count, len(values))
        else:
            along.append(linear(values[:count], [ad.instantiate_zeros(t) for t in tangents[count:]]))
    if which:
        moving = [ad.instantiate_zeros(tangents[i]) for i in which]
        along.append((linear.along(which) or by_jax(linear, count, which))(values, moving))
    return found, [reduce(operator.add, parts) for parts in zip(*along, strict=True)]


def _pulled(cotangents, *values, linear: LinearMap, count: int):
    if linear.transposed is None:
        no_further()
    return [None] * count + linear.transposed()(
        values[:count], [ad.instantiate_zeros(ct) for ct in cotangents]
    )


@with_usual_promotion
def _evaluated(*values, linear: LinearMap, count: int) -> list:
    return list(linear.apply(values[:count], values[count:]))


linear_map_p = Primitive("jourdain_linear_map")


linear_map_p.multiple_results = True


linear_map_p.def_impl(_evaluated)


linear_map_p.def_abstract_eval(
    lambda *avals, linear, count: [
        avals[-1].update(shape=x.shape, dtype=x.dtype, weak_type=False) for x in linear.shapes
    ]
)


ad.primitive_jvps[linear_map_p] = _pushed


ad.primitive_transposes[linear_map_p] = _pulled


batching.primitive_batchers[linear_map_p] = _batched


mlir.register_lowering(linear_map_p, mlir.lower_fun(_evaluated, multiple_results=True))


class BothWays(NamedTuple):
    """Derivative of a function in both modes. Only the leaves with given indices vary; the others are fixed.
    `rates` and `pulled` take these indices and return a function:

        rates     (leaves, *tangents of the moving leaves) -> tangents of the real results
        pulled    (leaves, results, cotangents of the real results) -> cotangents of the moving leaves
    """

    rates: Callable[[list[int]], Callable]
    pulled: Callable[[list[int]], Callable]
    # indices of moving leaves -> why JAX cannot differentiate `pulled`; empty if it can
    reason_against_second: Callable[[list[int]], str]
    leaves: Sequence[jax.ShapeDtypeStruct]  # of the arguments
    found: Sequence[jax.ShapeDtypeStruct]  # of the results
    places: list[int]  # of the real numbers among the results

    def pushes(self, moving: list[int]) -> LinearMap:
        """Return the Jacobian-vector product as a linear map of the tangents of the moving leaves. The map
        also depends on the leaves and the result.
        """

        def pushed(at, along):
            return self.rates(moving)(list(at[: len(self.leaves)]), *along)

        return LinearMap(
            pushed,
            [self.found[i] for i in self.places],
            lambda: self._pulls(moving),
            lambda others: self._turns(moving, others),
            True,
        )

    def _pulls(self, moving: list[int]) -> LinearMap:
        def pulled(at, g):
            return self.pulled(moving)(at[: len(self.leaves)], at[len(self.leaves) :], g)

        return LinearMap(
            pulled,
            [self.leaves[i] for i in moving],
            lambda: self.pushes(moving),
            lambda others: self._bends(moving, others),
        )

    def _turns(self, moving: list[int], others: list[int]) -> LinearMap:
        """Return the derivative of Jacobian-vector products with respect to the leaves `others`, where
        indices beyond the results denote tangents. The derivative also depends on the tangents.
        """
        count = len(self.leaves) + len(self.found)
        leaves = [i for i in others if i < count]
        tangents = moving if len(leaves) < len(others) else []

        def pulled(at, g):
            back = self._bends(leaves, moving).apply([*at[:count], *g], at[count:])
            return back + (self._pulls(moving).apply(at[:count], g) if tangents else [])

        own = by_jax(self.pushes(moving), count, others)
        found = [self.leaves[i] for i in (*leaves, *tangents)]
        return replace(own, transposed=lambda: LinearMap(pulled, found, lambda: own, no_further))

    def _bends(self, moving: list[int], others: list[int]) -> LinearMap:
        """Return the derivative of vector-Jacobian products with respect to other leaves. The derivative also
        depends on the cotangents.
        """
        count, end = len(self.leaves), len(self.leaves) + len(self.found)
        if reason := self.reason_against_second([*moving, *others]):
            raise DifferentiationModeError(reason)

        def bent(at, along):
            leaves, found, g = list(at[:count]), at[count:end], at[end:]

            def pulled(new, numbers):
                return self.pulled(moving)(put(leaves, others, new), put(found, self.places, numbers), g)

            rates = self.rates(others)(leaves, *along)
            return jax.jvp(
                pulled,
                ([leaves[i] for i in others], [found[i] for i in self.places]),
                (list(along), list(rates)),
            )[1]

        return LinearMap(
            bent, [self.leaves[i] for i in moving], lambda: self._bends(others, moving), no_further
        )
