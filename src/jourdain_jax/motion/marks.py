"""Times that a motion did not reach hold NaN on purpose; `jax_debug_nans` must not report them as an error."""

import jax

from jourdain_jax.motion.trajectories import results
from jourdain_jax.scene.numbers import is_traced


def nan_is_a_mark():
    """A context in which JAX does not look for NaN."""
    return jax.debug_nans(False)


def marked(integrate, setup):
    """`integrate(setup)` under `jax_debug_nans`: NaN after an event is a mark; where the motion failed, it is integrated again for JAX to find the NaN."""
    if not jax.config.jax_debug_nans or is_traced(setup):
        return integrate(setup)
    with nan_is_a_mark():
        motion = integrate(setup)
    return motion if int(motion.result) in (results.SUCCESS, results.EVENT) else integrate(setup)
