"""Modules imported on first use, so that a first motion loads only what it needs.

Both functions serve names that are imported under `if TYPE_CHECKING:`, where static tools see them.

    diffrax = module_on_first_use("diffrax")                      in a module: a placeholder with the attributes of another module
    __getattr__, __dir__ = names_on_first_use(globals())          in a package: names imported under `if TYPE_CHECKING:` (PEP 562)

A class derived from a placeholder's class belongs in a module that is itself imported on first use.
`isinstance(x, diffrax.AbstractSolver)` imports diffrax, so test `x` first for None and for classes of this
package.
"""

import ast
from collections.abc import Callable, Mapping
from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from types import MappingProxyType, ModuleType
from typing import Any


class _OnFirstUse(ModuleType):
    """Placeholder for the module of its name."""

    def __getattr__(self, name: str) -> Any:
        return getattr(import_module(self.__name__), name)

    def __dir__(self) -> list[str]:
        return dir(import_module(self.__name__))


def module_on_first_use(name: str) -> Any:
    """Return a placeholder for a module, which is imported at the first access of an attribute."""
    return _OnFirstUse(name)


def needed(module: str, purpose: str, extra: str = "") -> Any:
    """Import an optional package or `module`; if it is missing, raise an ImportError with its purpose and the
    command that installs it.

    `extra`: the extra of this package that contains it.
    """
    try:
        return import_module(module)
    except ImportError as error:
        package = module.partition(".")[0]
        install = f"'jourdain-jax[{extra}]'" if extra else package
        raise ImportError(f"{purpose} needs the package `{package}`, which is not installed; install it "
            f"with: pip install {install}") from error


def names_on_first_use(package: dict[str, Any], gone: Mapping[str, str] = MappingProxyType({})) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """Return `__getattr__` and `__dir__` of a package with these globals. On first use they import the names
    that its source imports only under a condition.

    `gone`: former names -> their replacements. Each name is looked up once and then becomes an ordinary
    global of the package.
    """
    conditions = [statement for statement in ast.parse(Path(package["__file__"]).read_text(encoding="utf-8")).body if isinstance(statement, ast.If)]
    imports = [line for condition in conditions for line in condition.body if isinstance(line, ast.ImportFrom)]
    where = {alias.name: str(line.module) for line in imports for alias in line.names}

    def __getattr__(name: str) -> Any:
        if name not in where:
            advice = f": {gone[name]}" if name in gone else ""
            raise AttributeError(f"module {package['__name__']!r} has no attribute {name!r}{advice}")
        package[name] = getattr(import_module(where[name]), name)
        return package[name]

    def __dir__() -> list[str]:
        return sorted({*package, *where})

    return __getattr__, __dir__


def version_of(package: str) -> str:
    """Return the installed version of a package, or "unknown" if it is not installed."""
    try:
        return version(package)
    except PackageNotFoundError:
        return "unknown"
