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


def tolerance(ask: Ask) -> float:
    """That which is asked for in this process's floats."""
    return ask.rtol if jax.config.jax_enable_x64 else max(ask.rtol, 1e-5)


def ask_for(family: Family, ask: Ask, numbers: list[dict], ts: np.ndarray) -> list:
    """A `Trajectory` (as numbers) or `Failed` for every case."""
    rtol = tolerance(ask)

    def options(numbers: dict) -> dict:
        size = {name: numbers[name] for name in ("atol", "t0") if name in numbers}
        return (
            {"t0": 0.0, "rtol": rtol, "atol": rtol, "retry": True, "events": True}
            | ask.options
            | family.given_inputs(numbers)
            | size
        )

    def motion(numbers: dict, ts):
        return jj.simulate(
            family.scene().replace(**family.parameters(numbers)),
            family.begin(numbers),
            ts=ts,
            **options(numbers),
        )

    def lanes(many: dict):
        return jj.rollout(
            family.scene(),
            family.begin(many),
            parameters=family.parameters(many) or None,
            ts=ts[0],
            **options(numbers[0]),
        ).lanes

    many = {name: jnp.asarray(value) for name, value in together(numbers).items()}
    one_by_one = {"simulate": motion, "jit": jax.jit(motion)}
    if ask.way in one_by_one:
        given = (
            numbers
            if ask.way == "simulate"
            else [{k: jnp.asarray(v) for k, v in one.items()} for one in numbers]
        )
        rows = ts if ask.way == "simulate" else jnp.asarray(ts)
        return [_caught(one_by_one[ask.way], *case) for case in zip(given, rows, strict=True)]
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
