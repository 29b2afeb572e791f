"""Names that methods read from outside their arguments.

As everywhere in JAX, a method is traced once, and values that are not fields of the scene become constants of
the trace. They belong to the structure of the scene, and are compared at each call. Tracked are the members
of the class, and the global names and variables of enclosing functions that a method loads itself:

- numbers, texts and tuples of them are compared by type and value, functions by the identity of the function
  and of its code. So `g = 1.62` in a later cell of a notebook, or `%autoreload`, takes effect;
- modules, classes and their attributes are constants, and so are functions wrapped by Python, JAX or another
  package, by identity;
- arrays, containers and objects with state raise an error, since their changes could not be noticed.

Values read by helper functions are not tracked. After `clear_caches` every scene is traced again.
"""

import dis
import enum
import re
import sys
from collections.abc import Callable, Hashable
from dataclasses import fields, is_dataclass
from decimal import Decimal
from fractions import Fraction
from functools import lru_cache, partial
from operator import attrgetter, is_
from pathlib import PurePath
from types import BuiltinFunctionType, CodeType, FunctionType, MethodType, ModuleType
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jourdain_jax.calculus.reals import is_traced
from jourdain_jax.scene.names import Labels

_VALUES = (
    bool,
    int,
    float,
    complex,
    str,
    bytes,
    type(None),
    type(...),
    range,
    Fraction,
    Decimal,
    re.Pattern,
    np.dtype,
)
_CONSTANTS = (ModuleType, type, FunctionType, np.ufunc, jnp.ufunc, eqx.filter_custom_jvp)


class StatefulError(ValueError):
    """Error for a name of an object whose changes cannot be noticed."""


class NamesRead:
    """Names that methods of classes, or functions, read: a pytree without leaves, whose structure changes
    with their values.
    """

    def __init__(self, roots: tuple[type | Callable, ...], strict: bool):
        self._roots, self._strict = roots, strict
        self._versions: dict[tuple, int] = {}
        self._look()

    def __reduce__(self):
        return names_read, self._roots

    def now(self) -> tuple["NamesRead", int]:
        """Return the names with their present values, and a version number; equal contents have equal
        numbers. Raises ValueError if a name now refers to an object with state.
        """
        found = [x for look in self._looks for x in look()]
        if len(found) != len(self._seen) or not all(map(is_, found, self._seen)):
            self._look()
        return self, self._version

    def _look(self) -> None:
        content: list[tuple] = []
        looks: list[Callable] = []
        sources: dict[
            Callable, dict[str, None]
        ] = {}  # the names to read by each: a module is read once for all functions
        functions: list[FunctionType] = []
        for root in self._roots:
            members = vars(root) if isinstance(root, type) else {"": root}
            looks.append(members.values)
            for name, member in list(members.items()):
                content.append((name, _key_of(member)))
                for f in () if name.startswith("__") and name != "__call__" else functions_in(member):
                    functions.append(f)
                    where = (
                        f"`{root.__name__}.{name}`"
                        if name
                        else f"the function `{f.__qualname__}`"
                        if self._strict
                        else ""
                    )
                    for names, read in names_of(f):
                        found = [*map(read, names)]
                        if names:
                            sources.setdefault(read, {}).update(dict.fromkeys(names))
                        content += [(n, _key_of(x, n, where)) for n, x in zip(names, found, strict=True)]
                        functions += [x for x in found if isinstance(x, FunctionType)]
        looks += [partial(map, read, names) for read, names in sources.items()]
        looks.append(partial(map, attrgetter("__code__"), functions))
        seen = [x for look in looks for x in look()]
        content.append(tuple(map(_Same, looks[-1]())))
        self._version = self._versions.setdefault(tuple(content), len(self._versions))
        # last, so that a value that raises here raises again at the next call
        self._looks, self._seen = looks, seen


jax.tree_util.register_pytree_node(NamesRead, lambda read: ((), read.now()), lambda now, _: now[0])


@lru_cache(maxsize=1024)
def names_read(*roots: type | Callable, strict: bool = False) -> NamesRead:
    """Return the names that functions, and the methods of classes, read. Raises ValueError for a name in a
    method that refers to an array, a container or an object with state. In a function such an object is a
    constant, unless `strict`.
    """
    return NamesRead(roots, strict)


def now_read_by(function: Callable) -> Hashable | None:
    """Return the present values of the names that a function reads. None if its trace cannot be stored: one
    of the values has state, or the argument is no function.
    """
    try:
        return names_read(function, strict=True).now() if is_function(function) else None
    except (StatefulError, TypeError):  # TypeError: the function is not hashable
        return None


def is_function(x) -> bool:
    """Return whether it is a function that may read values, rather than a module with numbers."""
    return isinstance(x, FunctionType | MethodType | partial) or callable(_attribute(x, "__wrapped__"))


def is_installed(name: str | None) -> bool:
    """Return whether a module belongs to Python, to an installed package, or to this one."""
    top = (name or "").partition(".")[0]
    if top == "__main__":
        return False
    if top == __name__.partition(".")[0] or top in sys.stdlib_module_names:
        return True
    file = getattr(sys.modules.get(name or ""), "__file__", None) or ""
    return "site-packages" in file or "dist-packages" in file


def functions_in(member) -> list[FunctionType]:
    """Return the Python functions in a member of a class, without wrappers of other modules."""
    found, member = [], member.fget if isinstance(member, property) else member
    while member is not None and not isinstance(member, type):
        if isinstance(member, FunctionType) and (
            member.__globals__.get("__name__") == member.__module__ or not hasattr(member, "__wrapped__")
        ):
            found.append(member)
        names = ("__wrapped__", "__func__", "func", "method")  # Equinox stores methods as `method`
        member = next((inner for name in names if callable(inner := _attribute(member, name))), None)
    return found


def _attribute(x, name: str):
    """Return an attribute, or None if reading it fails: an object's `__getattr__` may raise any error, and so
    may an unset variable.
    """
    try:
        return getattr(x, name, None)
    except Exception:
        return None


def names_of(f: FunctionType) -> tuple[tuple[Labels, Callable[[str], Any]], ...]:
    """Return the names that a function itself loads, each set with a function that reads one: globals, and
    variables of enclosing functions (None if not yet set).
    """
    # such as a counter of calls
    written = {"__class__"} | names_in(f.__code__, ("STORE_GLOBAL", "STORE_DEREF"))
    own = tuple(sorted(names_in(f.__code__, ("LOAD_GLOBAL", "LOAD_NAME")) - written))
    cells = {
        name: cell
        for name, cell in zip(f.__code__.co_freevars, f.__closure__ or (), strict=True)
        if name not in written
    }
    return (own, f.__globals__.get), (tuple(cells), lambda name: _attribute(cells[name], "cell_contents"))


@lru_cache(maxsize=4096)
def names_in(code: CodeType, operations: Labels | None = None) -> frozenset[str]:
    """Return the names used by code, or by the given instructions only, including attributes and inner
    functions.
    """
    own = frozenset(
        code.co_names
        if operations is None
        else (i.argval for i in dis.get_instructions(code) if i.opname in operations)
    )
    return own.union(
        *(names_in(inner, operations) for inner in code.co_consts if isinstance(inner, CodeType))
    )


class _Same:
    """A reference to an object, compared by identity."""

    def __init__(self, x):
        self.x = x

    def __eq__(self, other):
        return isinstance(other, _Same) and self.x is other.x

    def __hash__(self):
        return id(self.x)


def _key_of(x: Any, name: str = "", where: str = "") -> Hashable:
    """Return the key of a name's value. The key of a value with state is its identity; if `where` is given,
    raises StatefulError instead.
    """
    try:
        return key(x)
    except StatefulError:
        if not where:
            return _Same(x)
    what = (
        f"an object ({'array' if isinstance(x, jax.Array) else type(x).__name__}) that may change unnoticed"
    )
    raise StatefulError(
        f"{where} reads `{name}`,"
        f" {'which JAX is tracing (jit, grad, vmap) and which is not a field of the scene' if is_traced(x) else what};"
        f" make it a field, `{name}: ... = jj.parameter(...)`, or `eqx.field(static=True)` if it holds no"
        " numbers, or replace it by a tuple of numbers"
    )


def key(x: Any) -> Hashable:
    """Return a key of a value without state: its type and value. The key of a function, module or class is
    its identity.

    **Raises** StatefulError for values that may change: arrays, containers, objects.
    """
    if type(x) in _VALUES or isinstance(x, np.number | np.bool_ | PurePath):
        return type(x), repr(x)
    parts = _parts(x)
    if parts is not None:
        return type(x), tuple(map(key, parts))
    if _is_constant(x):
        return _Same(x)
    raise StatefulError


def _parts(x: Any) -> tuple | None:
    """Return the contents of an immutable container; None for anything else."""
    if isinstance(x, slice):
        return x.start, x.stop, x.step
    if isinstance(x, partial):
        return x.func, x.args, *x.keywords.items()
    if isinstance(x, tuple | frozenset) and not getattr(x, "__dict__", None):
        return tuple(x)
    if isinstance(x, enum.Enum) or getattr(vars(type(x)).get("__dataclass_params__"), "frozen", False):
        own = [(field.name, getattr(x, field.name, None)) for field in (fields(x) if is_dataclass(x) else ())]
        return *own, *getattr(x, "__dict__", {}).items()
    return None


def _is_constant(x: Any) -> bool:
    """Return whether it is a module, a class, a function, or another object without state."""
    if isinstance(x, BuiltinFunctionType | MethodType):
        return x.__self__ is None or isinstance(x.__self__, ModuleType | type)
    if isinstance(x, _CONSTANTS) or type(x) is object or type(x).__module__ == "typing":
        return True
    # a user's wrapper class may have state
    return callable(_attribute(x, "__wrapped__")) and is_installed(type(x).__module__)
