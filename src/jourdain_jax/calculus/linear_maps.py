"""Linear functions whose values one function works out, and the values of their transpose another one: one derivative in forward and in reverse mode.

JAX meets such a map where a derivative was taken. Forward mode evaluates it, reverse mode transposes it, and neither traces what only the other one needs.
"""

import operator
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import reduce
from typing import Optional

import jax
import jax.numpy as jnp
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir

from jourdain_jax.calculus.guards import THIRD_ORDER_MESSAGE, DifferentiationModeError
from jourdain_jax.calculus.lanes_first import lanes_of, with_lanes_first
from jourdain_jax.calculus.promotion import with_usual_promotion


@dataclass(frozen=True, eq=False)
class LinearMap:
    """A linear function of arrays that depends on others, `at` which it is taken."""

    apply: Callable[[Sequence, Sequence], list]  # (at, arrays)
    shapes: Sequence[jax.ShapeDtypeStruct]  # of its values
    transposed: Callable[[], "LinearMap"] | None = None  # at the same; None: an error says that this is no derivative of the first two orders
    along: Callable[[list[int]], Optional["LinearMap"]] = lambda _: None  # those of `at` that change -> derivative, also at the arrays; None: JAX's

    def __call__(self, at: Sequence, arrays: Sequence) -> list:
        """Its values."""
        return linear_map_p.bind(*at, *arrays, linear=self, count=len(at))


def shapes(arrays: Sequence) -> list[jax.ShapeDtypeStruct]:
    """Shapes of arrays, with their types."""
    return [jax.ShapeDtypeStruct(x.shape, x.dtype) for x in arrays]


def no_further(*_):
    """Tells that there is no such third derivative."""
    raise DifferentiationModeError(THIRD_ORDER_MESSAGE)


def put(values: Sequence, which: Sequence[int], new: Sequence) -> list:
    """The values, with new ones at some places."""
    found = list(values)
    for i, x in zip(which, new, strict=True):
        found[i] = x
    return found


def by_jax(own: LinearMap, count: int, which: list[int]) -> LinearMap:
    """The derivative of a map along those of so many arrays that it is taken at, in forward mode."""

    def pushed(at, arrays):
        return jax.jvp(lambda *new: own.apply(put(at[:count], which, new), at[count:]), tuple(at[i] for i in which), tuple(arrays))[1]

    return LinearMap(pushed, own.shapes)


def _in_lanes(own: LinearMap, axes: list, count: int, size: int) -> LinearMap:
    """That of lanes side by side, along these axes of what it is taken at, and along the first axis of the arrays, of which there are so many."""
    transposed = own.transposed

    def along(which: list[int]) -> LinearMap | None:
        further = own.along(which)
        return further and _spread(_in_lanes(further, [*axes, *[0] * count], len(which), size), [axes[i] for i in which], size)

    return LinearMap(
        lambda at, arrays: jax.vmap(own.apply, in_axes=(axes, 0), axis_size=size)(list(at), list(arrays)),
        [jax.ShapeDtypeStruct((size, *x.shape), x.dtype) for x in own.shapes],
        transposed and (lambda: _in_lanes(transposed(), axes, len(own.shapes), size)),
        along,
    )


def _spread(own: LinearMap, axes: list, size: int) -> LinearMap:
    """A second derivative, of arrays with their lanes along these axes, or the same in all lanes, in place of arrays with their lanes first."""
    transposed = own.transposed

    def gathered(arrays: Sequence) -> list:
        return [jnp.sum(x, 0) if axis is None else jnp.moveaxis(x, 0, axis) for x, axis in zip(arrays, axes, strict=True)]

    def back() -> LinearMap:
        assert transposed is not None
        inner = transposed()
        return LinearMap(lambda at, g: gathered(inner.apply(at, g)), jax.eval_shape(gathered, inner.shapes), lambda: forth, inner.along)

    forth = LinearMap(lambda at, arrays: own.apply(at, with_lanes_first(arrays, axes, size)), own.shapes, transposed and back, own.along)
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
        along.append(linear(values[:count], [ad.instantiate_zeros(t) for t in tangents[count:]]))
    if which:
        along.append((linear.along(which) or by_jax(linear, count, which))(values, [tangents[i] for i in which]))
    return found, [reduce(operator.add, parts) for parts in zip(*along, strict=True)]


def _pulled(cotangents, *values, linear: LinearMap, count: int):
    if linear.transposed is None:
        no_further()
    return [None] * count + linear.transposed()(values[:count], [ad.instantiate_zeros(ct) for ct in cotangents])


@with_usual_promotion
def _evaluated(*values, linear: LinearMap, count: int) -> list:
    return list(linear.apply(values[:count], values[count:]))


linear_map_p = Primitive("jourdain_linear_map")
linear_map_p.multiple_results = True
linear_map_p.def_impl(_evaluated)
linear_map_p.def_abstract_eval(lambda *avals, linear, count: [avals[-1].update(shape=x.shape, dtype=x.dtype, weak_type=False) for x in linear.shapes])
ad.primitive_jvps[linear_map_p] = _pushed
ad.primitive_transposes[linear_map_p] = _pulled
batching.primitive_batchers[linear_map_p] = _batched
mlir.register_lowering(linear_map_p, mlir.lower_fun(_evaluated, multiple_results=True))
