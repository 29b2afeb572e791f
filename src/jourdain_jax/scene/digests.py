"""Digests of numbers, texts, containers, scenes and functions. A digest is the same in every process. Digests
identify studies: a study with a changed function is a different study.

The digest of a user's function covers its code (byte code, constants, names), default arguments, closed-over
values, and the globals that its code names, including those in the user's other modules. A function or class
of this package or of an installed one is identified by its name, since a study stores the versions of
packages. The closed-over values of a function from a wrapper, such as `jax.grad`, are covered too. Other
objects are digested by their pickled content.
"""

import copyreg
import hashlib
import sys
from collections.abc import Iterator, Mapping
from dataclasses import fields, is_dataclass
from types import CodeType, FunctionType, MethodType, ModuleType

import jax
import numpy as np

from jourdain_jax.calculus.code import is_installed, names_in, names_of
from jourdain_jax.scene.scene import Scene


def digest(x: object) -> str:
    """Return a short text that changes with the content of `x`."""
    return _hashed(_content(x, 0, set(), {}))[:16]


def _hashed(content: object) -> str:
    return hashlib.sha256(repr(content).encode()).hexdigest()


def _content(
    x: object, depth: int, within: set[int], known: dict[tuple[int, int], tuple[object, str]]
) -> object:
    """Return the content of x for a digest. `within`: ids of enclosing objects; `known`: memo of digests."""
    if x is None or isinstance(x, bool | int | float | complex | str | bytes):
        return type(x).__name__, repr(x)
    if isinstance(x, jax.Array) and jax.dtypes.issubdtype(x.dtype, jax.dtypes.prng_key):
        return "key", str(x.dtype), _content(jax.random.key_data(x), depth, within, known)
    if isinstance(x, jax.Array | np.ndarray | np.generic) and not x.dtype.hasobject:
        array = np.asarray(x)
        return (
            "array",
            array.dtype.str,
            array.shape,
            hashlib.sha256(np.ascontiguousarray(array).tobytes()).hexdigest(),
        )
    if _is_formula(x):
        return "formula", type(x).__qualname__, str(x)
    # end the recursion: functions and classes may refer to each other
    if depth > 20 or id(x) in within:
        return "deeper", type(x).__qualname__
    if (id(x), depth) not in known:
        known[id(x), depth] = x, _hashed(_parts(x, depth, within | {id(x)}, known))
    return known[id(x), depth][1]


def _parts(x: object, depth: int, within: set[int], known: dict) -> object:
    """Return the content of a composite object."""

    def of(y: object) -> object:
        return _content(y, depth + isinstance(x, FunctionType | type), within, known)

    if isinstance(x, tuple | list):
        return type(x).__name__, tuple(map(of, x))
    if isinstance(x, set | frozenset):
        return "set", tuple(sorted(map(repr, map(of, x))))
    if isinstance(x, Mapping):
        return "mapping", tuple((of(key), of(value)) for key, value in x.items())
    if isinstance(x, MethodType):
        return "method", of(x.__func__), of(x.__self__)
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
        return type(x).__qualname__, of(inner)
    if is_dataclass(x):
        return of(type(x)), tuple((field.name, of(getattr(x, field.name, None))) for field in fields(x))
    members = getattr(x, "__dict__", None)
    return of(type(x)), of(members if members and not is_installed(type(x).__module__) else _pickled(x))


def _is_formula(x: object) -> bool:
    """Return whether x is a SymPy expression. Such expressions are digested by their text, since SymPy
    numbers symbols differently in every process.
    """
    sympy = sys.modules.get("sympy")
    return sympy is not None and isinstance(
        x, sympy.Basic | sympy.MatrixBase | sympy.core.function.UndefinedFunction
    )


def _pickled(x: object) -> object:
    """Return the pickled content of an object; None if `pickle` refuses it."""
    if isinstance(x, np.ndarray):
        return x.tolist()
    try:
        kept = copyreg.dispatch_table[type(x)](x) if type(x) in copyreg.dispatch_table else x.__reduce_ex__(4)
    except Exception:  # the methods of any object may raise anything
        return None
    if isinstance(kept, str):
        return kept
    return tuple(list(part) if isinstance(part, Iterator) else part for part in kept)


def _function(f: FunctionType, of) -> object:
    installed = is_installed(f.__globals__.get("__name__"))
    name = f.__module__, f.__qualname__, f.__code__.co_qualname
    if installed and is_installed(f.__module__) and "<locals>" not in f.__qualname__:
        return "function", name
    attributes = sorted(names_in(f.__code__))

    def read(y: object, *outer: ModuleType) -> object:
        """Return the content of a name's value. For a user's module, return the content of the attributes
        that the code names.
        """
        if not isinstance(y, ModuleType) or is_installed(y.__name__) or y in outer:
            return of(y)
        return of(y), tuple((name, read(vars(y)[name], *outer, y)) for name in attributes if name in vars(y))

    named, around = (
        tuple(zip(names, map(read, map(look, names)), strict=True)) for names, look in names_of(f)
    )
    if installed:
        return "function", name, around
    return "function", of(f.__code__), of(f.__defaults__), of(f.__kwdefaults__), around, named


def _class(kind: type, of) -> object:
    if is_installed(kind.__module__) and (
        not issubclass(kind, Scene) or getattr(sys.modules[kind.__module__], kind.__name__, None) is kind
    ):
        return "class", kind.__module__, kind.__qualname__
    own = tuple(
        (name, of(member))
        for name, member in sorted(vars(kind).items())
        if name == "__call__" or not name.startswith(("__", "_abc_"))
    )
    return "class", kind.__qualname__, own, tuple(of(base) for base in kind.__bases__)
