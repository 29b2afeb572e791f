"""Inputs that stand in velocity rows must not jump: speeds would have to jump with them."""

import jax
import numpy as np

from jourdain_jax.build.probed_on_graph import looked_at
from jourdain_jax.build.smoothness import SPEEDS_WOULD_JUMP
from jourdain_jax.build.structure import structure_of
from jourdain_jax.calculus.jumps import jumps
from jourdain_jax.calculus.reals import is_traced
from jourdain_jax.eager.lanes import uncompiled_lanes
from jourdain_jax.motion.inputs import Constant, Inputs, Sampled
from jourdain_jax.program.analyticity import depend_on
from jourdain_jax.scene.scene import Scene


def check_inputs_in_rows(scene: Scene, inputs: Inputs, t0, t1) -> None:
    """A ValueError that names an input on which velocity rows depend and which jumps between the times t0 and t1; nothing where one of these is traced."""
    if not structure_of(scene).rows_of_inputs or is_traced(scene, inputs, t0, t1):
        return
    traced = looked_at(scene).traced
    for name, node, channel in zip(scene.inputs.entries, traced.inputs.tolist(), inputs.channels, strict=True):
        if isinstance(channel, Constant | Sampled) or not any(depend_on(traced.graph, traced.at.phi.tolist(), [node])):
            continue
        with jax.ensure_compile_time_eval():  # all is known, also inside a `jit`
            values, ts = uncompiled_lanes(channel), np.linspace(float(t0), float(t1), 257)[:, None]
            for _, _, behind in jumps(lambda t, values=values: np.asarray(values(t[:, 0]), float)[:, None], ts[:-1], ts[1:]):
                raise ValueError(
                    f"input `{name}` of `{type(scene).__name__}` jumps at t = {behind[0]:.6g} s, and velocity rows depend on it: {SPEEDS_WOULD_JUMP}"
                )
