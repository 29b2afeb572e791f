"""Modules imported on first use, so that a first motion imports only what it needs.

    diffrax = module_on_first_use("diffrax")      with `if TYPE_CHECKING: import diffrax` for type checkers

A subclass of a class of such a module belongs in a module that is itself imported on first use.
`isinstance(x, diffrax.AbstractSolver)` imports diffrax, so compare `x` first with None and with our own
classes.
"""

from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from types import ModuleType
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
    """Import an optional package or `module`. If it is missing, raise an ImportError with the purpose and the
    command for installation.

    `extra`: the extra of this package that contains it.
    """
    try:
        return import_module(module)
    except ImportError as error:
        package = module.partition(".")[0]
        install = f"'jourdain-jax[{extra}]'" if extra else package
        raise ImportError(
            f"{purpose} needs the package `{package}`, which is not installed; install it "
            f"with: pip install {install}"
        ) from error


def version_of(package: str) -> str:
    """Return the installed version of a package, or "unknown" if it is not installed."""
    try:
        return version(package)
    except PackageNotFoundError:
        return "unknown"
