"""Inspection of Python functions: the functions in a member of a class, and the names that a
function loads.
"""

import dis
import sys
from collections.abc import Callable
from functools import lru_cache
from types import CodeType, FunctionType
from typing import Any


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
    """Return the Python functions in a member of a class, including wrapped ones. Wrappers defined in other
    modules are omitted.
    """
    found, member = [], member.fget if isinstance(member, property) else member
    while member is not None and not isinstance(member, type):
        if isinstance(member, FunctionType) and (
            member.__globals__.get("__name__") == member.__module__ or not hasattr(member, "__wrapped__")
        ):
            found.append(member)
        names = ("__wrapped__", "__func__", "func", "method")  # Equinox stores methods as `method`
        member = next((inner for name in names if callable(inner := attribute(member, name))), None)
    return found


def attribute(x, name: str):
    """Return an attribute, or None if reading it raises an error, as for an unset variable."""
    try:
        return getattr(x, name, None)
    except Exception:
        return None


def names_of(f: FunctionType) -> tuple[tuple[tuple[str, ...], Callable[[str], Any]], ...]:
    """Return two pairs (names, lookup), for globals and for variables of enclosing functions. `names`: those
    that the function itself reads; `lookup(name)`: the value, or None if it is not yet set.
    """
    # omit names that the function itself sets, such as a counter of calls
    written = {"__class__"} | names_in(f.__code__, ("STORE_GLOBAL", "STORE_DEREF"))
    own = tuple(sorted(names_in(f.__code__, ("LOAD_GLOBAL", "LOAD_NAME")) - written))
    cells = {
        name: cell
        for name, cell in zip(f.__code__.co_freevars, f.__closure__ or (), strict=True)
        if name not in written
    }
    return (own, f.__globals__.get), (tuple(cells), lambda name: attribute(cells[name], "cell_contents"))


@lru_cache(maxsize=4096)
def names_in(code: CodeType, operations: tuple[str, ...] | None = None) -> frozenset[str]:
    """Return the names that code uses, including attributes and inner functions. `operations`: count only the
    names in instructions of these kinds.
    """
    own = frozenset(
        code.co_names
        if operations is None
        else (i.argval for i in dis.get_instructions(code) if i.opname in operations)
    )
    return own.union(
        *(names_in(inner, operations) for inner in code.co_consts if isinstance(inner, CodeType))
    )
