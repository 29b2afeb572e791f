"""Times that a motion did not reach hold NaN on purpose; `jax_debug_nans` must not report them as an error."""

from collections.abc import Callable
from functools import wraps

import jax

from jourdain_jax.calculus.reals import is_traced
from jourdain_jax.motion.trajectories import results


def nan_is_a_mark():
    """A context in which JAX does not look for NaN."""
    return jax.debug_nans(False)


def with_nan_as_a_mark(f: Callable) -> Callable:
    """`f` run without a look for NaN."""

    @wraps(f)
    def run(*arguments, **named):
        if not jax.config.jax_debug_nans:
            return f(*arguments, **named)
        with nan_is_a_mark():
            return f(*arguments, **named)

    return run


def marked(integrate, setup):
    """`integrate(setup)` under `jax_debug_nans`: NaN after an event is a mark; where the motion failed, it is integrated again for JAX to find the NaN."""
    if not jax.config.jax_debug_nans:
        return integrate(setup)
    with nan_is_a_mark():
        motion = integrate(setup)
    if motion is None or is_traced(motion.result) or int(motion.result) in (results.SUCCESS, results.EVENT):
        return motion
    return integrate(setup)
