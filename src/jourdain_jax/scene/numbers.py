"""Numbers as users give them, and whether they are known: what the layers above need of `calculus.reals`."""

import jax

from jourdain_jax.calculus.reals import checked_real, described

__all__ = ["checked_real", "described", "is_traced"]


def is_traced(*trees) -> bool:
    """Whether any leaf is being traced, so that its number is not known."""
    return any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(trees))
