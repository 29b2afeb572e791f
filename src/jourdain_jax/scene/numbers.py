"""Numbers as users give them, and whether they are known: what the layers above need of `calculus.reals`."""

from jourdain_jax.calculus.reals import checked_known, checked_real, described, is_traced, real_type

__all__ = ["checked_known", "checked_real", "checked_unless_traced", "described", "is_traced", "real_type"]


def checked_unless_traced(value, what: str, shape: tuple[int, ...] | None = None, *, advice: str):
    """`value` in the default float: on NumPy where it is known, also inside `jit`; a JAX array where it is traced. A ValueError as of `checked_real`."""
    if is_traced(value):
        return checked_real(value, what, shape, advice=advice).astype(real_type())
    return checked_known(value, what, shape, advice=advice)
