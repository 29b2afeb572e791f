"""Digests that tell one study from another, the same in every process: of numbers, texts, containers, scenes, and of functions by what they do.

A function counts by its code (byte code, constants, names), default arguments, what it closes over, and the globals that its code names; functions and
classes of installed packages and of this one by their name alone, since their versions are kept beside. So a changed function makes another study.
"""

import hashlib
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from functools import partial
from types import CodeType, FunctionType, MethodType, ModuleType

import jax
import numpy as np

from jourdain_jax.scene.what_is_read import is_installed

DEEPEST = 8  # functions that call functions


def digest(x: object) -> str:
    """A short text that changes with the content of `x`."""
    return hashlib.sha256(repr(_content(x, 0, set())).encode()).hexdigest()[:16]


def _content(x: object, depth: int, within: set[int]) -> object:
    if x is None or isinstance(x, bool | int | float | complex | str | bytes):
        return type(x).__name__, repr(x)
    if isinstance(x, jax.Array | np.ndarray | np.generic):
        array = np.asarray(x)
        return "array", array.dtype.str, array.shape, hashlib.sha256(np.ascontiguousarray(array).tobytes()).hexdigest()
    if depth > DEEPEST or id(x) in within:
        return "deeper", type(x).__qualname__
    within = within | {id(x)}

    def of(y: object) -> object:
        return _content(y, depth + 1, within)

    if isinstance(x, tuple | list):
        return type(x).__name__, tuple(map(of, x))
    if isinstance(x, set | frozenset):
        return "set", tuple(sorted(map(repr, map(of, x))))
    if isinstance(x, Mapping):
        return "mapping", tuple((of(key), of(value)) for key, value in x.items())
    if isinstance(x, partial):
        return "partial", of(x.func), of(x.args), of(x.keywords)
    if isinstance(x, MethodType):
        return "method", of(x.__func__), of(x.__self__)
    if isinstance(x, staticmethod | classmethod):
        return type(x).__name__, of(x.__func__)
    if isinstance(x, property):
        return "property", of(x.fget)
    if isinstance(x, CodeType):
        constants = tuple(of(y) for y in x.co_consts)
        return "code", x.co_code, constants, x.co_names, x.co_freevars
    if isinstance(x, ModuleType):
        return "module", x.__name__
    if isinstance(x, FunctionType):
        return _function(x, of)
    if isinstance(x, type):
        return _class(x, of)
    if callable(inner := getattr(x, "__wrapped__", None)):
        return "wrapped", of(inner)
    if is_dataclass(x):
        return of(type(x)), tuple((field.name, of(getattr(x, field.name, None))) for field in fields(x))
    members = getattr(x, "__dict__", None)
    return of(type(x)), of(members) if members and not is_installed(type(x).__module__) else None


def _function(f: FunctionType, of) -> object:
    if is_installed(f.__module__):
        return "function", f.__module__, f.__qualname__
    cells = tuple(of(_within(cell)) for cell in f.__closure__ or ())
    named = tuple((name, of(f.__globals__[name])) for name in sorted(_names_in(f.__code__)) if name in f.__globals__)
    return "function", of(f.__code__), of(f.__defaults__), of(f.__kwdefaults__), cells, named


def _within(cell) -> object:
    try:
        return cell.cell_contents
    except ValueError:  # not yet set
        return None


def _names_in(code: CodeType) -> set[str]:
    return set(code.co_names).union(*(_names_in(inner) for inner in code.co_consts if isinstance(inner, CodeType)))


def _class(kind: type, of) -> object:
    if is_installed(kind.__module__):
        return "class", kind.__module__, kind.__qualname__
    own = tuple((name, of(member)) for name, member in sorted(vars(kind).items()) if name == "__call__" or not name.startswith(("__", "_abc_")))
    return "class", kind.__qualname__, own, tuple(of(base) for base in kind.__bases__)
