"""The loop of a scene as a function of JAX: from rows of starts and times to save at, to states, and rows of ends.

Many motions run side by side in the widest registers; one by itself runs in narrow ones, in which an instruction takes less time. What a lane computes does
not depend on the width.
"""

from collections.abc import Callable
from functools import lru_cache
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jourdain_jax.motion.integrators.tableaus import Method
from jourdain_jax.motion.native import back, loop, samples, slopes
from jourdain_jax.motion.native.called import called
from jourdain_jax.motion.native.functions import Form
from jourdain_jax.motion.native.layout import PROGRESS, Layout
from jourdain_jax.motion.native.taylor import TaylorSteps
from jourdain_jax.native import host

MOST_KERNELS = 64  # whose names are kept; machine code lives as long as the process


class Kernel(NamedTuple):
    """`run(*samples, starts, goals)` returns states (and their tangents, where the form has some) at the goals, and the rows of the end."""

    form: Form
    run: Callable
    along: Callable  # (*samples, starts, goals, tangents): states and the end, their tangents and that of the time of the end, all in one run

    @property
    def layout(self) -> Layout:
        """The rows of a lane."""
        return self.form.layout


@lru_cache(maxsize=MOST_KERNELS)
def kernel(form: Form, method: Method, order: int | None = None) -> Kernel:
    """The kernel for what is integrated, by a tableau, or by Taylor series up to an order."""
    steps, layout = method if order is None else TaylorSteps(order), form.layout

    def shapes(*arguments):
        return (arguments[-1].shape[-1], layout.integrated), (layout.returned + 1,)

    def run(*arguments: Float[Array, "..."]) -> tuple[Float[Array, "times y"], Float[Array, "ends"]]:
        return tuple(run_rows(*arguments))

    run_rows = called(lambda lanes, threads: loop.written(form, steps, lanes, host.fuses(), threads), shapes, samples.arguments(layout))
    return Kernel(form, run, _along(layout, run))


def _along(layout: Layout, run: Callable) -> Callable:
    """`run` of a form with tangents, given rows of starts as without, and tangents of the state and of what is known; values have lanes where starts do."""

    @jax.custom_batching.custom_vmap
    def along(*arguments):
        *of_samples, starts, goals, tangents = arguments
        n, rest = layout.y, layout.y + len(PROGRESS)
        rows = [starts[:n], tangents[:n], starts[n:rest], jnp.zeros(1), starts[rest:], tangents[n:]]
        states, end = run(*of_samples, jnp.concatenate(rows), goals)
        plain = jnp.concatenate([end[:n], end[2 * n : -2], end[-1:]])
        return states[:, :n], plain, states[:, n:], end[n : 2 * n], end[-2]

    @along.def_vmap
    def along_many(count: int, batched: list[bool], *arguments):
        found = jax.vmap(along.fun, [0 if has_axis else None for has_axis in batched], axis_size=count)(*arguments)
        if any(batched[:-1]):
            return found, (True,) * len(found)
        return (*(x[0] for x in found[:2]), *found[2:]), (False, False, True, True, True)  # all directions have the values of one motion

    return along


@lru_cache(maxsize=MOST_KERNELS)
def kernel_back(form: Form, method: Method, asked: tuple[int, ...]) -> Callable:
    """A function of samples, the rows of a start, cotangents of the states at the goals and of the end (with its time last), and the goals.

    It returns cotangents of the state at the start, and of the numbers `asked` for of those that the rates are given.
    """
    count = form.layout.y + len(asked)
    of_samples = samples.arguments(form.layout)
    run_rows = called(lambda lanes, threads: back.written(form, method, lanes, host.fuses(), threads, asked), lambda *_: ((count,),), of_samples)
    return lambda *arguments: run_rows(*arguments)[0]


@lru_cache(maxsize=MOST_KERNELS)
def kernel_of_rates(form: Form) -> Callable:
    """A function of samples, rows as those of a start, and their times as an array of one: the rates of the states in these rows."""
    count, of_samples = form.layout.y, samples.arguments(form.layout)
    run_rows = called(lambda lanes, threads: slopes.written(form, lanes, host.fuses(), threads), lambda *_: ((count,),), of_samples)
    return lambda *arguments: run_rows(*arguments)[0]
