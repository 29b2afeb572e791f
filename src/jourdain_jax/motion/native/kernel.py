"""The loop of a scene as a function of JAX: from rows of starts and times to save at, to states, and rows of ends.

Many motions run side by side in the widest registers; one by itself runs in narrow ones, in which an instruction takes less time. What a lane computes does
not depend on the width.
"""

from collections.abc import Callable
from functools import cache, lru_cache
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

ALONE = 2  # places for the lanes of one motion; measured: 64 us with 2, 66 with 1 or 4, 99 with 8 (10 s of a disc at 1e-8)
MOST_KERNELS = 64  # whose names are kept; machine code lives as long as the process


class Kernel(NamedTuple):
    """`run(starts, goals)` returns states (and their tangents, where the form has some) at the goals, and the rows of the end."""

    form: Form
    run: Callable

    @property
    def layout(self) -> Layout:
        """The rows of a lane."""
        return self.form.layout


@lru_cache(maxsize=MOST_KERNELS)
def kernel(form: Form, solver: type[diffrax.AbstractERK]) -> Kernel:
    """The kernel for what is integrated, by the tableau of a solver of diffrax."""
    method, layout = method_of(solver()), form.layout

    @cache
    def name(lanes: int) -> str:
        return ffi.registered(written(form, method, lanes, host.fuses(), 1 if lanes == ALONE else host.threads()))

    def call(lanes: int, starts: Float[Array, "*lanes rows"], goals: Float[Array, "*lanes times"]):
        shapes = (goals.shape[-1], layout.integrated), (layout.returned + 1,)
        results = tuple(jax.ShapeDtypeStruct((*goals.shape[:-1], *shape), jnp.float64) for shape in shapes)
        return jax.ffi.ffi_call(name(lanes), results, vmap_method="broadcast_all")(starts, goals)

    @jax.custom_batching.custom_vmap
    def run(starts: Float[Array, "rows"], goals: Float[Array, "times"]) -> tuple[Float[Array, "times y"], Float[Array, "ends"]]:
        return call(ALONE, starts, goals)

    @run.def_vmap
    def run_many(count: int, batched: list[bool], *arguments):
        starts, goals = (x if has_axis else jnp.broadcast_to(x, (count, *x.shape)) for x, has_axis in zip(arguments, batched, strict=True))
        return call(host.lanes(), starts, goals), (True, True)

    return Kernel(form, run)
