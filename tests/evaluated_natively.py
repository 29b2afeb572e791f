"""A scalar program as a function of JAX, evaluated at many points by machine code."""

from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jourdain_jax.native import ffi, host
from jourdain_jax.native.ir import Value, Writer
from jourdain_jax.native.scalar_program import as_real, written
from jourdain_jax.program.graph import Graph


def function(graph: Graph, outputs: Sequence[int], inputs: Sequence[int]) -> Callable[[Float[Array, "points inputs"]], Float[Array, "points outputs"]]:
    """Values of the outputs, truth values as 0 or 1, given those of the inputs."""
    assert not host.reason_against()  # it makes LLVM and C's library known
    outputs, inputs = list(outputs), list(inputs)
    w = Writer(host.lanes(), host.fuses())

    def block(arguments: list[ffi.Given], found: list[Value]) -> None:
        (points,) = arguments
        count = w.load(points.sizes, type="i64")
        given, results = w.room(len(inputs)), w.room(len(outputs))
        first = w.room(type="i64")
        w.store(w.literal(0, "i64"), first)
        with w.repeated() as leave:
            begin = w.load(first, type="i64")
            leave(begin >= count)
            for lane in range(w.lanes):
                point = begin + lane
                inside = w.where(point < count, point, count - 1)  # the last point fills up
                for k in range(len(inputs)):
                    w.store(w.load(points.data, inside * len(inputs) + k, "double"), given, k * w.lanes + lane)
            values = written(w, graph, outputs, {n: w.load(given, k) for k, n in enumerate(inputs)})
            for k, value in enumerate(values):
                w.store(as_real(w, value), results, k)
            for lane in range(w.lanes):
                with w.when(begin + lane < count):
                    for k in range(len(outputs)):
                        w.store(w.load(results, k * w.lanes + lane, "double"), found[0], (begin + lane) * len(outputs) + k)
            w.store(begin + w.lanes, first)

    ffi.write_handler(w, 1, 1, block)
    name = ffi.registered(w.text)
    return lambda points: jax.ffi.ffi_call(name, jax.ShapeDtypeStruct((len(points), len(outputs)), jnp.float64))(jnp.asarray(points, jnp.float64))
