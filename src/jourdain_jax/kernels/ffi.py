"""Machine code as a function of JAX: the call frame of XLA's foreign function interface, registered handlers,
and distribution of lanes over threads.

Layouts are as in `xla/ffi/api/c_api.h` on 64-bit machines (major version 0). The header shipped with jaxlib
states its version. Another major version, or frames with other members, are not supported.

Machine code works in double precision. XLA converts arrays in single precision before and after a call, so
results are rounded once.
"""

import ctypes
import functools
import hashlib
import re
import threading
import warnings
from collections.abc import Callable, Iterator, Sequence
from itertools import groupby
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
from jax.interpreters import mlir

from jourdain_jax.kernels import host, nvidia
from jourdain_jax.kernels.ir import Value, Writer

HANDLER, KERNEL = "handler", "kernel"
# tuning: words per array passed to a GPU kernel (`gpu.py`), and maximum number of arrays
WORDS, MOST_BUFFERS = 4, 16
_LAYOUTS = {
    "CallFrame": "api ctx stage args rets attrs future",
    "Buffer": "dtype data rank dims",
    "Args": "size types args",
    "Rets": "size types rets",
    "Attrs": "size types names attrs",
    "Error_Create_Args": "message errc",
    "Stream_Get_Args": "ctx stream",
    "DeviceMemory_Allocate_Args": "ctx size alignment data",
    "DeviceMemory_Free_Args": "ctx size data",
}
# functions called here, by their place in the interface
FUNCTIONS = {0: "Error_Create", 4: "Stream_Get", 9: "DeviceMemory_Allocate", 10: "DeviceMemory_Free"}
# word indices of 8 bytes
ARGS, RETS = 9, 14  # code: of a frame: its lists of pointers to arguments and results

_REGISTERED: set[str] = set()  # names of handlers
_REGISTERING = threading.Lock()


@functools.cache
def version() -> tuple[int, int] | None:
    """Return major and minor version of the interface; None, with a warning, if it is unknown."""
    found = _stated_version()
    if found is None:
        warnings.warn(
            "this jaxlib has an unknown foreign function interface, so XLA integrates motions, which takes "
            "longer; install a supported version of jaxlib",
            stacklevel=2,
        )
    return found


def reason_against() -> str:
    """Return why machine code cannot be called here; empty if it can."""
    if (backend := jax.default_backend()) not in ("cpu", "gpu"):
        return f"it supports CPUs and NVIDIA GPUs, not JAX's backend {backend}"
    if reason := host.reason_against() if backend == "cpu" else nvidia.reason_against():
        return reason
    if version() is None:
        return "the foreign function interface of this jaxlib is unknown"
    return ""


def devices() -> str:
    """Return the devices of machine code as text for display; empty if the CPU is the only one."""
    return f": CPU; NVIDIA GPU ({nvidia.architecture()})" if jax.default_backend() == "gpu" else ""


def _stated_version() -> tuple[int, int] | None:
    try:
        header = (Path(jax.ffi.include_dir()) / "xla/ffi/api/c_api.h").read_text(encoding="utf-8")
    except OSError:
        return None
    numbers = [re.search(rf"#define XLA_FFI_API_{part} (\d+)", header) for part in ("MAJOR", "MINOR")]
    same = all(
        _members(header, struct) == f"struct_size extension_start {rest}" for struct, rest in _LAYOUTS.items()
    )
    functions = dict(enumerate(re.findall(r"_FIELD\(XLA_FFI_(\w+)\);", header)))
    if not (same and functions.items() >= FUNCTIONS.items()) or None in numbers:
        return None
    major, minor = (int(number[1]) for number in numbers if number)
    return (major, minor) if major == 0 else None


def _members(header: str, struct: str) -> str:
    found = re.search(rf"struct XLA_FFI_{struct} \{{(.*?)\n\}};", header, re.DOTALL)
    text = re.sub(r"//.*", "", found[1]) if found else ""
    return " ".join(re.findall(r"(\w+);", text))


class Given(NamedTuple):
    """An array that is passed to a handler."""

    data: Value  # pointer
    sizes: Value  # pointer to the sizes of its axes
    rank: Value


def last_size(w: Writer, x: Given) -> Value:
    """Return the size of the last axis."""
    return w.load(x.sizes, 0 if w.device else x.rank - 1, "i64")


def product(w: Writer, x: Given, but: int) -> Value:
    """Return the product of the sizes of all axes except the last `but` (1 or 3). A GPU loads the product
    that the host has computed.
    """
    if w.device:
        return w.load(x.sizes, (1, 3).index(but) + 1, "i64")
    total = w.room(type="i64")
    w.store(w.literal(1, "i64"), total)
    with w.counted(x.rank - but) as axis:
        w.store(w.load(total, type="i64") * w.load(x.sizes, axis, "i64"), total)
    return w.load(total, type="i64")


def write_handler(
    w: Writer, arguments: int, results: int, body: Callable[[list[Given], list[Given]], None]
) -> None:
    """Write a handler, or for a GPU a kernel, that calls `body` with all arguments and results."""
    if w.device:
        return _write_kernel(w, arguments, results, body)
    with w.function(HANDLER, "ptr", {"frame": "ptr"}, how="") as (frame,):
        answer_metadata(w, frame)
        arrays, returned = w.load(frame, ARGS, "ptr"), w.load(frame, RETS, "ptr")
        body(
            [given(w, w.load(arrays, k, "ptr")) for k in range(arguments)],
            [given(w, w.load(returned, k, "ptr")) for k in range(results)],
        )
        w.give(w.null)


def answer_metadata(w: Writer, frame: Value) -> None:
    """Answer a call that queries the version of the interface, and return from the handler."""
    known = version()
    assert known is not None
    extension = w.load(frame, 1, "ptr")
    with w.when(w.converted("ptrtoint", extension, "i64").differs(0)):
        asked = w.load(extension, 2, "i32").equals(1)  # type of an extension, in its second word
        with w.when(asked):
            metadata = w.load(extension, 3, "ptr")
            # major and minor version in the fourth word, then flags
            for place, number in enumerate((*known, 0), 6):
                w.store(w.literal(number, "i32"), metadata, place)
        w.give_where(asked, w.null)


def _write_kernel(
    w: Writer, arguments: int, results: int, body: Callable[[list[Given], list[Given]], None]
) -> None:
    """Write `kernel(words)`, which every thread of a GPU runs. Its last result is the lane
    counter; the words after it describe the record of steps.
    """
    with w.function(
        KERNEL, "void", {"words": f"ptr byval([{WORDS * MOST_BUFFERS} x i64]) align 8"}, how="ptx_kernel"
    ):
        words = Value(w, "ptr", "%words")
        each = [
            Given(w.load(words, WORDS * k, "ptr"), w.at(words, WORDS * k + 1, "i64"), words)
            for k in range(arguments + results + 2)
        ]
        counter, record = each[-2:]
        w.own = counter.data, record.data, last_size(w, record)
        body(each[:arguments], each[arguments:-2])
        w.give()


def given(w: Writer, buffer: Value) -> Given:
    """Return the array in a buffer that a handler receives."""
    # words of a buffer: type (2), data (3), rank (4), sizes (5)
    return Given(w.load(buffer, 3, "ptr"), w.load(buffer, 5, "ptr"), w.load(buffer, 4, "i64"))


def in_doubles(ctx: mlir.LoweringRuleContext, arguments: Sequence, call: Callable, *more) -> list:
    """Return the results of a `call` of machine code in a JAX program. Arrays in single precision are
    converted. `more`: abstract values of further results, which are dropped.
    """

    def converted(x, old, new):
        if old.dtype == new.dtype:
            return x
        convert = mlir.lower_fun(
            lambda x: jax.lax.convert_element_type_p.bind(
                x, new_dtype=new.dtype, weak_type=False, sharding=None
            ),
            multiple_results=False,
        )
        return convert(ctx.replace(primitive=None, avals_in=[old], avals_out=[new]), x)[0]

    taken, found = (
        [x.update(dtype=np.dtype(np.float64), weak_type=False) for x in avals]
        for avals in (ctx.avals_in, ctx.avals_out)
    )
    results = call(
        ctx.replace(primitive=None, avals_in=taken, avals_out=[*found, *more]),
        *map(converted, arguments, ctx.avals_in, taken),
    )
    return list(map(converted, results, found, ctx.avals_out))


def registered(text: str, effort: int = 2) -> str:
    """Register the handler of a module of LLVM IR and return its name; `effort`: as for
    `host.object_code`.
    """
    name = _name(text, effort)
    register(name, text, "cpu", effort)
    return name


def _name(text: str, effort: int) -> str:
    return f"jourdain_jax_{hashlib.sha256(f'{host.description()} {effort} {text}'.encode()).hexdigest()[:24]}"


def register(name: str, text: str, platform: str, effort: int = 2) -> None:
    """Register the handler of a module of LLVM IR under a name, once."""
    if name in _REGISTERED:
        return
    capsule = ctypes.pythonapi.PyCapsule_New
    capsule.restype, capsule.argtypes = ctypes.py_object, (ctypes.c_void_p, ctypes.c_char_p, ctypes.c_void_p)
    code = host.kept(_name(text, effort), host.description(), lambda: host.object_code(text, effort))
    with _REGISTERING:
        if name not in _REGISTERED:  # another thread may have registered it meanwhile
            jax.ffi.register_ffi_target(
                name,
                capsule(host.address(code, HANDLER), b"xla._CUSTOM_CALL_TARGET", None),
                platform=platform,
            )
            _REGISTERED.add(name)


# words of a job: index of the next row, number of rows, pointers to the given rows, to the returned rows, and
# to the given numbers that all lanes of a GPU share
NEXT, COUNT, IN, OUT, SHARED = range(5)


def start_counting(w: Writer, job: Value, word: int) -> None:
    """Reset the counter of lanes taken: a word of the job, or on a GPU the word to which the job points."""
    w.store(w.own[0] if w.device else w.literal(0, "i64"), job, word)


def next_lane(w: Writer, job: Value, word: int, lanes: int = 1) -> Value:
    """Take the next `lanes` lanes and return the index of the first."""
    return w.counted_up(*(w.load(job, word, "ptr"), 0) if w.device else (job, word), lanes)


def lanes_taken(w: Writer, job: Value, word: int) -> Value:
    """Return how many lanes have been taken, which may exceed their number."""
    counter = w.load(job, word, "ptr") if w.device else w.at(job, word, "i64")
    return w.instruction("i64", f"load atomic i64, ptr {counter.name} monotonic, align 8")  # others count


def share(w: Writer, job: Value, count: Value) -> None:
    """Call the module's `loop(job)` in up to `w.threads` threads, fewer for small batches."""
    threads = w.threads
    loop, nothing = Value(w, "ptr", "@loop"), w.null
    others, started = w.room(threads, "i64"), w.room(type="i64")
    w.store(w.literal(0, "i64"), started)
    how = w.room(16, "i64")  # a `pthread_attr_t`, which takes up to 64 bytes
    if threads > 1:
        w.external("pthread_attr_init", "i32", how)
        # 8 MB of stack per thread, as the main thread has on most systems; the default of macOS is 512 kB
        w.external("pthread_attr_setstacksize", "i32", how, w.literal(2**23, "i64"))
    for more in range(1, threads):
        # start another thread, which takes about 30 us, for every 8 vectors of lanes
        with w.when(count >= (more + 1) * 8 * w.lanes):
            number = w.load(started, type="i64")
            failed = w.external("pthread_create", "i32", w.at(others, number, "i64"), how, loop, job)
            w.store(number + w.where(failed.equals(0), w.literal(1, "i64"), 0), started)
    w.call("loop", "ptr", job)
    if threads > 1:
        with w.counted(w.load(started, type="i64")) as number:
            w.external("pthread_join", "i32", w.load(others, number, "i64"), nothing)


class OfLane(NamedTuple):
    """Numbers of one lane in an array of a batch: pointer to the first, and distance to the next."""

    first: Value
    apart: Value | int

    def place(self, number: Value | int) -> Value:
        """Return the pointer to the number with this index."""
        return self.first.writer.at(self.first, number if self.apart == 1 else number * self.apart, "double")

    def after(self, count: Value | int) -> "OfLane":
        """Return the numbers after the first `count`."""
        return OfLane(self.place(count), self.apart)


def of_lane(w: Writer, array: Value, count: Value, numbers: Value | int, lane: Value) -> OfLane:
    """Return the numbers of one of `count` lanes in an array. On a CPU they are contiguous. On a GPU lanes
    come last: neighbouring threads, which begin and save together, then access neighbouring words.
    """
    if w.device:
        return OfLane(w.at(array, lane, "double"), count)
    return OfLane(w.at(array, lane * numbers, "double"), 1)


def taken_in(w: Writer, count: int, numbers: OfLane, rows: Value, lane: Value) -> None:
    """Copy the first `count` numbers of a lane into its rows."""
    with w.counted(count) as row:
        w.store(w.load(numbers.place(row), type="double"), rows, row * w.lanes + lane)


def handed_out(w: Writer, count: int | Value, rows: Value, lane: Value, numbers: OfLane) -> None:
    """Copy the first `count` rows of a lane into its numbers."""
    with w.counted(count) as row:
        w.store(w.load(rows, row * w.lanes + lane, "double"), numbers.place(row))


def sources(
    w: Writer, rows: int, own: OfLane, shared: Value, first: int = 0
) -> Iterator[tuple[range, bool, OfLane]]:
    """Yield the rows of a lane's start as contiguous ranges, split at row `first`. For each range, also yield
    whether all lanes share it, and its source in memory. On a GPU, `shared` rows form an array of their own.
    """
    places = {False: 0, True: 0}
    for (is_shared, _), run in groupby(
        range(rows), lambda row: (bool(w.device and w.common[row]), row < first)
    ):
        some = [*run]
        source = (OfLane(shared, 1) if is_shared else own).after(places[is_shared])
        yield range(some[0], some[-1] + 1), is_shared, source
        places[is_shared] += len(some)


def write_rows(w: Writer, given: int, returned: int) -> None:
    """Write a handler that maps rows of `given` numbers to rows of `returned` numbers. The handler calls the
    module's `row(given, returned)` for several lanes at once.

    Lanes beyond the last row repeat that row, and its results.
    """
    with w.function("loop", "ptr", {"job": "ptr"}, attributes="noinline") as (job,):
        state, found = w.room(given), w.room(returned)
        rows, results, count = w.load(job, IN, "ptr"), w.load(job, OUT, "ptr"), w.load(job, COUNT, "i64")
        shared = w.load(job, SHARED, "ptr") if w.device else w.null
        with w.repeated() as leave:
            leave(~w.together(lanes_taken(w, job, NEXT) < count))
            first = next_lane(w, job, NEXT, w.lanes)
            each = [w.where(first + lane < count, first + lane, count - 1) for lane in range(w.lanes)]
            own, into = (
                [of_lane(w, array, count, numbers, lane) for lane in each]
                for array, numbers in ((rows, given), (results, returned))
            )
            # all lanes in one pass of a loop over rows
            for some in zip(*(sources(w, given, numbers, shared) for numbers in own), strict=True):
                begin = w.at(state, some[0][0].start)
                with w.counted(len(some[0][0])) as row:
                    for lane, (_, _, numbers) in enumerate(some):
                        w.store(w.load(numbers.place(row), type="double"), begin, row * w.lanes + lane)
            w.run("row", state, found)
            with w.counted(returned) as row:
                for lane, numbers in enumerate(into):
                    w.store(w.load(found, row * w.lanes + lane, "double"), numbers.place(row))
        w.give(w.null)

    def body(arguments: list[Given], results: list[Given]) -> None:
        job, count = w.room(5, "i64"), w.room(type="i64")
        w.store(product(w, results[0], 1), count)
        start_counting(w, job, NEXT)
        w.store(w.load(count, type="i64"), job, COUNT)
        w.store(arguments[0].data, job, IN)
        w.store(arguments[-1].data, job, SHARED)
        w.store(results[0].data, job, OUT)
        share(w, job, w.load(count, type="i64"))

    write_handler(w, 1 + w.device, 1, body)
