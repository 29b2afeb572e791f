"""A loop of a program run by JAX: one `scan`, whose body is one round, however many rounds there are."""

from collections.abc import Callable, Sequence
from itertools import pairwise

import jax
import jax.numpy as jnp
from jax import lax

from jourdain_jax.program.fused import fused
from jourdain_jax.program.loop_rerolling import Before, Given, Here, Loop, sources

UNROLLED = 2  # rounds that follow one another without a jump; measured: one is slower, four compile to more functions


class Values(dict):
    """Values of nodes; those of a loop are kept in one array per operation, and taken out when they are asked for."""

    def __init__(self, known) -> None:
        super().__init__(known)
        self._kept: dict[int, tuple[jax.Array, int]] = {}

    def __missing__(self, node: int) -> jax.Array:
        array, k = self._kept[node]
        self[node] = value = array[k]
        return value

    def keep(self, nodes: Sequence[int], array: jax.Array) -> None:
        """The values of the nodes, along the first axis of an array."""
        self._kept |= {node: (array, k) for k, node in enumerate(nodes)}

    def stacked(self, nodes: Sequence[int], shape: tuple[int, ...], real) -> jax.Array:
        """The values of the nodes along a new first axis: part of an array that is kept, where they follow one another in it."""
        places = [self._kept[n] for n in nodes if n in self._kept]
        steps = {b[1] - a[1] for a, b in pairwise(places)}
        if len(places) == len(nodes) and steps in ({1}, {-1}) and all(array is places[0][0] for array, _ in places):
            low, high = sorted((places[0][1], places[-1][1]))
            part = jnp.broadcast_to(jnp.moveaxis(places[0][0][low : high + 1], 0, -1), (*shape, len(nodes)))
            return jnp.moveaxis(part, -1, 0)[:: steps.pop()].astype(real)
        return jnp.stack([jnp.broadcast_to(jnp.asarray(self[n], real), shape) for n in nodes])


def run_loop(loop: Loop, values: Values, wanted: set[int], operation: Callable) -> None:
    """Add the wanted nodes of a loop to the values; `operation(op, key, arguments, waves)` computes one of them."""
    outside = sources(loop)
    shape = jnp.broadcast_shapes(*(jnp.shape(values[n]) for n in outside))
    real = jnp.result_type(*([values[n] for n in outside if isinstance(values[n], jax.Array)] or [float]))
    slots = {slot: None for slots in loop.arguments for slot in slots}
    carried = [s for s in slots if isinstance(s, Before)]
    stacked = [s for s in slots if isinstance(s, Given) and len(set(s.nodes)) > 1]
    fixed = {s: values[s.nodes[0]] for s in slots if isinstance(s, Given) and len(set(s.nodes)) == 1}
    kept = [k for k, nodes in enumerate(loop.nodes.T.tolist()) if not wanted.isdisjoint(nodes)]

    def body(carry, given):
        at = fixed | dict(zip(carried, carry, strict=True)) | dict(zip(stacked, given, strict=True))
        waves = {}
        for k, (op, arguments) in enumerate(zip(loop.ops, loop.arguments, strict=True)):
            at[Here(k)] = operation(op, arguments, [at[a] for a in arguments], waves)
        places = list(dict.fromkeys([*(s.place for s in carried), *kept]))
        found = fused(tuple(jnp.broadcast_to(jnp.asarray(at[Here(k)], real), shape) for k in places))
        here = dict(zip(places, found, strict=True))
        return tuple(here[s.place] for s in carried), tuple(here[k] for k in kept)

    first = tuple(jnp.broadcast_to(jnp.asarray(values[s.first], real), shape) for s in carried)
    given = tuple(values.stacked(s.nodes, shape, real) for s in stacked)
    _, found = lax.scan(body, first, given, length=len(loop.nodes), unroll=UNROLLED)
    for k, array in zip(kept, found, strict=True):
        values.keep(loop.nodes[:, k].tolist(), array)
