"""Names that methods read from outside their arguments.

As everywhere in JAX, a method is traced once, and values that are not fields of the scene become constants
of the trace. They belong to the structure of the scene and are compared at each call. The compared values
are the members of the class, and the global names and variables of enclosing functions that a method
itself reads:

- numbers, texts and tuples of them are compared by type and value, functions by the identity of the function
  and of its code. So `g = 1.62` in a later cell of a notebook, or `%autoreload`, takes effect;
- modules, classes, and functions wrapped by Python, JAX or another package are compared by identity; their
  attributes count as constants;
- arrays, containers and objects with state raise an error, since their changes could not be noticed.

Values that helper functions read are not compared. After `clear_caches` every scene is traced again.
"""

import re
from collections.abc import Callable, Hashable
from decimal import Decimal
from fractions import Fraction
from functools import lru_cache, partial
from operator import attrgetter, is_
from pathlib import PurePath
from types import BuiltinFunctionType, FunctionType, MethodType, ModuleType
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jourdain_jax.calculus.code import attribute, functions_in, is_installed, names_of
from jourdain_jax.calculus.reals import is_traced

_EXACTLY = (
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
)
_CONSTANTS = (ModuleType, type, FunctionType, np.ufunc, jnp.ufunc, eqx.filter_custom_jvp)


class StatefulError(ValueError):
    """Raised for a name whose object may change unnoticed."""


class NamesRead:
    """The names that methods of classes, or functions, read. It is a pytree without leaves, whose structure
    changes when the value of one of the names changes.
    """

    def __init__(self, roots: tuple[type | Callable, ...], strict: bool):
        self._roots, self._strict = roots, strict
        self._versions: dict[tuple, int] = {}
        self._look()

    def __reduce__(self):
        return names_read, self._roots

    def now(self) -> tuple["NamesRead", int]:
        """Return the names with their current values, and a version number; equal contents have equal
        numbers. Raises ValueError if a name now refers to an object with state.
        """
        found = [x for look in self._looks for x in look()]
        if len(found) != len(self._seen) or not all(map(is_, found, self._seen)):
            self._look()
        return self, self._version

    def _look(self) -> None:
        content: list[Hashable] = []
        functions: list[FunctionType] = []
        readers: dict[Callable, dict[str, str]] = {}  # reader of names -> name -> the method that loads it
        for root in self._roots:
            for name, member in (dict(vars(root)) if isinstance(root, type) else {"": root}).items():
                if name and hasattr(member, "cache_info"):
                    raise StatefulError(
                        f"`{root.__name__}.{name}` is cached by functools, which cannot keep traced values; "
                        "remove the decorator"
                    )
                content.append((name, _key(member)))
                for f in () if name.startswith("__") and name != "__call__" else functions_in(member):
                    functions.append(f)
                    whose = f"`{root.__name__}.{name}`" if name else f"the function `{f.__qualname__}`"
                    for names, read in names_of(f):
                        known = readers.setdefault(read, {})
                        known |= {n: known.get(n) or whose * (bool(name) or self._strict) for n in names}
        for read, names in readers.items():
            for name, whose in names.items():
                content.append((name, _key(x := read(name), whose, name)))
                functions += [x] * isinstance(x, FunctionType)
        looks: list[Callable] = [vars(root).values for root in self._roots if isinstance(root, type)]
        looks += [partial(map, read, names) for read, names in readers.items()]
        looks.append(partial(map, attrgetter("__code__"), functions))
        seen = [x for look in looks for x in look()]
        content += map(_Same, looks[-1]())
        self._version = self._versions.setdefault(tuple(content), len(self._versions))
        # set last: a value that raises an error above raises it again at the next call
        self._looks, self._seen = looks, seen


jax.tree_util.register_pytree_node(NamesRead, lambda read: ((), read.now()), lambda now, _: now[0])


@lru_cache(maxsize=1024)
def names_read(*roots: type | Callable, strict: bool = False) -> NamesRead:
    """Return the names that functions and the methods of classes read.

    Raises ValueError if a name in a method refers to an array, a container or an object with state. In a
    function such an object is a constant; with `strict` it raises ValueError, too.
    """
    return NamesRead(roots, strict)


def now_read_by(function: Callable) -> Hashable | None:
    """Return the current values of the names that a function reads. Return None if its trace must not be
    stored: one of the values has state, or the argument is not a function.
    """
    try:
        return names_read(function, strict=True).now() if is_function(function) else None
    except (StatefulError, TypeError):  # TypeError: the function is not hashable
        return None


def is_function(x) -> bool:
    """Return whether x has code that may read names: a function, a method, or a wrapper of one."""
    return isinstance(x, FunctionType | MethodType | partial) or callable(attribute(x, "__wrapped__"))


class _Same:
    """A reference to an object, compared by identity."""

    def __init__(self, x):
        self.x = x

    def __eq__(self, other):
        return isinstance(other, _Same) and self.x is other.x

    def __hash__(self):
        return id(self.x)


def _key(x: Any, whose: str = "", name: str = "") -> Hashable:
    """Return the key by which a value is compared; for a value with state, its identity. If `whose`, a
    method, reads the value as `name`, a value with state raises StatefulError.
    """
    try:
        return _content(x)
    except StatefulError:
        if not whose:
            return _Same(x)
    kind = "array" if isinstance(x, jax.Array) else type(x).__name__
    what = f"an object ({kind}) that may change unnoticed"
    if is_traced(x):
        what = "which JAX is tracing (jit, grad, vmap) and which is not a field of the scene"
    raise StatefulError(
        f"{whose} reads `{name}`, {what}; make it a field, `{name}: ... = jj.parameter(...)`, or "
        "`eqx.field(static=True)` if it holds no numbers, or replace it by a tuple of numbers"
    )


def _content(x: Any) -> Hashable:
    """Return type and value of an object without state, or the identity of a module, class or function.
    Raises StatefulError for values that may change: arrays, containers, objects.
    """
    bare = not hasattr(x, "__dict__")  # an object without attributes of its own
    if type(x) in _EXACTLY or (bare and isinstance(x, np.number | np.bool_ | np.dtype | PurePath)):
        return type(x), repr(x)
    if isinstance(x, slice):
        parts = x.start, x.stop, x.step
    elif isinstance(x, partial):
        parts = x.func, x.args, *x.keywords.items()
    elif bare and isinstance(x, tuple | frozenset):
        parts = tuple(x)
    elif _is_constant(x):
        return _Same(x)
    else:
        raise StatefulError
    return type(x), tuple(map(_content, parts))


def _is_constant(x: Any) -> bool:
    """Return whether x is a module, a class, a function, or another object without state."""
    if isinstance(x, BuiltinFunctionType | MethodType):
        return x.__self__ is None or isinstance(x.__self__, ModuleType | type)
    if isinstance(x, _CONSTANTS) or type(x) is object or type(x).__module__ == "typing":
        return True
    # a user's wrapper class may have state
    return callable(attribute(x, "__wrapped__")) and is_installed(type(x).__module__)
