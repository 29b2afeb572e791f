"""Numbers as users give them (lists, integers, NumPy arrays) as floating-point arrays of the shape that is expected."""

import jax
import jax.numpy as jnp
from jaxtyping import Array

from jourdain_jax.calculus.reals import as_real


def checked_real(value, what: str, shape: tuple[int, ...] | None = None, *, advice: str = "check how it is put together") -> Array:
    """`value` as a floating-point array.

    **Arguments**
    - `value`: a number, an array, or a list of numbers; integers are converted, floating-point arrays keep their type.
    - `what`: the thing in words, for the error.
    - `shape`: the shape it must have; None: any. Shapes are known while a function is traced: the check costs nothing at run time.
    - `advice`: what to do, for the error.

    **Raises** ValueError: no real numbers, or another shape.
    """
    try:
        array = jnp.asarray(value)
    except (TypeError, ValueError):
        raise ValueError(f"{what} is {described(value)}, expected real numbers; {advice}") from None
    if not jnp.issubdtype(array.dtype, jnp.integer) and not jnp.issubdtype(array.dtype, jnp.floating):
        raise ValueError(f"{what} is of type {array.dtype}, expected real numbers; {advice}")
    if shape is not None and array.shape != shape:
        expected = "one number" if shape == () else str(shape)
        raise ValueError(f"{what} has shape {array.shape}, expected {expected}; {advice}")
    return as_real(array)


def is_traced(*trees) -> bool:
    """Whether any leaf is being traced, so that its number is not known."""
    return any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(trees))


def described(value) -> str:
    """A value in an error message: `None`, the text 'abc', the class `Skate`, a list."""
    if value is None:
        return "`None`"
    if isinstance(value, str):
        return f"the text {value!r}"
    if isinstance(value, type):
        return f"the class `{value.__name__}`"
    if hasattr(value, "dtype") and hasattr(value, "shape"):
        return f"an array of shape {tuple(value.shape)}"
    name = type(value).__name__
    return f"an {name}" if name[0] in "aeioAEIO" else f"a {name}"
