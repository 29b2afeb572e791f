"""Kernels of NVIDIA GPUs as functions of JAX. A handler on the host, compiled for the CPU, launches each
kernel on XLA's stream.

One handler serves all kernels. A call has the number of its kernel, and a table of this process maps the
number to the loaded kernel. The kernel receives four words for each array: its address, the size of the last
axis, and two products of sizes, of all axes but the last one and of all but the last three. The last result
is scratch memory of the call: a lane counter, and memory that threads need beyond their own. Layouts are as
in `ffi.py`.
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
MOST_KERNELS = 4096  # per process
_NUMBER, _FUNCTION, _WORDS = range(3)  # word indices of a table entry, and number of words
_BLOCKS, _KERNEL = range(2)  # attributes, in the order of their names

# the last entry is empty; a program with the number of a kernel unknown to this process finds this entry
_table = (ctypes.c_uint64 * (_WORDS * (MOST_KERNELS + 1)))()
_loading = threading.RLock()
_kernels: dict[int, nvidia.Loaded] = {}


class Kernel(NamedTuple):
    """Kernel that can be called."""

    number: int
    loaded: nvidia.Loaded
    scratch: tuple[int, int]  # as `Writer.scratch`


def handler_text() -> str:
    """Return the LLVM IR of the handler."""
    w = Writer(1, False)
    _write_described(w)
    with w.function(ffi.HANDLER, "ptr", {"frame": "ptr"}, how="") as (frame,):
        ffi.answer_metadata(w, frame)
        # words of a frame: 2 the interface, 3 the context, 20 the attributes; sizes of lists come two words
        # before
        nothing, attributes = w.null, w.load(frame, 20, "ptr")
        blocks, number = (
            w.load(w.load(w.load(attributes, k, "ptr"), 1, "ptr"), type="i64") for k in (_BLOCKS, _KERNEL)
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
        scratch = w.load(words, (w.load(count, type="i64") - 1) * ffi.WORDS, "i64")
        table, entry = Value(w, "ptr", "@jourdain_jax_kernels"), w.room(type="i64")
        w.declare("jourdain_jax_kernels", "@jourdain_jax_kernels = external global i64")
        w.store(w.literal(0, "i64"), entry)
        with w.repeated() as leave:
            place = w.load(entry, type="i64")
            leave(w.load(table, place, "i64").equals(number) | place.equals(_WORDS * MOST_KERNELS))
            w.store(place + _WORDS, entry)
        function = w.load(table, w.load(entry, type="i64") + _FUNCTION, "ptr")
        api, asked = w.load(frame, 2, "ptr"), w.room(4, "i64")
        for word, value in enumerate(
            (w.literal(32, "i64"), w.literal(0, "i64"), w.load(frame, 3, "i64"), w.literal(0, "i64"))
        ):
            w.store(value, asked, word)
        failed = w.call(w.load(api, 10, "ptr"), "ptr", asked)  # `XLA_FFI_Stream_Get`
        w.give_where(w.converted("ptrtoint", failed, "i64").differs(0), failed)
        stream, code, parameters = w.load(asked, 3, "ptr"), w.room(type="i32"), w.room(type="ptr")
        w.store(words, parameters)
        w.store(
            w.external("cuMemsetD32Async", "i32", scratch, w.literal(0, "i32"), w.literal(2, "i64"), stream),
            code,
        )
        one, zero = w.literal(1, "i32"), w.literal(0, "i32")
        with w.when(w.load(code, type="i32").equals(0)):
            shape = [
                w.converted("trunc", blocks, "i32"),
                one,
                one,
                w.literal(nvidia.WARP, "i32"),
                one,
                one,
                zero,
            ]
            w.store(w.external("cuLaunchKernel", "i32", function, *shape, stream, parameters, nothing), code)
        with w.when(w.load(code, type="i32").differs(0)):
            message, error = w.room(type="ptr"), w.room(4, "i64")
            w.external("cuGetErrorString", "i32", w.load(code, type="i32"), message)
            # out of memory in the driver is XLA's RESOURCE_EXHAUSTED, any other error INTERNAL
            kind = w.where(w.load(code, type="i32").equals(2), w.literal(8, "i64"), 13)
            for word, value in enumerate(
                (w.literal(28, "i64"), w.literal(0, "i64"), w.load(message, type="i64"), kind)
            ):
                w.store(value, error, word)
            w.give(w.call(w.load(api, 6, "ptr"), "ptr", error))  # `XLA_FFI_Error_Create`
            w.place(w.label())
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
    for name in ("cuMemsetD32Async", "cuLaunchKernel", "cuGetErrorString"):
        host.llvm.add_symbol(name, ctypes.cast(getattr(nvidia.driver(), name), ctypes.c_void_p).value)
    host.llvm.add_symbol("jourdain_jax_kernels", ctypes.addressof(_table))
    ffi.register(_TARGET, handler_text(), "CUDA")
    return _TARGET


def registered(text: str, scratch: tuple[int, int]) -> Kernel:
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
    return Kernel(number, _kernels[number], scratch)


def _lanes_last(rank: int, lanes: int) -> tuple[int, ...]:
    """Return the order of an array's axes in memory, the fastest first. The first `lanes` axes are faster
    than all others.
    """
    return (*reversed(range(lanes)), *reversed(range(lanes, rank)))


def lowered(
    ctx: mlir.LoweringRuleContext, arguments: Sequence, kernel: Kernel, batch: tuple[int, ...], samples: int
) -> list:
    """Return the call of a kernel for a batch. Batch axes come last in memory, except in the first `samples`
    arguments.
    """
    lanes = math.prod(batch)
    slot, allowed = kernel.scratch
    # number of scratch slots of all threads, in at most an eighth of the device's memory
    slots = max(1, min(allowed, nvidia.memory() // 8) // (8 * nvidia.WARP * max(slot, 1)))
    blocks = max(1, min(nvidia.blocks(lanes, kernel.loaded), slots))  # a grid needs at least one block
    each = min(4096, slots // blocks)  # slots per thread
    scratch = ctx.avals_out[0].update(
        shape=(ffi.FIRST_OF_SCRATCH + blocks * nvidia.WARP * slot * each,),
        dtype=np.dtype(np.float64),
        weak_type=False,
    )
    # arrays without batch axes have one axis, whose layout is unique
    own = [aval.shape[: len(batch)] == batch and k >= samples for k, aval in enumerate(ctx.avals_in)]
    layouts = {
        "operand_layouts": [
            _lanes_last(aval.ndim, len(batch) * has_lanes)
            for aval, has_lanes in zip(ctx.avals_in, own, strict=True)
        ],
        "result_layouts": [*(_lanes_last(aval.ndim, len(batch)) for aval in ctx.avals_out), (0,)],
    }
    call = partial(
        jax.ffi.ffi_lowering(_handler(), **layouts), blocks=np.int64(blocks), kernel=np.int64(kernel.number)
    )
    return ffi.in_doubles(ctx, arguments, call, scratch)
