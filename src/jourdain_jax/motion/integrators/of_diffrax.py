"""diffrax, and our modules that define solvers and adjoints for it: imported when a motion first asks for something of them (`calculus/on_first_use.py`)."""

from typing import TYPE_CHECKING

from jourdain_jax.calculus.on_first_use import module_on_first_use

if TYPE_CHECKING:
    import diffrax

    from jourdain_jax.motion.integrators import alongside
else:
    diffrax = module_on_first_use("diffrax")
    alongside = module_on_first_use(f"{__package__}.alongside")

__all__ = ["alongside", "diffrax"]
