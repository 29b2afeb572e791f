"""Types and ranks of arrays combine as JAX's defaults have it in this package's own lines, also where the user has set stricter modes for theirs."""

from collections.abc import Callable
from contextlib import AbstractContextManager, ExitStack, nullcontext
from functools import wraps
from typing import TypeVar

import jax

F = TypeVar("F", bound=Callable)
_USUAL: AbstractContextManager = nullcontext()


def usual_promotion() -> AbstractContextManager:
    """A context with `jax_numpy_dtype_promotion` and `jax_numpy_rank_promotion` as they are by default; what is traced in it is traced so."""
    if jax.config.jax_numpy_dtype_promotion == "standard" and jax.config.jax_numpy_rank_promotion == "allow":
        return _USUAL
    modes = ExitStack()
    modes.enter_context(jax.numpy_dtype_promotion("standard"))
    modes.enter_context(jax.numpy_rank_promotion("allow"))
    return modes


def with_usual_promotion(function: F) -> F:
    """The function in that context: one that is called from outside, or that JAX calls once the call that asked for it has returned."""

    @wraps(function)
    def called(*args, **kwargs):
        with usual_promotion():
            return function(*args, **kwargs)

    return called  # type: ignore[return-value]
