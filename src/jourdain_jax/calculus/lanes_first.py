"""Results with their axis of lanes first under `vmap`, where JAX has to be told which results have lanes and where."""

import jax
import jax.numpy as jnp
from jax.interpreters import ad, batching

from jourdain_jax.calculus.identities import identity


def lanes_first(tree):
    """The tree, unchanged; under `vmap` all its arrays get their axis of lanes first. Values without a tangent space pass."""
    leaves, treedef = jax.tree.flatten(tree)
    moved = [i for i, x in enumerate(leaves) if x.dtype != jax.dtypes.float0]
    for i, x in zip(moved, lanes_first_p.bind(*(leaves[i] for i in moved)) if moved else (), strict=True):
        leaves[i] = x
    return jax.tree.unflatten(treedef, leaves)


def lanes_of(values, axes) -> int:
    """How many lanes there are along those axes that arrays have, as a batching rule is given them; None: an array has none."""
    return next(x.shape[axis] for x, axis in zip(values, axes, strict=True) if axis is not None)


def with_lanes_first(values, axes, count: int | None = None) -> list:
    """The arrays with their lanes along the first axis; one without lanes is the same in all of so many (as many as the others have)."""
    count = lanes_of(values, axes) if count is None else count
    return [jnp.broadcast_to(x, (count, *x.shape)) if axis is None else jnp.moveaxis(x, axis, 0) for x, axis in zip(values, axes, strict=True)]


def _batched(values, axes):
    return lanes_first_p.bind(*with_lanes_first(values, axes)), [0] * len(values)


lanes_first_p = identity("jourdain_lanes_first")
ad.primitive_jvps[lanes_first_p] = lambda primals, tangents: (lanes_first_p.bind(*primals), list(tangents))
ad.primitive_transposes[lanes_first_p] = lambda cotangents, *values: list(cotangents)
batching.primitive_batchers[lanes_first_p] = _batched
