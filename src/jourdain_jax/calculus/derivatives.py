"""Functions whose values and derivatives come from separate computations: an equivalent function or explicit
rules.

First and second derivatives of f(x) in both modes come from two functions that JAX differentiates forward:

    pushes   w -> f'(x) w                          pulls   g -> g f'(x)
    turns    v -> f''(x)(v, w)                     bends   v -> g f''(x)(., v)

Pulls transpose pushes. Because f'' is symmetric, bends along v transpose bends, and they transpose turns
along w = v. The maps depend on x and on f(x) as separate arguments; a derivative along x accounts for both.

Each is a linear map: one function computes its values, another the values of its transpose. Forward mode
evaluates the map, reverse mode transposes it, and neither traces what only the other needs.

A function and its rule must agree on which results have a batch axis and where, because JAX assumes the
layout of whichever is batched first.
"""

import operator
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial, reduce
from typing import NamedTuple, Optional

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir

from jourdain_jax.calculus.markers import lanes_first, lanes_of, with_lanes_first
from jourdain_jax.calculus.reals import with_usual_promotion

SECOND_ORDER_MESSAGE = (
    "`simulate` was differentiated twice with reverse mode in it (jax.hessian, grad of grad), which only "
    "machine code supports; with XLA, dense matrices or a diffrax solver, use `jax.jacfwd(jax.jacfwd(f))`"
)
THIRD_ORDER_MESSAGE = (
    "`simulate` was differentiated three times, not in forward mode alone; pass backend='xla' and use "
    "forward mode, `jax.jacfwd(jax.jacfwd(jax.jacfwd(f)))`"
)


class DifferentiationModeError(TypeError):
    """A motion has no derivative of the requested mode and order; the text names a supported one.

    Raised where the derivative is taken, evaluated or compiled, and by functions that need concrete numbers,
    such as `fit`, inside `jit`, `vmap` or a derivative.
    """


class OtherDeviceError(RuntimeError):
    """Raised if machine code would become part of a program for another process or for an unsupported device."""

    def __init__(self, program: str) -> None:
        super().__init__(
            f"machine code of this process cannot be part of a program {program}; pass "
            '`backend="xla"` to `jj.simulate` or `jj.build`'
        )


@dataclass(frozen=True, eq=False)
class LinearMap:
    """Linear map between arrays that depends on other arrays, `at`."""

    apply: Callable[[Sequence, Sequence], list]  # (at, arrays)
    shapes: Sequence[jax.ShapeDtypeStruct]  # shapes of its values
    # at the same point; None: raises an error, as beyond second order
    transposed: Callable[[], "LinearMap"] | None = None
    # (indices of `at` that change) -> derivative, which also depends on the arrays; None: use JAX's
    along: Callable[[list[int]], Optional["LinearMap"]] = lambda _: None

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
    """Return the forward derivative of a map with respect to some of its first `count` arguments."""

    def pushed(at, arrays):
        return jax.jvp(
            lambda *new: own.apply(put(at[:count], which, new), at[count:]),
            tuple(at[i] for i in which),
            tuple(arrays),
        )[1]

    return LinearMap(pushed, own.shapes)


def _in_lanes(own: LinearMap, axes: list, count: int, size: int) -> LinearMap:
    """Return the map for a batch. `axes`: batch axis of each array of `at`; tangents have it first."""
    transposed = own.transposed

    def along(which: list[int]) -> LinearMap | None:
        further = own.along(which)
        return further and _spread(
            _in_lanes(further, [*axes, *[0] * count], len(which), size), [axes[i] for i in which], size
        )

    return LinearMap(
        lambda at, arrays: jax.vmap(own.apply, in_axes=(axes, 0), axis_size=size)(list(at), list(arrays)),
        [jax.ShapeDtypeStruct((size, *x.shape), x.dtype) for x in own.shapes],
        transposed and (lambda: _in_lanes(transposed(), axes, len(own.shapes), size)),
        along,
    )


def _spread(own: LinearMap, axes: list, size: int) -> LinearMap:
    """Return a second derivative with batch axes at the given places (None: shared by all samples), from one
    with the batch axis first.
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
        along.append(linear(values[:count], [ad.instantiate_zeros(t) for t in tangents[count:]]))
    if which:
        along.append(
            (linear.along(which) or by_jax(linear, count, which))(values, [tangents[i] for i in which])
        )
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
    """Linear map for both modes of differentiation. Its argument has the form of `leaves`, its value the form
    of `found`, with real numbers at the `places`.
    """

    # indices of moving leaves -> function of the leaves and their tangents that returns tangents of the
    # numbers
    rates: Callable[[list[int]], Callable]
    # indices of moving leaves -> function of leaves, results and cotangents of the numbers that returns
    # cotangents of the leaves
    pulled: Callable[[list[int]], Callable]
    # indices of moving leaves -> why JAX cannot differentiate `pulled`; empty if it can
    reason_against_second: Callable[[list[int]], str]
    leaves: Sequence[jax.ShapeDtypeStruct]
    found: Sequence[jax.ShapeDtypeStruct]
    places: list[int]

    def pushes(self, moving: list[int]) -> LinearMap:
        """Return the map of tangents of the leaves, at the leaves and the result."""

        def pushed(at, along):
            return self.rates(moving)(list(at[: len(self.leaves)]), *along)

        return LinearMap(
            pushed,
            [self.found[i] for i in self.places],
            lambda: self._pulls(moving),
            lambda others: self._turns(moving, others),
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
        """Return the derivative of Jacobian-vector products with respect to other leaves. It also depends on
        the tangents.
        """
        count = len(self.leaves) + len(self.found)

        def pulled(at, g):
            return self._bends(others, moving).apply([*at[:count], *g], at[count:])

        own = by_jax(self.pushes(moving), count, others)
        return replace(
            own,
            transposed=lambda: LinearMap(pulled, [self.leaves[i] for i in others], lambda: own, no_further),
        )

    def _bends(self, moving: list[int], others: list[int]) -> LinearMap:
        """Return the derivative of vector-Jacobian products with respect to other leaves. It also depends on
        the cotangents.
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


class Rules(NamedTuple):
    """Derivative rules of a function. Trees of tangents and cotangents have None for zeros. A rule that does
    not apply raises an error with the reason.
    """

    push: Callable  # (arguments, tangents) -> result and its tangents; JAX differentiates it forward
    # (perturbed, arguments, result, cotangents) -> cotangents of the arguments that vary; JAX differentiates
    # it forward
    pull: Callable
    # (*perturbed) -> why JAX cannot differentiate `pull`; empty if it can
    reason_against_second: Callable[..., str] = lambda *_: ""


class _Leaves(NamedTuple):
    """Arguments of a function, split into arrays and the rest."""

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
    """Return whether a tangent is zero, as passed to a rule with symbolic zeros."""
    return isinstance(tangent, SymbolicZero) or tangent.dtype == jax.dtypes.float0


def filled(tangent):
    """Return the tangent as an array."""
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


def pushed_by_jax(run: Callable) -> Callable:
    """Return the `push` rule of a function that JAX differentiates forward."""

    def push(arguments: tuple, tangents: tuple):
        moving, fixed = eqx.partition(
            arguments, jax.tree.map(lambda d: d is not None, tangents, is_leaf=lambda d: d is None)
        )
        return jax.jvp(lambda moving: run(*eqx.combine(moving, fixed)), (moving,), (tangents,))

    return push


def by_modes(forward: Callable, reverse: Callable, reason_against_second: str) -> Callable:
    """Return `forward`, differentiated by JAX in forward mode, with the reverse mode of the equivalent
    `reverse`.

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
    """Return `run`, which JAX cannot differentiate, with derivatives by rules: both modes, to second order.

    It takes trees of arrays and other objects, and returns trees of arrays.
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
            """Return cotangents of the moving leaves as a function of leaves, result and cotangents of its
            numbers.
            """
            varies = perturbed(moving)

            def cotangents(leaves, ends, given):
                g = jax.tree.unflatten(structure, put([None] * len(ends), places, given))
                by_rules = rules.pull(varies, of.whole(leaves), jax.tree.unflatten(structure, ends), g)
                return jax.tree.leaves(eqx.filter(by_rules, varies))  # rules may return more

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
    """Return the tangents of the whole result from the tangents of its numbers."""
    left = iter(rates)
    return jax.tree.map(
        lambda x: next(left) if _is_number(x) else np.zeros(x.shape, jax.dtypes.float0), found
    )


def _is_number(x) -> bool:
    return jnp.issubdtype(x.dtype, jnp.inexact)
