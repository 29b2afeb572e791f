"""What the functions of a scene read besides their arguments: globals, closures, attributes of classes. A change of it makes the scene another one.

A scene's structure as a pytree holds a `WhatIsRead`. It has no leaves. Its structure is a number that changes with what is read, so that whatever is kept by
the structure of the scene (traces, probes, scalar programs, compiled functions, also those of the user) is made anew after a change.

Followed are global names, variables of enclosing functions, default arguments, members of the scene's classes, attributes of modules, and functions and
classes that are called from there; lists, dictionaries, sets and NumPy arrays are compared by content. Not followed are installed packages, names that are
only known while a function runs (`globals()[name]`, `getattr(module, name)`), files, and what a function of the user's own `jax.jit` has traced already.
"""

import dis
import functools
import marshal
import sys
from collections.abc import Hashable, Iterable, Mapping
from dataclasses import dataclass
from itertools import repeat, zip_longest
from operator import is_
from types import CodeType, FunctionType, MemberDescriptorType, MethodType, ModuleType, SimpleNamespace
from typing import Any

import jax
import numpy as np

from jourdain_jax.calculus.reals import is_traced

DEEPEST = 6  # functions that call functions, objects within objects
FEW = 2048  # entries of an array that are compared one by one; of a larger one as many, and the sum of all
_PACKAGE = __name__.partition(".")[0]
_BASE = f"{_PACKAGE}.scene.scene"  # what defines `Scene`, and below it in every order of resolution nothing of a user's
_NOTHING = object()
_CHANGING = {"append", "extend", "insert", "add", "update", "setdefault", "pop", "clear", "remove", "discard", "popitem", "write", "appendleft"}


class WhatIsRead:
    """What some functions and classes read; a pytree without leaves, whose structure changes with it."""

    def __init__(self, watch: "_Watch"):
        self._watch = watch

    def now(self) -> tuple["_Watch", int]:
        """Whose reading it is, and a number that is another one after a change, and the old one after a change back."""
        return self._watch, self._watch.version()

    def __reduce__(self):
        return is_read_by, self._watch.roots


jax.tree_util.register_pytree_node(WhatIsRead, lambda read: ((), read.now()), lambda now, _: WhatIsRead(now[0]))


def is_read_by(*roots) -> WhatIsRead:
    """What functions, or the methods of classes, read."""
    return WhatIsRead(_watch(roots))


@functools.lru_cache(maxsize=1024)
def _watch(roots: tuple) -> "_Watch":
    return _Watch(roots)


def names_of_what_is_traced(tree) -> list[str]:
    """Names by which the functions and classes of a tree read what JAX is tracing."""
    found = _Reader()
    for read in jax.tree.leaves(tree, is_leaf=lambda x: isinstance(x, WhatIsRead)):
        for root in read.now()[0].roots if isinstance(read, WhatIsRead) else ():
            found.key(root)
    named = {(name, id(x)): x for f, *_ in found.functions for name, x in _named_in(f)}
    return sorted({name for (name, _), x in named.items() if is_traced(x)})


def _named_in(f: FunctionType) -> Iterable[tuple[str, Any]]:
    yield from zip(f.__code__.co_freevars, map(_content_of, f.__closure__ or ()), strict=True)
    yield from ((name, f.__globals__.get(name)) for name in read_in(f.__code__).globals)


def is_function(x) -> bool:
    """Whether it is a function that may read something, and not a module that holds numbers."""
    return isinstance(x, FunctionType | MethodType | functools.partial) or callable(getattr(x, "__wrapped__", None))


class _Watch:
    """Compares what is read now with what was read when it was last looked through."""

    def __init__(self, roots: tuple):
        self.roots = roots
        self._numbers: dict[Hashable, int] = {}
        self._kept: list = []  # what is compared by identity must stay, or another object may take its place
        self._look()

    def __reduce__(self):
        return _watch, (self.roots,)

    def version(self) -> int:
        """The number of the present content."""
        if not self._is_as_before():
            self._look()
        return self._number

    def _is_as_before(self) -> bool:
        """Whether every name still stands for the same object, and every mutable object has the same content."""
        for get, names, objects in self._names:
            if not all(map(is_, map(get, names, repeat(_NOTHING)), objects)):
                return False
        for members, objects in self._members:
            if len(members) != len(objects) or not all(map(is_, members.values(), objects)):
                return False
        for cell, content in self._cells:
            if _content_of(cell) is not content:
                return False
        for f, code, defaults, named in self._functions:
            if f.__code__ is not code or f.__defaults__ is not defaults or f.__kwdefaults__ is not named:
                return False
        return all(_content(x) == content for x, content in self._mutable)

    def _look(self) -> None:
        found = _Reader()
        key = tuple(found.key(root) for root in self.roots)
        self._names = [(space.get, tuple(names), tuple(names.values())) for space, names in found.names.values()]
        self._members = [(members, tuple(members.values())) for members in found.members]
        self._cells, self._mutable, self._functions = found.cells, found.mutable, found.functions
        if key not in self._numbers:
            self._numbers[key] = len(self._numbers)
            self._kept.append(found.by_identity)
        self._number = self._numbers[key]


def _content_of(cell):
    try:
        return cell.cell_contents
    except ValueError:  # not yet set
        return _NOTHING


class _Slots(Mapping):
    """The attributes of an object for which its classes state `__slots__`, as its `__dict__` would show them."""

    def __init__(self, x, names: tuple[str, ...]):
        self.x, self.names = x, names

    def __getitem__(self, name: str):
        return getattr(self.x, name, _NOTHING)

    def __iter__(self):
        return iter(self.names)

    def __len__(self) -> int:
        return len(self.names)


def _slots_of(x) -> _Slots | None:
    """Slots of an object, those of its bases included; None where it has none."""
    names = tuple(name for kind in type(x).__mro__ for name, member in vars(kind).items() if isinstance(member, MemberDescriptorType))
    return _Slots(x, names) if names else None


class _Reader:
    """Goes through what functions and classes read, notes where it was found, and makes a key of it."""

    def __init__(self) -> None:
        self.names: dict[int, tuple[Mapping, dict[str, Any]]] = {}  # some names of a namespace, and what they stand for
        self.members: list[Mapping] = []  # namespaces of which all counts
        self.cells: list[tuple[Any, Any]] = []
        self.mutable: list[tuple[Any, Hashable]] = []
        self.functions: list[tuple] = []
        self.by_identity: list = []
        self._seen: set[int] = set()

    def key(self, x, depth: int = 0) -> Hashable:
        """What tells an object from another one of other content."""
        if isinstance(x, int | float | complex | str | bytes | type(None)):
            return type(x), repr(x)
        if isinstance(x, tuple | frozenset):
            return type(x), tuple(self.key(y, depth + 1) for y in x)
        if depth > DEEPEST:
            return self._identity(x)
        if isinstance(x, list | dict | set | bytearray | np.ndarray):
            content = _content(x)
            self.mutable.append((x, content))
            inside = () if isinstance(x, bytearray | np.ndarray) else x.values() if isinstance(x, dict) else x
            return type(x), content, tuple(self.key(y, depth + 1) for y in inside if not isinstance(y, int | float | str))
        if id(x) in self._seen:
            return "seen", getattr(x, "__code__", type(x))
        if isinstance(x, FunctionType | type | SimpleNamespace):
            self._seen.add(id(x))
        if isinstance(x, FunctionType):
            return self._identity(x) if is_installed(x.__module__) else self._function(x, depth)
        if isinstance(x, type):
            return self._class(x, depth)
        return self._object(x, depth)

    def _object(self, x, depth: int) -> Hashable:
        if isinstance(x, staticmethod | classmethod):
            return type(x), self.key(x.__func__, depth)
        if isinstance(x, MethodType):
            return self.key(x.__func__, depth), self.key(x.__self__, depth + 1)
        if isinstance(x, property):
            return tuple(self.key(f, depth) for f in (x.fget, x.fset) if f is not None)
        if isinstance(x, functools.partial):
            return self.key(x.func, depth), self.key(x.args, depth), self.key(x.keywords, depth)
        try:
            inner = getattr(x, "__wrapped__", None)
        except Exception:  # an object's own `__getattr__`, which need not know it
            inner = None
        if callable(inner):  # a compiled function
            return self.key(inner, depth + 1)
        if type(x).__module__.startswith("equinox") and callable(inner := getattr(x, "method", None)):  # as Equinox holds methods
            return self.key(inner, depth)
        members = [part for part in (getattr(x, "__dict__", None), _slots_of(x)) if part is not None]
        if not members or isinstance(x, ModuleType) or (is_installed(type(x).__module__) and not isinstance(x, SimpleNamespace)):
            return self._identity(x)
        self._seen.add(id(x))
        self.by_identity.append(x)
        self.members += members
        return self.key(type(x), depth + 1), tuple((name, self.key(y, depth + 1)) for part in members for name, y in part.items())

    def _identity(self, x) -> Hashable:
        self.by_identity.append(x)
        return type(x), id(x)

    def _function(self, f: FunctionType, depth: int) -> Hashable:
        own = [f.__code__, self.key(f.__defaults__, depth + 1), self.key(f.__kwdefaults__, depth + 1)]
        self.functions.append((f, f.__code__, f.__defaults__, f.__kwdefaults__))
        if f.__dict__:
            self.members.append(f.__dict__)
            own += [(name, self.key(y, depth + 1)) for name, y in f.__dict__.items()]
        read = read_in(f.__code__)
        for name in read.globals:
            own.append((name, self._named(f.__globals__, name, depth)))
            own += self._attributes(f.__globals__.get(name), read.attributes, depth)
        for name, cell in zip(f.__code__.co_freevars, f.__closure__ or (), strict=True):
            if name in read.enclosing and name != "__class__":
                content = _content_of(cell)
                self.cells.append((cell, content))
                own.append((name, self.key(content, depth + 1)))
                own += self._attributes(content, read.attributes, depth)
        return tuple(own)

    def _named(self, space: Mapping, name: str, depth: int) -> Hashable:
        x = space.get(name, _NOTHING)
        self.names.setdefault(id(space), (space, {}))[1][name] = x
        return self.key(x, depth + 1)

    def _attributes(self, module, attributes: Iterable[str], depth: int) -> list[Hashable]:
        """What is read of a module of the user's."""
        if not isinstance(module, ModuleType) or is_installed(module.__name__):
            return []
        return [(name, self._named(vars(module), name, depth)) for name in attributes]

    def _class(self, kind: type, depth: int) -> Hashable:
        own: list[Hashable] = [self._identity(kind)]
        # of a scene all its classes count: someone may replace methods of this package's too, and a class made by `type(...)` bears another module's name
        for owner in kind.__mro__[: next((k for k, owner in enumerate(kind.__mro__) if owner.__module__ == _BASE), None)]:
            if depth == 0 or not is_installed(owner.__module__):
                self.members.append(vars(owner))
                own += [(name, self.key(member, depth + 1)) for name, member in vars(owner).items() if not _is_bookkeeping(name)]
        return tuple(own)


def _is_bookkeeping(name: str) -> bool:
    """Whether a member of a class is what Python, dataclasses or Equinox put there."""
    return (name.startswith("__") and name.endswith("__") and name not in ("__call__", "__getattr__", "__getitem__")) or name.startswith("_abc_")


def _content(x) -> Hashable:
    """The content of a mutable object; what is no number, text or container in it counts by identity."""
    if isinstance(x, np.ndarray):
        if x.dtype.hasobject:
            return x.shape, tuple(map(id, x.ravel()))
        if x.size <= FEW:
            return x.shape, x.dtype.str, x.tobytes()
        return x.shape, x.dtype.str, x.ravel()[:: x.size // FEW].tobytes(), np.sum(x).tobytes()
    try:
        return marshal.dumps(x, 2)  # exact, types included; a version that does not tell objects that are referred to twice
    except (ValueError, TypeError):
        return tuple((name, _entry(y)) for name, y in (x.items() if isinstance(x, dict) else enumerate(x)))


def _entry(y) -> Hashable:
    if isinstance(y, int | float | complex | str | bytes):
        return type(y), repr(y)
    return _content(y) if isinstance(y, list | dict | set | tuple | np.ndarray) else id(y)


@dataclass(frozen=True)
class Read:
    """Names that code reads, those of functions inside it included."""

    globals: tuple[str, ...]
    enclosing: tuple[str, ...]  # variables of the functions around it
    attributes: tuple[str, ...]  # of anything


@functools.lru_cache(maxsize=4096)
def read_in(code: CodeType) -> Read:
    """What code reads; what it only adds to or writes into (a list that counts its calls) is not among it."""
    instructions = [i for i in dis.get_instructions(code) if i.opname not in ("CACHE", "NOP", "PRECALL", "EXTENDED_ARG")]
    written = {i.argval for i in instructions if i.opname in ("STORE_GLOBAL", "STORE_DEREF")}
    found: dict[str, list[str]] = {"globals": [], "enclosing": [], "attributes": []}
    for i, first, second in zip_longest(instructions, instructions[1:], instructions[2:]):
        if i.opname in ("LOAD_ATTR", "LOAD_METHOD"):
            found["attributes"].append(i.argval)
        elif i.opname in _LOADS and i.argval not in written and not _is_only_changed(first, second):
            found[_LOADS[i.opname]].append(i.argval)
    for inner in code.co_consts:
        if isinstance(inner, CodeType):
            read = read_in(inner)
            found["globals"] += read.globals
            found["enclosing"] += read.enclosing
            found["attributes"] += read.attributes
    return Read(**{kind: tuple(dict.fromkeys(names)) for kind, names in found.items()})


_LOADS = {"LOAD_GLOBAL": "globals", "LOAD_NAME": "globals", "LOAD_DEREF": "enclosing", "LOAD_CLASSDEREF": "enclosing"}


def _is_only_changed(first, second) -> bool:
    """Whether what was just loaded is added to or written into: `x.append(...)`, `x[i] = ...`, `x[i] += ...`."""
    if first is None:
        return False
    if first.opname in ("LOAD_METHOD", "LOAD_ATTR"):
        return first.argval in _CHANGING
    return second is not None and first.opname.startswith("LOAD_") and second.opname in ("STORE_SUBSCR", "COPY")


@functools.lru_cache(maxsize=4096)
def is_installed(name: str | None) -> bool:
    """Whether a module belongs to Python, to an installed package, or to this one."""
    top = (name or "").partition(".")[0]
    if top == "__main__":
        return False
    if top == _PACKAGE or top in sys.builtin_module_names or top in sys.stdlib_module_names:
        return True
    file = getattr(sys.modules.get(name or ""), "__file__", None) or ""
    return "site-packages" in file or "dist-packages" in file
