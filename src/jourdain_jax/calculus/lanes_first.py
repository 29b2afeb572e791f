"""Arrays whose axis of lanes comes first, all of them, wherever JAX's batching left it.

To JAX this is the identity. A function and its rule of differentiation must agree on which results have lanes and where: JAX takes that from the one that it
batches first.
"""

import jax
import jax.numpy as jnp
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir


def lanes_first(tree):
    """The tree, unchanged; under `vmap` all its arrays get their axis of lanes first. Values without a tangent space pass."""
    leaves, treedef = jax.tree.flatten(tree)
    moved = [i for i, x in enumerate(leaves) if x.dtype != jax.dtypes.float0]
    for i, x in zip(moved, lanes_first_p.bind(*(leaves[i] for i in moved)) if moved else (), strict=True):
        leaves[i] = x
    return jax.tree.unflatten(treedef, leaves)


def _batched(values, axes):
    count = next(x.shape[axis] for x, axis in zip(values, axes, strict=True) if axis is not None)
    first = [jnp.broadcast_to(x, (count, *x.shape)) if axis is None else jnp.moveaxis(x, axis, 0) for x, axis in zip(values, axes, strict=True)]
    return lanes_first_p.bind(*first), [0] * len(first)


lanes_first_p = Primitive("jourdain_lanes_first")
lanes_first_p.multiple_results = True
lanes_first_p.def_impl(lambda *values: list(values))
lanes_first_p.def_abstract_eval(lambda *avals: list(avals))
ad.primitive_jvps[lanes_first_p] = lambda primals, tangents: (lanes_first_p.bind(*primals), list(tangents))
batching.primitive_batchers[lanes_first_p] = _batched
mlir.register_lowering(lanes_first_p, mlir.lower_fun(lambda *values: list(values), multiple_results=True))
