"""Numbers as users give them, and whether they are known: what the layers above need of `calculus.reals`."""

import jax.numpy as jnp

from jourdain_jax.calculus.reals import checked_known, checked_real, described, is_traced

__all__ = ["checked_known", "checked_real", "checked_unless_traced", "described", "is_traced"]


def checked_unless_traced(value, what: str, shape: tuple[int, ...] | None = None, *, advice: str):
    """`value` in the default float: on NumPy where it is known, also inside `jit`; a JAX array where it is traced. A ValueError as of `checked_real`."""
    if is_traced(value):
        return checked_real(value, what, shape, advice=advice).astype(jnp.result_type(float))
    return checked_known(value, what, shape, advice=advice)
