"""Kernels of NVIDIA GPUs as functions of JAX. A handler on the host, compiled for the CPU, launches each
kernel on XLA's stream.

One handler serves all kernels. A call carries the number of its kernel, and a table of this process maps the
number to the loaded kernel. The kernel receives four words for each array: its address, the size of the last
axis, and two products of sizes, of all axes but the last one and of all but the last three. The last result
is the lane counter of the call. Layouts are as in `ffi.py`.

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
from jourdain_jax.kernels.ir import Writer
from jourdain_jax.kernels.ir_value import Value

_TARGET = "jourdain_jax_on_gpu"
MOST_KERNELS = 4096  # tuning: per process
_NUMBER, _FUNCTION, _WORDS = range(3)  # word indices of a table entry, and number of words
# words of the interface
_CREATE_ERROR, _GET_STREAM, _ALLOCATE, _FREE = (6 + place for place in ffi.FUNCTIONS)

# the last entry is empty; a program with the number of a kernel unknown to this process finds this entry
_table = (ctypes.c_uint64 * (_WORDS * (MOST_KERNELS + 1)))()
_loading = threading.RLock()
_kernels: dict[int, nvidia.Loaded] = {}


class Kernel(NamedTuple):
    """A loaded kernel, ready to be called."""

    number: int
    loaded: nvidia.Loaded
    record: tuple[int, int]  # as `Writer.record`


def handler_text() -> str:
    """Return the LLVM IR of the handler."""
    w = Writer(1, False)
    _write_described(w)
    with w.function(ffi.HANDLER, "ptr", {"frame": "ptr"}, how="") as (frame,):
        ffi.answer_metadata(w, frame)
        # words of a frame: interface (2), context (3), attributes (20); the size of a list is two
        # words before it
        nothing, attributes, context = w.null, w.load(frame, 20, "ptr"), w.load(frame, 3, "i64")
        blocks, number, most, slot = (
            w.load(w.load(w.load(attributes, k, "ptr"), 1, "ptr"), type="i64") for k in range(4)
        )
        words, count = w.room(ffi.WORDS * ffi.MOST_BUFFERS, "i64"), w.room(type="i64")
        w.store(w.literal(0, "i64"), count)
        for of, buffers in ((ffi.ARGS - 2, ffi.ARGS), (ffi.RETS - 2, ffi.RETS)):
            with w.counted(w.load(frame, of, "i64")) as k:
                place = w.load(count, type="i64")
                w.run(
                    "described",
                    w.load(w.load(frame, buffers, "ptr"), k, "ptr"),
                    w.at(words, place * ffi.WORDS, "i64"),
                )
                w.store(place + 1, count)
        record = w.at(words, w.load(count, type="i64") * ffi.WORDS, "i64")
        table, entry = Value(w, "ptr", "@jourdain_jax_kernels"), w.room(type="i64")
        w.declare("jourdain_jax_kernels", "@jourdain_jax_kernels = external global i64")
        w.store(w.literal(0, "i64"), entry)
        with w.repeated() as leave:
            place = w.load(entry, type="i64")
            leave(w.load(table, place, "i64").equals(number) | place.equals(_WORDS * MOST_KERNELS))
            w.store(place + _WORDS, entry)
        function = w.load(table, w.load(entry, type="i64") + _FUNCTION, "ptr")

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
        with w.when(slot.differs(0) & w.load(code, type="i32").equals(0)):
            needed = w.larger(w.load(tries, type="double"), 1.0)
            slots = w.converted("fptosi", w.smaller(needed, w.converted("sitofp", most, "double")), "i64")
            w.store(slots * slot, size)
            w.store(asked(_ALLOCATE, context, slots * slot, 16, 0), record)
            w.store(slots, record, 1)
        parameters = w.room(type="ptr")
        w.store(words, parameters)
        shape = [w.converted("trunc", blocks, "i32"), one, one, w.literal(nvidia.WARP, "i32"), one, one, zero]
        done("cuLaunchKernel", function, *shape, stream, parameters, nothing)
        # XLA reuses this memory only for later work on the same stream
        with w.when(w.load(size, type="i64").differs(0)):
            asked(_FREE, context, w.load(size, type="i64"), w.load(record, type="i64"))
        with w.when(w.load(code, type="i32").differs(0)):
            message = w.room(type="ptr")
            w.external("cuGetErrorString", "i32", w.load(code, type="i32"), message)
            # out of memory in the driver is XLA's RESOURCE_EXHAUSTED, any other error INTERNAL
            kind = w.where(w.load(code, type="i32").equals(2), w.literal(8, "i64"), 13)
            asked(_CREATE_ERROR, w.load(message, type="i64"), kind)
        w.give(nothing)
    return w.text


def _write_described(w: Writer) -> None:
    """Write `described(buffer, words)`, which fills in the words that describe an array to a kernel."""
    with w.function("described", "void", {"buffer": "ptr", "words": "ptr"}) as (buffer, words):
        x = ffi.given(w, buffer)
        told = (
            w.converted("ptrtoint", x.data, "i64"),
            ffi.last_size(w, x),
            ffi.product(w, x, 1),
            ffi.product(w, x, 3),
        )
        for word, value in enumerate(told):
            w.store(value, words, word)
        w.give()


def _handler() -> str:
    """Return the name under which JAX calls kernels, registering the handler on first use."""
    for name in nvidia.CALLED_BY_HANDLER:
        host.llvm.add_symbol(name, ctypes.cast(getattr(nvidia.driver(), name), ctypes.c_void_p).value)
    host.llvm.add_symbol("jourdain_jax_kernels", ctypes.addressof(_table))
    ffi.register(_TARGET, handler_text(), "CUDA")
    return _TARGET


def registered(text: str, record: tuple[int, int]) -> Kernel:
    """Return the kernel of a module of LLVM IR."""
    made_by = f"{host.llvm.llvm_version_info} {nvidia.architecture()}"
    digest = hashlib.sha256(f"{made_by} {text}".encode())
    number = int.from_bytes(digest.digest()[:7], "big") + 1  # fits a signed 64-bit integer
    with _loading:
        if number not in _kernels:
            if len(_kernels) == MOST_KERNELS:
                raise RuntimeError(
                    f"this process has compiled {MOST_KERNELS} GPU kernels, the maximum; start a new process"
                )
            ptx = host.kept(
                f"jourdain_jax_{digest.hexdigest()[:24]}",
                made_by,
                lambda: nvidia.text_for(text, nvidia.architecture()).encode(),
            )
            _kernels[number] = found = nvidia.loaded(ptx, ffi.KERNEL)
            place = _WORDS * (len(_kernels) - 1)
            _table[place + _FUNCTION] = found.function
            _table[place + _NUMBER] = number
    return Kernel(number, _kernels[number], record)


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
    layouts = {
        "operand_layouts": [
            _lanes_last(aval.ndim, len(batch) * has_lanes)
            for aval, has_lanes in zip(ctx.avals_in, own, strict=True)
        ],
        "result_layouts": [*(_lanes_last(aval.ndim, len(batch)) for aval in ctx.avals_out), (0,)],
    }
    attributes = {
        "blocks": blocks,
        "kernel": kernel.number,
        "most_slots": slots // blocks,  # of a thread
        "slot": 8 * nvidia.WARP * blocks * slot,  # bytes of one slot of all threads
    }
    call = partial(
        jax.ffi.ffi_lowering(_handler(), **layouts), **{name: np.int64(x) for name, x in attributes.items()}
    )
    return ffi.in_doubles(ctx, arguments, call, counter)
