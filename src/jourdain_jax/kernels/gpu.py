"""Kernels of NVIDIA GPUs as functions of JAX. For each kernel, a handler on the host, compiled for the CPU,
launches it on XLA's stream.

The kernel receives four words for each array: its address, the size of the last axis, and two products of
sizes, of all axes but the last one and of all but the last three. The last result is the lane counter of the
call. Layouts are as in `ffi.py`.

In reverse mode a kernel keeps a record of steps. Its size follows from the number of trial steps of the
motions, which the forward call has counted: the handler waits for that number and allocates the record by
XLA's allocator.
"""

import ctypes
import hashlib
import math
import threading
from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import jax
import numpy as np
from jax.interpreters import mlir

from jourdain_jax.kernels import ffi, host, nvidia
from jourdain_jax.kernels.ir import Value, Writer

# words of the interface
_CREATE_ERROR, _GET_STREAM, _ALLOCATE, _FREE = (6 + place for place in ffi.FUNCTIONS)

_loading = threading.RLock()
_kernels: dict[str, nvidia.Loaded] = {}


class Kernel(NamedTuple):
    """A loaded kernel, ready to be called."""

    name: str  # of its handler
    loaded: nvidia.Loaded
    record: tuple[int, int]  # as `Writer.record`


def handler_text(name: str) -> str:
    """Return the LLVM IR of the handler of the kernel with this name."""
    w = Writer(1, False)
    with w.function(ffi.HANDLER, "ptr", {"frame": "ptr"}, how="") as (frame,):
        ffi.answer_metadata(w, frame)
        # words of a frame: interface (2), context (3), attributes (20); the size of a list is two
        # words before it
        attributes, context = w.load(frame, 20, "ptr"), w.load(frame, 3, "i64")
        blocks, most, slot = (
            w.load(w.load(w.load(attributes, k, "ptr"), 1, "ptr"), type="i64") for k in range(3)
        )
        words, count = w.room(ffi.WORDS * ffi.MOST_BUFFERS, "i64"), w.room(type="i64")
        w.store(w.literal(0, "i64"), count)
        for of, buffers in ((ffi.ARGS - 2, ffi.ARGS), (ffi.RETS - 2, ffi.RETS)):
            with w.counted(w.load(frame, of, "i64")) as k:
                place = w.load(count, type="i64")
                x = ffi.given(w, w.load(w.load(frame, buffers, "ptr"), k, "ptr"))
                address = w.converted("ptrtoint", x.data, "i64")
                told = address, ffi.last_size(w, x), ffi.product(w, x, 1), ffi.product(w, x, 3)
                for word, value in enumerate(told):
                    w.store(value, words, place * ffi.WORDS + word)
                w.store(place + 1, count)
        record = w.at(words, w.load(count, type="i64") * ffi.WORDS, "i64")
        w.declare(name, f"@{name} = external global i64")

        def asked(of_interface: int, *fields: Value | int) -> Value:
            """Call a function of XLA and return the last field of its arguments. If it fails, the handler
            returns its error.
            """
            last, struct = len(fields) + 1, w.room(len(fields) + 2, "i64")
            for word, value in enumerate((8 * (last + 1), 0, *fields)):
                w.store(w.literal(value, "i64"), struct, word)
            failed = w.call(w.load(w.load(frame, 2, "ptr"), of_interface, "ptr"), "ptr", struct)
            w.give_where(w.converted("ptrtoint", failed, "i64").differs(0), failed)
            return w.load(struct, last, "i64")

        stream, code = w.converted("inttoptr", asked(_GET_STREAM, context, 0), "ptr"), w.room(type="i32")
        w.store(w.literal(0, "i32"), code)

        def done(function: str, *arguments: Value) -> None:
            """Call a function of the driver, unless an earlier call failed."""
            with w.when(w.load(code, type="i32").equals(0)):
                w.store(w.external(function, "i32", *arguments), code)

        one, zero = w.literal(1, "i32"), w.literal(0, "i32")
        counter, halves = w.load(record, -ffi.WORDS, "i64"), w.literal(2, "i64")
        done("cuMemsetD32Async", counter, zero, halves, stream)
        tries, size = w.room(type="double"), w.room(type="i64")
        w.store(w.literal(0, "i64"), size)
        with w.when(slot.differs(0)):
            # the number of trial steps is the last argument, which is on the device
            returned = w.load(frame, ffi.RETS - 2, "i64")
            of_tries = w.load(record, (returned + 1) * -ffi.WORDS, "i64")
            done("cuMemcpyDtoHAsync_v2", tries, of_tries, w.literal(8, "i64"), stream)
            done("cuStreamSynchronize", stream)
            with w.when(w.load(code, type="i32").equals(0)):
                needed = w.larger(w.load(tries, type="double"), 1.0)
                slots = w.converted("fptosi", w.smaller(needed, w.converted("sitofp", most, "double")), "i64")
                w.store(slots * slot, size)
                w.store(asked(_ALLOCATE, context, slots * slot, 16, 0), record)
                w.store(slots, record, 1)
        parameters = w.room(type="ptr")
        w.store(words, parameters)
        shape = [w.converted("trunc", blocks, "i32"), one, one, w.literal(nvidia.WARP, "i32"), one, one, zero]
        done("cuLaunchKernel", Value(w, "ptr", f"@{name}"), *shape, stream, parameters, w.null)
        # XLA reuses this memory only for later work on the same stream
        with w.when(w.load(size, type="i64").differs(0)):
            asked(_FREE, context, w.load(size, type="i64"), w.load(record, type="i64"))
        with w.when(w.load(code, type="i32").differs(0)):
            message = w.room(type="ptr")
            w.external("cuGetErrorString", "i32", w.load(code, type="i32"), message)
            # out of memory in the driver is XLA's RESOURCE_EXHAUSTED, any other error INTERNAL
            kind = w.where(w.load(code, type="i32").equals(2), w.literal(8, "i64"), 13)
            asked(_CREATE_ERROR, w.load(message, type="i64"), kind)
        w.give(w.null)
    return w.text


def registered(text: str, record: tuple[int, int]) -> Kernel:
    """Return the kernel of a module of LLVM IR."""
    made_by = f"{host.llvm.llvm_version_info} {nvidia.architecture()}"
    name = f"jourdain_jax_{hashlib.sha256(f'{made_by} {text}'.encode()).hexdigest()[:24]}"
    with _loading:
        if name not in _kernels:
            ptx = host.kept(name, made_by, lambda: nvidia.text_for(text, nvidia.architecture()).encode())
            _kernels[name] = found = nvidia.loaded(ptx, ffi.KERNEL)
            for function in nvidia.CALLED_BY_HANDLER:
                pointer = ctypes.cast(getattr(nvidia.driver(), function), ctypes.c_void_p)
                host.llvm.add_symbol(function, pointer.value)
            host.llvm.add_symbol(name, found.function)
            ffi.register(name, handler_text(name), "CUDA", effort=0)
    return Kernel(name, _kernels[name], record)


def _lanes_last(rank: int, lanes: int) -> tuple[int, ...]:
    """Return the axes of an array in their order in memory, the fastest first. The first `lanes` axes are
    faster than all others.
    """
    return (*reversed(range(lanes)), *reversed(range(lanes, rank)))


def lowered(
    ctx: mlir.LoweringRuleContext, arguments: Sequence, kernel: Kernel, batch: tuple[int, ...], samples: int
) -> list:
    """Return the call of a kernel for a batch. Batch axes come last in memory, except in the first `samples`
    arguments.
    """
    lanes = math.prod(batch)
    slot, allowed = kernel.record
    # the most slots of a thread, if there were one block, in at most an eighth of the device's memory
    slots = max(1, min(allowed, nvidia.memory() // 8) // (8 * nvidia.WARP * max(slot, 1)))
    blocks = max(1, min(nvidia.blocks(lanes, kernel.loaded), slots))  # a grid needs at least one block
    counter = ctx.avals_out[0].update(shape=(1,), dtype=np.dtype(np.float64), weak_type=False)
    # arrays without batch axes have one axis, whose layout is unique
    own = [aval.shape[: len(batch)] == batch and k >= samples for k, aval in enumerate(ctx.avals_in)]
    call = jax.ffi.ffi_lowering(
        kernel.name,
        operand_layouts=[
            _lanes_last(aval.ndim, len(batch) * has_lanes)
            for aval, has_lanes in zip(ctx.avals_in, own, strict=True)
        ],
        result_layouts=[*(_lanes_last(aval.ndim, len(batch)) for aval in ctx.avals_out), (0,)],
    )
    call = partial(
        call,
        blocks=np.int64(blocks),
        most_slots=np.int64(slots // blocks),  # of a thread
        slot=np.int64(8 * nvidia.WARP * blocks * slot),  # bytes of one slot of all threads
    )
    return ffi.in_doubles(ctx, arguments, call, counter)
