"""How many lanes of a batch run in lockstep.

A step of a batch lasts until its slowest lane has ended, and what a step touches should stay in a core's fastest cache: so few lanes at a time
are best, if a step of few lanes costs little beside its arithmetic. On a CPU it does where XLA compiles the whole loop over steps into one
function, which it does for loops that touch little memory (see `jourdain_jax`); otherwise every operation is started on its own, and many lanes
must share that cost.
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import PyTree

from jourdain_jax.lowering.lowered import Lowered

TOGETHER = 8  # lanes, where the loop is one function


def in_blocks(function: Callable, lanes_at_once: int, *trees: PyTree) -> PyTree:
    """`function` of trees whose arrays have a leading axis of lanes, some lanes at a time; the last block is filled up with copies."""
    arrays, rest = eqx.partition(trees, eqx.is_array)
    count = jax.tree.leaves(arrays)[0].shape[0]
    blocks = -(-count // lanes_at_once)
    if blocks == 1:
        return function(*trees)
    index = jnp.minimum(jnp.arange(blocks * lanes_at_once), count - 1).reshape(blocks, lanes_at_once)
    found = jax.lax.map(lambda arrays: function(*eqx.combine(arrays, rest)), jax.tree.map(lambda x: x[index], arrays))
    return jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:])[:count], found)


def width(program: Lowered) -> int:
    """Return how many lanes of a lowered scene run in lockstep."""
    # with more operations the loop touches too much memory to become one function (the bicycle, 2016, is still one)
    return TOGETHER if program.operations <= 3000 and jax.default_backend() == "cpu" else 2**30
