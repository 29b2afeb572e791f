"""Inputs that stand in velocity rows must not jump: speeds would have to jump with them."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool

from jourdain_jax.build.smoothness import SPEEDS_WOULD_JUMP
from jourdain_jax.build.structure import structure_of
from jourdain_jax.calculus.jumps import jumps
from jourdain_jax.calculus.reals import is_traced
from jourdain_jax.eager.lanes import uncompiled_lanes
from jourdain_jax.equations.rows import velocity_residual
from jourdain_jax.motion.inputs import Constant, Inputs, Sampled, inputs_at
from jourdain_jax.scene.scene import Scene


def check_inputs_in_rows(scene: Scene, inputs: Inputs, t0, t1) -> None:
    """A ValueError that names an input on which velocity rows depend and which jumps between the times t0 and t1; nothing where one of these is traced."""
    known = structure_of(scene)
    if not known.rows_of_inputs or is_traced(scene, inputs, t0, t1):
        return
    functions = [k for k, channel in enumerate(inputs.channels) if not isinstance(channel, Constant | Sampled)]
    if not functions:
        return
    with jax.ensure_compile_time_eval():  # all is known, also inside a `jit`
        in_rows = _in_rows(scene, inputs, known.coordinates[0], t0)
        for k in functions:
            if in_rows[k] and (t := _first_jump(inputs.channels[k], float(t0), float(t1))) is not None:
                name = scene.inputs.entries[k]
                raise ValueError(f"input `{name}` of `{type(scene).__name__}` jumps at t = {t:.6g} s, and velocity rows depend on it: {SPEEDS_WOULD_JUMP}")


def _in_rows(scene: Scene, inputs: Inputs, q: np.ndarray, t0) -> Bool[np.ndarray, "inputs"]:
    """Which of the inputs rows depend on, at some coordinates and speeds."""
    u = np.random.default_rng(5).standard_normal(len(scene.speed_names))
    slopes = jax.jacfwd(lambda f: velocity_residual(scene, t0, q, u, f))(jnp.asarray(inputs_at(inputs, t0)))
    return np.any(np.nan_to_num(np.asarray(slopes)) != 0, axis=0)


def _first_jump(channel: Callable, t0: float, t1: float) -> float | None:
    """When an input jumps between these times; None where it is not seen to."""
    values, ts = uncompiled_lanes(channel), np.linspace(t0, t1, 257)[:, None]
    found = jumps(lambda t: np.asarray(values(t[:, 0]), float)[:, None], ts[:-1], ts[1:])
    return next((float(behind[0]) for _, _, behind in found), None)
