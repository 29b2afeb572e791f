"""Machine code as a function of JAX: the call frame of XLA's foreign function interface, and the registering of handlers.

Layouts are those of `xla/ffi/api/c_api.h` on 64-bit machines (major version 0). The header that comes with jaxlib says which version it speaks; another
major version, or a frame with other members, is one that is not known here.
"""

import ctypes
import functools
import hashlib
import re
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import jax

from jourdain_jax.native import disk, host
from jourdain_jax.native.ir import Value, Writer

HANDLER = "handler"
_FRAME = "struct_size extension_start api ctx stage args rets attrs future"
_BUFFER = "struct_size extension_start dtype data rank dims"
_LISTS = "struct_size extension_start size types"
# places, in words of 8 bytes
_EXTENSION, _ARGS, _RETS = 1, 9, 14  # of a frame: its extension, its lists of pointers to arguments and results
_DATA, _RANK, _DIMS = 3, 4, 5  # of a buffer
_KIND, _METADATA = 1, 3  # of an extension
_MAJOR = 3  # of metadata, with the minor version after it


@functools.cache
def version() -> tuple[int, int] | None:
    """Major and minor version of the interface; None, with a warning, where it is not known."""
    found = _stated_version()
    if found is None:
        warnings.warn("the foreign function interface of this jaxlib is not known: motions are integrated by XLA, more slowly", stacklevel=2)
    return found


def reason_against() -> str:
    """Why no machine code of our own can be called here; empty where it can."""
    if jax.default_backend() != "cpu":
        return "it is made for CPUs alone"
    if host.reason_against():
        return host.reason_against()
    if version() is None:
        return "the foreign function interface of this jaxlib is not known"
    if not jax.config.jax_enable_x64:
        return "it is made for double precision alone"
    return ""


def _stated_version() -> tuple[int, int] | None:
    try:
        header = (Path(jax.ffi.include_dir()) / "xla/ffi/api/c_api.h").read_text()
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


def write_handler(w: Writer, arguments: int, results: int, body: Callable[[list[Given], list[Value]], None]) -> None:
    """A handler that calls `body` with all arguments, and pointers to the data of all results."""
    known = version()
    assert known is not None
    with w.function(HANDLER, "ptr", {"frame": "ptr"}, how="") as (frame,):
        nothing = Value(w, "ptr", "null")
        extension = w.load("ptr", frame, _EXTENSION)
        asked, called = w.label(), w.label()
        is_asked = w.label()
        none = w.compared("eq", w.converted("ptrtoint", extension, "i64"), 0)
        w.go(called, none, is_asked)
        w.place(is_asked)
        w.go(asked, w.load("i32", extension, 2 * _KIND).equals(1), called)
        w.place(asked)
        metadata = w.load("ptr", extension, _METADATA)
        w.store(w.literal(known[0], "i32"), metadata, 2 * _MAJOR)
        w.store(w.literal(known[1], "i32"), metadata, 2 * _MAJOR + 1)
        w.store(w.literal(0, "i32"), metadata, 2 * _MAJOR + 2)
        w.give(nothing)
        w.place(called)
        given, returned = w.load("ptr", frame, _ARGS), w.load("ptr", frame, _RETS)
        inputs = [w.load("ptr", given, k) for k in range(arguments)]
        outputs = [w.load("ptr", returned, k) for k in range(results)]
        body(
            [Given(w.load("ptr", x, _DATA), w.load("ptr", x, _DIMS), w.load("i64", x, _RANK)) for x in inputs],
            [w.load("ptr", x, _DATA) for x in outputs],
        )
        w.give(nothing)


@functools.cache
def registered(text: str, effort: int = 2) -> str:
    """The name under which JAX calls the handler of a module of LLVM IR; `effort`: as of `host.object_code`."""
    name = f"jourdain_jax_{hashlib.sha256(f'{host.description()} {effort} {text}'.encode()).hexdigest()[:24]}"
    capsule = ctypes.pythonapi.PyCapsule_New
    capsule.restype, capsule.argtypes = ctypes.py_object, (ctypes.c_void_p, ctypes.c_char_p, ctypes.c_void_p)
    code = disk.kept(name, lambda: host.object_code(text, effort))
    jax.ffi.register_ffi_target(name, capsule(host.address(code, HANDLER), b"xla._CUSTOM_CALL_TARGET", None), platform="cpu")
    return name
