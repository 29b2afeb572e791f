"""Machine code as a function of JAX: the call frame of XLA's foreign function interface, and the registering of handlers.

Layouts are those of `xla/ffi/api/c_api.h` on 64-bit machines (major version 0). The header that comes with jaxlib says which version it speaks; another
major version, or a frame with other members, is one that is not known here.

Machine code works on doubles. Arrays in single precision are converted where a call begins and ends, so that their results are rounded once.
"""

import ctypes
import functools
import hashlib
import math
import re
import threading
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import jax

from jourdain_jax.native import disk, host, nvidia
from jourdain_jax.native.ir import Value, Writer

HANDLER, KERNEL = "handler", "kernel"
WORDS, MOST_BUFFERS = 4, 16  # what a kernel of a GPU is told of each array (`gpu.py`), and of how many arrays at most
FIRST_OF_SCRATCH = 8  # double of a kernel's own memory that is not the counter
_FRAME = "struct_size extension_start api ctx stage args rets attrs future"
_BUFFER = "struct_size extension_start dtype data rank dims"
_LISTS = "struct_size extension_start size types"
# places, in words of 8 bytes
ARGS, RETS = 9, 14  # of a frame: its lists of pointers to arguments and results

_REGISTERED: set[str] = set()  # names of handlers
_REGISTERING = threading.Lock()


@functools.cache
def version() -> tuple[int, int] | None:
    """Major and minor version of the interface; None, with a warning, where it is not known."""
    found = _stated_version()
    if found is None:
        warnings.warn("the foreign function interface of this jaxlib is not known: motions are integrated by XLA, more slowly", stacklevel=2)
    return found


def reason_against() -> str:
    """Why no machine code of our own can be called here; empty where it can."""
    if (backend := jax.default_backend()) not in ("cpu", "gpu"):
        return f"it is made for CPUs and NVIDIA GPUs, not for JAX's backend {backend}"
    if reason := host.reason_against() if backend == "cpu" else nvidia.reason_against():
        return reason
    if version() is None:
        return "the foreign function interface of this jaxlib is not known"
    return ""


def _stated_version() -> tuple[int, int] | None:
    try:
        header = (Path(jax.ffi.include_dir()) / "xla/ffi/api/c_api.h").read_text(encoding="utf-8")
    except OSError:
        return None
    numbers = [re.search(rf"#define XLA_FFI_API_{part} (\d+)", header) for part in ("MAJOR", "MINOR")]
    same = _members(header, "CallFrame") == _FRAME and _members(header, "Buffer") == _BUFFER
    same = same and _members(header, "Args") == f"{_LISTS} args" and _members(header, "Rets") == f"{_LISTS} rets"
    if not same or None in numbers:
        return None
    major, minor = (int(number[1]) for number in numbers if number)
    return (major, minor) if major == 0 else None


def _members(header: str, struct: str) -> str:
    found = re.search(rf"struct XLA_FFI_{struct} \{{(.*?)\n\}};", header, re.DOTALL)
    text = re.sub(r"//.*", "", found[1]) if found else ""
    return " ".join(re.findall(r"(\w+);", text))


class Given(NamedTuple):
    """An argument of a handler."""

    data: Value  # pointer
    sizes: Value  # pointer to the sizes of its axes
    rank: Value


def last_size(w: Writer, x: Given) -> Value:
    """The size of the last axis."""
    return w.load("i64", x.sizes, 0 if w.device else x.rank - 1)


def product(w: Writer, x: Given, but: int) -> Value:
    """The product of the sizes of all axes but the last ones, 1 or 3 of them on a GPU, where the host has found it."""
    if w.device:
        return w.load("i64", x.sizes, (1, 3).index(but) + 1)
    total = w.room("i64")
    w.store(w.literal(1, "i64"), total)
    with w.counted(0, x.rank - but) as axis:
        w.store(w.load("i64", total) * w.load("i64", x.sizes, axis), total)
    return w.load("i64", total)


def write_handler(w: Writer, arguments: int, results: int, body: Callable[[list[Given], list[Value]], None]) -> None:
    """A handler that calls `body` with all arguments, and pointers to the data of all results; on a GPU the kernel that does so."""
    if w.device:
        return _write_kernel(w, arguments, results, body)
    _write_doubles(w)
    _write_rounded(w)
    with w.function(HANDLER, "ptr", {"frame": "ptr"}, how="") as (frame,):
        nothing = Value(w, "ptr", "null")
        answer_metadata(w, frame)
        arrays, returned = w.load("ptr", frame, ARGS), w.load("ptr", frame, RETS)
        inputs = [w.load("ptr", arrays, k) for k in range(arguments)]
        outputs = [w.load("ptr", returned, k) for k in range(results)]
        failed = w.room("i64")
        w.store(w.literal(0, "i64"), failed)
        taken = [w.call("doubles", "ptr", x, w.literal(1, "i1"), failed) for x in inputs]
        found = [w.call("doubles", "ptr", x, w.literal(0, "i1"), failed) for x in outputs]
        with w.when(w.load("i64", failed).equals(0)):
            body([given(w, x)._replace(data=data) for x, data in zip(inputs, taken, strict=True)], found)
        for buffers, pointers, are_results in ((inputs, taken, 0), (outputs, found, 1)):
            for x, data in zip(buffers, pointers, strict=True):
                w.call("rounded", "void", x, data, w.literal(are_results, "i1"), failed)
        w.give(nothing)


def answer_metadata(w: Writer, frame: Value) -> None:
    """Where the frame asks for the version of the interface, says it and returns."""
    known = version()
    assert known is not None
    extension = w.load("ptr", frame, 1)
    asked, called = w.label(), w.label()
    is_asked = w.label()
    none = w.compared("eq", w.converted("ptrtoint", extension, "i64"), 0)
    w.go(called, none, is_asked)
    w.place(is_asked)
    w.go(asked, w.load("i32", extension, 2).equals(1), called)  # the kind of an extension, in its second word
    w.place(asked)
    metadata = w.load("ptr", extension, 3)
    for place, number in enumerate((*known, 0), 6):  # major and minor version in the fourth word, then flags
        w.store(w.literal(number, "i32"), metadata, place)
    w.give(Value(w, "ptr", "null"))
    w.place(called)


def _write_kernel(w: Writer, arguments: int, results: int, body: Callable[[list[Given], list[Value]], None]) -> None:
    """`kernel(words)`, which every thread of a GPU runs; the last result is memory of the call's own."""
    with w.function(KERNEL, "void", {"words": f"ptr byval([{WORDS * MOST_BUFFERS} x i64]) align 8"}, how="ptx_kernel"):
        words = Value(w, "ptr", "%words")
        each = [Given(w.load("ptr", words, WORDS * k), w.at(words, WORDS * k + 1, "i64"), words) for k in range(arguments + results + 1)]
        w.own = each[-1].data, last_size(w, each[-1])
        body(each[:arguments], [x.data for x in each[arguments:-1]])
        w.give()


def given(w: Writer, buffer: Value) -> Given:
    """What a handler is given of an array."""
    # words of a buffer: 2 the type, 3 the data, 4 the rank, 5 the sizes
    return Given(w.load("ptr", buffer, 3), w.load("ptr", buffer, 5), w.load("i64", buffer, 4))


def _is_single(w: Writer, buffer: Value) -> Value:
    # 11: the type of arrays in single precision
    return w.load("i32", buffer, 4).equals(11)


def _write_doubles(w: Writer) -> None:
    """`doubles(buffer, filled, failed)`: its data; of an array in single precision, memory for as many doubles, `filled` with them or not.

    As `rounded`, it is not optimised: that takes LLVM 20 ms for each kernel, and makes no motion faster by more than noise.
    """
    with w.function("doubles", "ptr", {"buffer": "ptr", "filled": "i1", "failed": "ptr"}, attributes="noinline optnone") as (buffer, filled, failed):
        x, data = given(w, buffer), w.room("ptr")
        w.store(x.data, data)
        with w.when(_is_single(w, buffer)):
            count = product(w, x, 0)
            new = w.external("malloc", "ptr", (count + 1) * 8)
            w.store(new, data)
            there = w.converted("ptrtoint", new, "i64").differs(0)
            with w.when(~there):
                w.store(w.literal(1, "i64"), failed)
            with w.when(there & filled), w.counted(0, count) as k:
                w.store(w.converted("fpext", w.load("float", x.data, k), "double"), new, k)
        w.give(w.load("ptr", data))


def _write_rounded(w: Writer) -> None:
    """`rounded(buffer, doubles, is_result, failed)`: puts a result into an array in single precision, NaN where memory failed, and frees its doubles."""
    arguments = {"buffer": "ptr", "doubles": "ptr", "is_result": "i1", "failed": "ptr"}
    with w.function("rounded", "void", arguments, attributes="noinline optnone") as (buffer, doubles, is_result, failed):
        x = given(w, buffer)
        with w.when(_is_single(w, buffer)):
            there = w.load("i64", failed).equals(0)
            with w.when(is_result), w.counted(0, product(w, x, 0)) as k:
                value = w.room("double")
                w.store(w.literal(math.nan, "double"), value)
                with w.when(there):
                    w.store(w.load("double", doubles, k), value)
                w.store(w.converted("fptrunc", w.load("double", value), "float"), x.data, k)
            w.external("free", "void", doubles)
        w.give()


def registered(text: str, effort: int = 2) -> str:
    """The name under which JAX calls the handler of a module of LLVM IR; `effort`: as of `host.object_code`."""
    name = _name(text, effort)
    register(name, text, "cpu", effort)
    return name


def _name(text: str, effort: int) -> str:
    return f"jourdain_jax_{hashlib.sha256(f'{host.description()} {effort} {text}'.encode()).hexdigest()[:24]}"


def register(name: str, text: str, platform: str, effort: int = 2) -> None:
    """Registers the handler of a module of LLVM IR under a name, once."""
    if name in _REGISTERED:
        return
    capsule = ctypes.pythonapi.PyCapsule_New
    capsule.restype, capsule.argtypes = ctypes.py_object, (ctypes.c_void_p, ctypes.c_char_p, ctypes.c_void_p)
    code = disk.kept(_name(text, effort), host.description(), lambda: host.object_code(text, effort))
    with _REGISTERING:
        if name not in _REGISTERED:  # by another thread meanwhile
            jax.ffi.register_ffi_target(name, capsule(host.address(code, HANDLER), b"xla._CUSTOM_CALL_TARGET", None), platform=platform)
            _REGISTERED.add(name)
