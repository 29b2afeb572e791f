"""The ways in which motions are asked for, many cases at once: from Python, inside the user's `jit` or
`vmap`, as a batch, as a batch inside `jit`.
"""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

import jourdain_jax as jj
from hunting.family import Ask, Family, together
from hunting.record import refusal


@dataclass(frozen=True)
class Failed:
    """An error in the place of a motion."""

    outcome: str
    said: str


def tolerance(ask: Ask):
    """That which is asked for in this process's floats."""
    return ask.rtol if jax.config.jax_enable_x64 else max(ask.rtol, 1e-5)


def ask_for(family: Family, ask: Ask, numbers, ts):
    """A `Trajectory` (as numbers) or `Failed` for every case."""
    rtol = tolerance(ask)

    def options(numbers):
        own = {name: numbers[name] for name in ("atol", "t0") if name in numbers}
        usual = {"t0": 0.0, "rtol": rtol, "atol": rtol, "retry": True, "events": True}
        return usual | ask.options | family.given_inputs(numbers) | own

    def motion(numbers, ts):
        scene = family.scene().replace(**family.parameters(numbers))
        return jj.simulate(scene, family.begin(numbers), ts=ts, **options(numbers))

    def lanes(many):
        own = {"parameters": family.parameters(many) or None, "ts": ts[0]} | options(numbers[0])
        return jj.rollout(family.scene(), family.begin(many), **own).lanes

    if ask.way == "simulate":
        return [_caught(motion, *case) for case in zip(numbers, ts, strict=True)]
    if ask.way == "jit":
        cases = jax.tree.map(jnp.asarray, [*zip(numbers, ts, strict=True)])
        compiled = jax.jit(motion)
        return [_caught(compiled, *case) for case in cases]
    many = jax.tree.map(jnp.asarray, together(numbers))
    batched = {
        "vmap": lambda many: jax.jit(jax.vmap(motion))(many, jnp.asarray(ts)),
        "rollout": lanes,
        "jit rollout": jax.jit(lanes),
    }
    found = _caught(batched[ask.way], many)
    if isinstance(found, Failed):
        return [found] * len(numbers)
    return [jax.tree.map(lambda x, i=i: x[i], found) for i in range(len(numbers))]


def _caught(call, *arguments) -> object:
    try:
        return jax.tree.map(np.asarray, call(*arguments))
    except Exception as error:
        return Failed(*refusal(error))
