"""Modules of LLVM IR as functions of JAX: arrays without lanes go in, and under `vmap` all lanes go to one call.

Many lanes run side by side in the widest registers; one by itself runs in narrow ones, in which an instruction takes less time. What a lane computes does
not depend on the width.
"""

from collections.abc import Callable, Sequence
from functools import cache

import jax
import jax.numpy as jnp
from jax.extend.core import Primitive
from jax.interpreters import batching, mlir
from jaxtyping import Array

from jourdain_jax.calculus.derivatives import OtherDeviceError
from jourdain_jax.calculus.markers import with_lanes_first
from jourdain_jax.native import ffi, gpu, host, nvidia
from jourdain_jax.native.ffi import write_rows
from jourdain_jax.native.ir import Writer
from jourdain_jax.native.scalar_program import as_real, written_in_turn
from jourdain_jax.program.graph import Graph


def called(write: Callable[[Writer], None], shapes: Callable, of_samples: int = 0, effort: int = 2) -> Callable:
    """A module of LLVM IR as a function of arrays without lanes; `shapes`: of its results, given the arguments.

    The first arguments are samples, which lanes may share; `effort`: as of `host.object_code`.
    """

    @cache
    def handler(lanes: int, threads: int) -> str:
        w = Writer(lanes, host.fuses(), threads)
        write(w)
        return ffi.registered(w.text, effort)

    @cache
    def kernel() -> gpu.Kernel:
        w = Writer(1, True, device=True)
        write(w)
        return gpu.registered(w.text, w.scratch)

    def call(lanes: int, threads: int, *arguments):
        return tuple(_call_p.bind(*arguments, handler=handler, kernel=kernel, lanes=lanes, threads=threads, shapes=shapes))

    @jax.custom_batching.custom_vmap
    def run(*arguments):
        # 2 places for the lanes of one motion; measured: 64 us with 2, 66 with 1 or 4, 99 with 8 (10 s of a disc at 1e-8)
        return call(2, 1, *arguments)

    @run.def_vmap
    def run_many(count, batched: list[bool], *arguments):
        stays = [has_axis or k < of_samples for k, has_axis in enumerate(batched)]
        every = [x if stay else jnp.broadcast_to(x, (count, *x.shape)) for x, stay in zip(arguments, stays, strict=True)]
        found = call(host.lanes(), host.threads(), *every)
        return found, (True,) * len(found)

    return run


def _results(*arguments, shapes: Callable, **_) -> list:
    return [arguments[-1].update(shape=(*arguments[-1].shape[:-1], *shape), weak_type=False) for shape in shapes(*arguments)]


def on_cpu(ctx: mlir.LoweringRuleContext, *arguments, handler: Callable, lanes: int, threads: int, **_):
    """The call in a program for the CPU."""
    _check_here(ctx)
    return ffi.in_doubles(ctx, arguments, jax.ffi.ffi_lowering(handler(lanes, threads)))


def _on_nvidia(ctx: mlir.LoweringRuleContext, *arguments, kernel: Callable, **_):
    """The call in a program for an NVIDIA GPU."""
    _check_here(ctx)
    if reason := nvidia.reason_against():
        raise OtherDeviceError(f"for JAX's platform cuda, and {reason}")
    return gpu.lowered(ctx, arguments, kernel())


def _nowhere(ctx: mlir.LoweringRuleContext, *_, **__):
    """The error of a program for any other device."""
    raise OtherDeviceError(f"for JAX's platforms {', '.join(ctx.module_context.platforms)}")


def _check_here(ctx: mlir.LoweringRuleContext) -> None:
    """Raise an error for a program that may run in another process."""
    if ctx.module_context.lowering_parameters.for_export:
        raise OtherDeviceError("to be exported")
    if len(ctx.module_context.platforms) > 1:
        _nowhere(ctx)


# The call itself: machine code is made where a program is lowered that holds it, not for what is only traced.
_call_p = Primitive("jourdain_machine_code")
_call_p.multiple_results = True
_HOW = "handler", "kernel", "lanes", "threads", "shapes"
_call_p.def_impl(jax.jit(lambda *arguments, **how: _call_p.bind(*arguments, **how), static_argnames=_HOW))
_call_p.def_abstract_eval(_results)
mlir.register_lowering(_call_p, _nowhere)
mlir.register_lowering(_call_p, on_cpu, platform="cpu")
mlir.register_lowering(_call_p, _on_nvidia, platform="cuda")
batching.primitive_batchers[_call_p] = lambda values, axes, **how: (found := _call_p.bind(*with_lanes_first(values, axes), **how), [0] * len(found))


def nodes_called(graph: Graph, nodes: Sequence[int], variables: Sequence[int], effort: int = 1) -> Callable[[Array], Array]:
    """Values of nodes of a graph as a function of the values of the variables."""

    def write(w: Writer) -> None:
        with w.procedure("row", "state found") as (state, found):
            known = {n: w.load(state, k) for k, n in enumerate(variables)}
            for k, value in written_in_turn(w, graph, nodes, known):
                w.store(as_real(w, value), found, k)
        write_rows(w, len(variables), len(nodes))

    kernel = called(write, lambda *_: ((len(nodes),),), effort=effort)
    return lambda x: kernel(x)[0]
