"""NaN at times that a motion did not reach is intended; `jax_debug_nans` must not report it."""

from functools import wraps

import jax

from jourdain_jax.calculus.reals import F


def nan_is_a_mark():
    """Return a context in which JAX does not look for NaN."""
    return jax.debug_nans(False)


def with_nan_as_a_mark(f: F) -> F:
    """Return `f`, run without checks for NaN."""

    @wraps(f)
    def run(*arguments, **named):
        if not jax.config.jax_debug_nans:
            return f(*arguments, **named)
        with nan_is_a_mark():
            return f(*arguments, **named)

    return run  # type: ignore[return-value]
