"""The loop of a scene as a function of JAX: from rows of starts and times to save at, to states, and rows of ends."""

from collections.abc import Callable
from functools import lru_cache
from typing import NamedTuple

import diffrax
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jourdain_jax.motion.integrators.erk_loop import method_of
from jourdain_jax.motion.native.functions import Form
from jourdain_jax.motion.native.layout import Layout
from jourdain_jax.motion.native.loop import written
from jourdain_jax.native import ffi, host

MOST_KERNELS = 64  # whose names are kept; machine code lives as long as the process


class Kernel(NamedTuple):
    """`run(starts, goals)` returns states at the goals, and rows of ends; both with one row per lane."""

    layout: Layout
    run: Callable


@lru_cache(maxsize=MOST_KERNELS)
def kernel(form: Form, solver: type[diffrax.AbstractERK]) -> Kernel:
    """The kernel for what is integrated, by the tableau of a solver of diffrax."""
    layout = form.layout
    name = ffi.registered(written(form, method_of(solver()), host.lanes(), host.fuses()))

    def run(starts: Float[Array, "rows"], goals: Float[Array, "times"]) -> tuple[Float[Array, "times y"], Float[Array, "ends"]]:
        shapes = jax.ShapeDtypeStruct((len(goals), layout.y), jnp.float64), jax.ShapeDtypeStruct((layout.returned + 1,), jnp.float64)
        return jax.ffi.ffi_call(name, shapes, vmap_method="broadcast_all")(starts, goals)

    return Kernel(layout, run)
