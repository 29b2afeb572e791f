"""Names that methods read besides their arguments.

Looked at are the global names and the variables of enclosing functions that a method loads itself:

- numbers, texts and tuples of them are compared by type and value, functions by identity, so that `g = 1.62` in the next cell of a notebook is noticed;
- modules and classes are constants, as are their attributes; so is a function that Python, JAX or another package has wrapped, by identity;
- arrays, containers and objects with state are refused by name: what changes in them could not be seen.

`identity.py` compares them.
"""

import dis
import enum
import functools
import re
import sys
from collections.abc import Callable, Hashable
from dataclasses import fields, is_dataclass
from decimal import Decimal
from fractions import Fraction
from pathlib import PurePath
from types import BuiltinFunctionType, CodeType, FunctionType, MethodType, ModuleType
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from jourdain_jax.calculus.reals import is_traced

_BASE = f"{__name__.rpartition('.')[0]}.scene"  # the module of the base class, below which nothing of a user's stands
_VALUES = (bool, int, float, complex, str, bytes, type(None), type(...), range, Fraction, Decimal, re.Pattern, np.dtype)


class StatefulError(ValueError):
    """A name stands for something whose changes cannot be seen."""


def is_function(x) -> bool:
    """Whether it is a function that may read something, and not a module that holds numbers."""
    return isinstance(x, FunctionType | MethodType | functools.partial) or callable(_attribute(x, "__wrapped__"))


class _Same:
    """An object that is compared by identity, and kept."""

    __slots__ = ("x",)

    def __init__(self, x):
        self.x = x

    def __eq__(self, other):
        return isinstance(other, _Same) and self.x is other.x

    def __hash__(self):
        return id(self.x)


def is_installed(name: str | None) -> bool:
    """Whether a module belongs to Python, to an installed package, or to this one."""
    top = (name or "").partition(".")[0]
    if top == "__main__":
        return False
    if top == __name__.partition(".")[0] or top in sys.builtin_module_names or top in sys.stdlib_module_names:
        return True
    file = getattr(sys.modules.get(name or ""), "__file__", None) or ""
    return "site-packages" in file or "dist-packages" in file


def own_classes(kind: type) -> tuple[type, ...]:
    """The class and those that it is derived from, up to the base class of all scenes."""
    order = kind.__mro__
    return order[: next((k for k, owner in enumerate(order) if owner.__module__ == _BASE), len(order) - 1)]


def functions_in(member) -> list[FunctionType]:
    """The functions of Python's in a member of a class, without wrappers that other modules put around them."""
    found, member = [], member.fget if isinstance(member, property) else member
    while member is not None and not isinstance(member, type):
        if isinstance(member, FunctionType) and (member.__globals__.get("__name__") == member.__module__ or not hasattr(member, "__wrapped__")):
            found.append(member)
        names = ("__wrapped__", "__func__", "func", "method")  # the last: as Equinox holds methods
        member = next((inner for name in names if callable(inner := _attribute(member, name))), None)
    return found


def _attribute(x, name: str):
    """An attribute, or None; an object's own `__getattr__` may raise anything."""
    try:
        return getattr(x, name, None)
    except Exception:
        return None


def spaces(f: FunctionType) -> tuple[tuple[Callable, tuple[str, ...]], ...]:
    """How the names that a function loads itself are looked up, `get(name, default)`, and which: its globals, and the variables of the functions around it."""
    written = {"__class__"} | names_in(f.__code__, ("STORE_GLOBAL", "STORE_DEREF"))  # a counter of calls, say
    own, around = names_in(f.__code__, ("LOAD_GLOBAL", "LOAD_NAME")) - written, set(f.__code__.co_freevars) - written
    cells = dict(zip(f.__code__.co_freevars, f.__closure__ or (), strict=True))

    def variable(name: str, default=None):
        try:
            return cells[name].cell_contents
        except ValueError:  # not yet set
            return default

    return (f.__globals__.get, tuple(sorted(own))), (variable, tuple(sorted(around)))


@functools.lru_cache(maxsize=4096)
def names_in(code: CodeType, operations: tuple[str, ...] | None = None) -> frozenset[str]:
    """Names on which code works, of attributes too, or those by some operations of Python's machine alone; functions inside it included."""
    own = frozenset(code.co_names if operations is None else (i.argval for i in dis.get_instructions(code) if i.opname in operations))
    return own.union(*(names_in(inner, operations) for inner in code.co_consts if isinstance(inner, CodeType)))


def member_key(member) -> Hashable:
    """The key of a member of a class: by value where it has no state, otherwise by identity."""
    try:
        return key(member)
    except StatefulError:
        return _Same(member)


def key_or_refusal(x: Any, name: str, where: str) -> Hashable:
    try:
        return key(x)
    except StatefulError:
        pass
    if is_traced(x):
        raise StatefulError(f"{where} reads `{name}`, which JAX is tracing (jit, grad, vmap) and which is no field of the scene; {_advice(name)}")
    kind = type(x).__name__ if "ArrayImpl" not in type(x).__name__ else "array"
    raise StatefulError(f"{where} reads `{name}`, an object ({kind}) that may change without being noticed; {_advice(name)}")


def _advice(name: str) -> str:
    return f"make it a field, `{name}: ... = jj.parameter(...)`, or, where it holds no numbers, `eqx.field(static=True)`; or a tuple of numbers"


def key(x: Any) -> Hashable:
    """What tells a value without state from another: its type and value, of functions, modules and classes their identity.

    **Raises** StatefulError for what may change: arrays, containers, objects.
    """
    if type(x) in _VALUES or isinstance(x, np.number | np.bool_ | PurePath):
        return type(x), repr(x)
    if isinstance(x, slice):
        return type(x), key((x.start, x.stop, x.step))
    if isinstance(x, tuple | frozenset) and not getattr(x, "__dict__", None):
        return type(x), tuple(map(key, x)) if isinstance(x, tuple) else frozenset(map(key, x))
    if isinstance(x, functools.partial):
        return type(x), key(x.func), key(x.args), tuple((name, key(value)) for name, value in x.keywords.items())
    if isinstance(x, enum.Enum) or getattr(vars(type(x)).get("__dataclass_params__"), "frozen", False):
        own = {field.name: getattr(x, field.name, None) for field in (fields(x) if is_dataclass(x) else ())} | getattr(x, "__dict__", {})
        return type(x), tuple((name, key(value)) for name, value in own.items())
    if _is_constant(x):
        return _Same(x)
    raise StatefulError


def _is_constant(x: Any) -> bool:
    """Whether it is a module, a class, a function, or something else that has no state of its own."""
    if isinstance(x, BuiltinFunctionType | MethodType):
        return x.__self__ is None or isinstance(x.__self__, ModuleType | type)
    if isinstance(x, ModuleType | type | FunctionType | staticmethod | classmethod | property | np.ufunc | jnp.ufunc | functools.cached_property):
        return True
    if type(x) is object or type(x).__module__ == "typing" or type(x) is eqx.filter_custom_jvp:
        return True
    return callable(_attribute(x, "__wrapped__")) and is_installed(type(x).__module__)  # a user's own class of wrappers may have state
