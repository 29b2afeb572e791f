"""diffrax, and our modules that define solvers for it, imported on first use (`calculus/on_first_use.py`)."""

from typing import TYPE_CHECKING

from jourdain_jax.calculus.on_first_use import module_on_first_use

if TYPE_CHECKING:
    import diffrax
else:
    diffrax = module_on_first_use("diffrax")

__all__ = ["diffrax"]
