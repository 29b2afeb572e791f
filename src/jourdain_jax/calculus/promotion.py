"""Types and ranks of arrays combine as JAX's defaults have it in this package's own lines, also where the user has set stricter modes for theirs."""

from collections.abc import Callable
from functools import wraps
from typing import TypeVar

import jax

F = TypeVar("F", bound=Callable)


def with_usual_promotion(function: F) -> F:
    """The function, run and traced in those defaults: one that is called from outside, or that JAX calls once the call that asked for it has returned."""

    @wraps(function)
    def called(*args, **kwargs):
        with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
            return function(*args, **kwargs)

    return called  # type: ignore[return-value]
