"""The loop of a scene as a function of JAX: from rows of starts and times to save at, to states, and rows of ends.

Many motions run side by side in the widest registers; one by itself runs in narrow ones, in which an instruction takes less time. What a lane computes does
not depend on the width.
"""

from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jourdain_jax.motion.integrators.event_search import RUNNING
from jourdain_jax.motion.integrators.explicit_steps import Method
from jourdain_jax.motion.native import back, loop, samples
from jourdain_jax.motion.native.called import called
from jourdain_jax.motion.native.functions import Form
from jourdain_jax.motion.native.layout import Layout
from jourdain_jax.motion.native.taylor import TaylorSteps

MOST_KERNELS = 64  # whose names are kept; machine code lives as long as the process


class Start(NamedTuple):
    """A motion as a kernel is given it; the state and what is known are followed by their tangents (`Layout`)."""

    of_samples: tuple[Array, ...]  # as `samples.py` has them
    control: tuple[Float[Array, ""], ...]  # rtol, atol, shortest, longest and first step, most steps
    goals: Float[Array, "times"]  # since the start
    origin: Float[Array, ""]  # the time of the start
    y: tuple[Float[Array, "y"], ...]
    known: tuple[tuple[Float[Array, ""], ...], ...]

    def rows(self, dt: Sequence) -> Float[Array, "given"]:
        """The rows of a lane at the start, whose time has tangents."""
        rtol, atol, shortest, longest, first, most = self.control
        zero, one = jnp.zeros(()), jnp.ones(())
        progress = [zero, jnp.minimum(jnp.abs(first), longest), RUNNING * one, zero, zero, -one, jnp.inf * one, zero, jnp.inf * one, *dt]
        limits = [jnp.sign(self.goals[-1]), self.goals[-1], rtol, atol, shortest, longest, most, self.origin]
        known = [jnp.stack(part) for part in self.known if part]  # each tangent by itself: values may have no lanes where tangents have
        return jnp.concatenate([*self.y, jnp.stack(progress), jnp.stack(limits), *known])


class Found(NamedTuple):
    """A motion as a kernel returns it; each with its tangents."""

    y: tuple[Float[Array, "times y"], ...]  # at the goals
    end: tuple[Float[Array, "y"], ...]
    t: tuple[Float[Array, ""], ...]  # of the end, since the start
    rest: Float[Array, "rest"]  # rows of the progress after its time, and the number of goals that were reached one after the other


class Kernel(NamedTuple):
    """The loop over steps of a form."""

    form: Form
    run: Callable  # (*samples, rows of starts, goals): states at the goals, and rows of the end
    motion: Callable[[Start], Found]

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

    run_rows = called(lambda w: loop.write(w, form, steps), shapes, samples.arguments(layout))
    return Kernel(form, run, _motion(layout, run))


def _motion(layout: Layout, run: Callable) -> Callable[[Start], Found]:
    """`run` in words; a tangent has lanes where anything has that it depends on: all directions share the values of one motion."""
    n, parts = layout.y, 1 + len(layout.moving)

    @jax.custom_batching.custom_vmap
    def motion(start: Start) -> Found:
        states, end = run(*start.of_samples, start.rows([jnp.zeros(())] * (parts - 1)), start.goals)
        progress, dt, count = end[n * parts : -parts], end[-parts:-1], end[-1:]
        every = [slice(k * n, (k + 1) * n) for k in range(parts)]
        return Found(
            tuple(states[:, part] for part in every),
            tuple(end[part] for part in every),
            (progress[0], *dt),
            jnp.concatenate([progress[1:], count]),
        )

    @motion.def_vmap
    def motions(count, batched: Sequence, start: Start):
        (given,) = batched
        found = jax.vmap(motion.fun, [jax.tree.map(lambda has_axis: 0 if has_axis else None, given)], axis_size=count)(start)
        base = any(jax.tree.leaves(given._replace(y=(), known=())))
        own = [any(jax.tree.leaves((given.y[k], given.known[k]))) for k in range(parts)]
        lanes = tuple(base or any(own[other] for other in range(k + 1) if other & k == other) for k in range(parts))
        lanes = Found(lanes, lanes, lanes, lanes[0])
        return jax.tree.map(lambda x, has_lanes: x if has_lanes else x[0], found, lanes), lanes

    return motion


@lru_cache(maxsize=MOST_KERNELS)
def kernel_back(form: Form, method: Method, asked: tuple[int, ...]) -> Callable:
    """A function of samples, the rows of a start, cotangents of the states at the goals and of the end (with its time last), and the goals.

    It returns cotangents of the state at the start, and of the numbers `asked` for of those that the rates are given. A state has its tangent after it.
    """
    count = form.layout.integrated + len(asked)
    run_rows = called(lambda w: back.write(w, form, method, asked), lambda *_: ((count,),), samples.arguments(form.layout))
    return lambda *arguments: run_rows(*arguments)[0]
