"""The ways in which motions are asked for, many cases at once: from Python, inside the user's `jit` or `vmap`, as a batch, as a batch inside `jit`."""

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


def ask_for(family: Family, ask: Ask, numbers: list[dict], ts: np.ndarray) -> list:
    """A `Trajectory` (as numbers) or `Failed` for every case."""
    single = not jax.config.jax_enable_x64
    rtol = max(ask.rtol, family.rtol32) if single else ask.rtol
    options = {"rtol": rtol, "atol": rtol, "retry": True} | {"events": True} | ask.options

    def motion(numbers: dict, ts):
        given = {} if family.inputs is None else {"inputs": family.inputs(numbers)}
        size = {} if "atol" not in numbers else {"atol": numbers["atol"]}
        scene = family.scene().replace(**family.parameters(numbers))
        return jj.simulate(scene, family.start(numbers), t0=numbers.get("t0", 0.0), ts=ts, **options | given | size)

    def lanes(numbers: dict, first: dict, ts):
        given = {} if family.inputs is None else {"inputs": family.inputs(first)}
        size = {} if "atol" not in first else {"atol": first["atol"]}
        parameters = {name: value for name, value in family.parameters(numbers).items() if np.ndim(value)}
        fixed = {name: value for name, value in family.parameters(first).items() if name not in parameters}
        scene = family.scene().replace(**fixed)
        return jj.rollout(scene, family.start(numbers), parameters=parameters or None, t0=first.get("t0", 0.0), ts=ts, **options | given | size).lanes

    if ask.way == "simulate":
        return [_caught(lambda one=one, row=row: motion(one, row)) for one, row in zip(numbers, ts, strict=True)]
    if ask.way == "jit":
        compiled = jax.jit(motion)
        return [
            _caught(lambda one=one, row=row: compiled({k: jnp.asarray(v) for k, v in one.items()}, jnp.asarray(row)))
            for one, row in zip(numbers, ts, strict=True)
        ]
    many = {name: jnp.asarray(value) for name, value in together(numbers).items()}
    if ask.way == "vmap":
        found = _caught(lambda: jax.jit(jax.vmap(motion))(many, jnp.asarray(ts)))
    elif ask.way == "rollout":
        found = _caught(lambda: lanes(many, numbers[0], ts[0]))
    elif ask.way == "jit rollout":
        found = _caught(lambda: jax.jit(lambda many: lanes(many, numbers[0], ts[0]))(many))
    else:
        raise ValueError(f"unknown way `{ask.way}`")
    if isinstance(found, Failed):
        return [found] * len(numbers)
    return [jax.tree.map(lambda x, i=i: x[i], found) for i in range(len(numbers))]


def _caught(motion) -> object:
    try:
        return jax.tree.map(np.asarray, motion())
    except Exception as error:
        return Failed(*refusal(error))
