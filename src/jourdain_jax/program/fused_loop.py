"""Several values of one shape, computed in one loop over their elements. Their shared parts are
computed once.

XLA on CPUs makes a separate loop for each result of a program and repeats shared parts in each, but it makes
one loop for a reduction over several operands. Therefore each value is padded with a zero, and all are summed
over value and zero in one reduction. JAX treats this as the identity, which is linear and elementwise.
"""

import jax.numpy as jnp
from jax import lax
from jax.interpreters import ad, batching, mlir

from jourdain_jax.calculus.markers import identity


def fused(values: tuple) -> tuple:
    """Return the given real values unchanged, but computed in one loop. All must have the same
    shape and type.
    """
    return values if len(values) < 2 else tuple(fused_p.bind(*values))


def _reduced_with_zeros(*values):
    beside = [lax.pad(x[None], jnp.zeros((), x.dtype), [(0, 1, 0), *[(0, 0, 0)] * x.ndim]) for x in values]
    zeros = [jnp.zeros((), x.dtype) for x in values]
    return lax.reduce(beside, zeros, lambda a, b: [x + y for x, y in zip(a, b, strict=True)], (0,))


def _jvp(primals, tangents):
    return fused_p.bind(*primals), fused_p.bind(*(ad.instantiate_zeros(t) for t in tangents))


def _transpose(cotangents, *_):
    return [ad.instantiate_zeros(c) for c in cotangents]


def _batched(values, axes):
    # values shared by all samples stay without a batch axis, because a derivative rule must not add one that
    # the values lack
    alike = fused(tuple(x for x, axis in zip(values, axes, strict=True) if axis is None))
    lanes = fused(
        tuple(jnp.moveaxis(x, axis, 0) for x, axis in zip(values, axes, strict=True) if axis is not None)
    )
    found = {None: iter(alike), 0: iter(lanes)}
    new_axes = [None if axis is None else 0 for axis in axes]
    return [next(found[axis]) for axis in new_axes], new_axes


fused_p = identity("fused")
ad.primitive_jvps[fused_p] = _jvp
ad.primitive_transposes[fused_p] = _transpose
batching.primitive_batchers[fused_p] = _batched
mlir.register_lowering(fused_p, mlir.lower_fun(_reduced_with_zeros, multiple_results=True), platform="cpu")
