"""Modules imported on first use, so that a first motion does not pay for what it does not need.

There are two ways, both for names that are imported under `if TYPE_CHECKING:`, where static tools see them.

    diffrax = module_on_first_use("diffrax")                      in a module: stands for another one; its attributes are those of that
    __getattr__, __dir__ = names_on_first_use(globals())          in a package: names that it imports under `if TYPE_CHECKING:` (PEP 562)

A class that derives from one of such a module is defined in a module that is imported on first use too. `isinstance(x, diffrax.AbstractSolver)` imports
diffrax, so `x` is compared with what needs no import first: with None, and with what is ours.
"""

import ast
from collections.abc import Callable, Mapping
from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from types import MappingProxyType, ModuleType
from typing import Any


class _OnFirstUse(ModuleType):
    """Stands for the module of its name."""

    def __getattr__(self, name: str) -> Any:
        return getattr(import_module(self.__name__), name)

    def __dir__(self) -> list[str]:
        return dir(import_module(self.__name__))


def module_on_first_use(name: str) -> Any:
    """Return a placeholder for a module, which is imported at the first access of an attribute."""
    return _OnFirstUse(name)


def needed(module: str, purpose: str, extra: str = "") -> Any:
    """Return an optional package, or a `module` of one; if it is missing, raise an ImportError with its
    purpose and the command that installs it.

    `extra`: the extra of this package that installs it.
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
    that the source imports under a condition only.

    `gone`: former names -> their replacements.

    A name is looked up once; from then on it is an ordinary global of the package.
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
    """Return the installed version of a package; "unknown" where it runs without being installed."""
    try:
        return version(package)
    except PackageNotFoundError:
        return "unknown"
