"""Functions run once on NumPy, uncompiled: a first call takes a tenth of the time of compilation."""

from collections.abc import Callable
from functools import lru_cache, wraps
from inspect import signature

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jourdain_jax.calculus.reals import is_traced
from jourdain_jax.eager.lanes import uncompiled_lanes


def eval_numpy(f: Callable) -> Callable:
    """`f` run at once on concrete arguments, uncompiled: NumPy arrays out, also while something else is being traced.

    The function takes `lanes`, too: further arguments with an axis of lanes first, of which `f` gets those of one lane.
    """

    @lru_cache(maxsize=32)
    def program(treedef, rest, x64):
        return uncompiled_lanes(lambda numbers, *lane: f(*eqx.combine(numbers, jax.tree.unflatten(treedef, rest)), *lane), shared=1)

    @wraps(f)
    def run(*arguments, lanes=()):
        # a truth value is not a number here: it decides what is traced
        arguments = jax.tree.map(lambda x: np.asarray(x) if eqx.is_array_like(x) and not isinstance(x, bool) else x, arguments)
        numbers, others = eqx.partition(arguments, eqx.is_array)
        rest, treedef = jax.tree.flatten(others, is_leaf=lambda x: x is None)
        return program(treedef, tuple(rest), jax.config.jax_enable_x64)(numbers, *lanes)

    vars(run)["cache_clear"] = program.cache_clear
    return run


def eager_if_concrete(f: Callable) -> Callable:
    """`f` of numbers run uncompiled, so that a first call at a prompt takes a tenth of the time; of traced
    values, unchanged.

    What `f` finds out by the scene's own numbers (rank, privileged speeds) must be among its arguments: inside, the numbers are traced.
    """
    known, parameters = eval_numpy(f), signature(f)

    @wraps(f)
    def run(*given, **named):
        bound = parameters.bind(*given, **named)
        bound.apply_defaults()
        arguments = bound.args
        return f(*arguments) if is_traced(arguments) else jax.tree.map(jnp.asarray, known(*arguments))

    vars(run)["cache_clear"] = vars(known)["cache_clear"]
    return run
