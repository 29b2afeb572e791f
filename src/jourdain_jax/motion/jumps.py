"""Inputs that stand in velocity rows must not jump: speeds would have to jump with them, by an impulse that no acceleration holds."""

import jax
import jax.numpy as jnp
import numpy as np

from jourdain_jax.build.structure import structure_of
from jourdain_jax.calculus.reals import is_traced, real_type
from jourdain_jax.equations.rows import velocity_residual
from jourdain_jax.motion.inputs import Constant, Inputs, Sampled, inputs_at
from jourdain_jax.program.roughness import may_bend
from jourdain_jax.scene.scene import Scene

EVENLY, HALVINGS = 256, 60


def check_inputs_in_rows(scene: Scene, inputs: Inputs, t0, t1) -> None:
    """A ValueError that names an input on which rows depend and which jumps between the times t0 and t1, where all is known."""
    known = structure_of(scene)
    if not known.rows_of_inputs or is_traced(scene, inputs, t0, t1):
        return
    rough = {k: channel for k, channel in enumerate(inputs.channels) if not isinstance(channel, Constant | Sampled) and _may_jump(channel)}
    if not rough:
        return
    with jax.ensure_compile_time_eval():  # all is known, also inside a `jit`
        _check_known(scene, inputs, rough, known.coordinates[0], float(t0), float(t1))


def _check_known(scene: Scene, inputs: Inputs, rough: dict, q: np.ndarray, t0: float, t1: float) -> None:
    """As `check_inputs_in_rows`, of inputs that are `rough`, at some coordinates."""
    u = np.random.default_rng(5).standard_normal(len(scene.speed_names))
    slopes = jax.jacfwd(lambda f: velocity_residual(scene, t0, q, u, f))(jnp.asarray(inputs_at(inputs, t0)))
    in_rows = np.any(np.nan_to_num(np.asarray(slopes)) != 0, axis=0)
    for k, channel in rough.items():
        if in_rows[k] and (t := _first_jump(channel, t0, t1)) is not None:
            raise ValueError(
                f"input `{scene.inputs.entries[k]}` of `{type(scene).__name__}` jumps at t = {t:.6g} s, and velocity rows depend on it: speeds would have to "
                "jump there, by an impulse that no acceleration holds. Let it change within a short time, as by `jj.Sampled(ts, values)`, or end the motion "
                "there and start another with the speeds after the jump"
            )


def _may_jump(channel) -> bool:
    return any(may_bend(jax.make_jaxpr(lambda t: channel(t))(jax.ShapeDtypeStruct((), real_type())), (0,)))


def _first_jump(channel, t0: float, t1: float) -> float | None:
    """The time of the first jump that is met by halving intervals at whose ends the values differ."""
    values = jax.jit(jax.vmap(channel))
    ts = np.linspace(t0, t1, EVENLY + 1)
    a, b = ts[:-1], ts[1:]
    at_a, at_b = np.asarray(values(a), float), np.asarray(values(b), float)
    size = np.max(np.abs(np.concatenate([at_a, at_b])), initial=0.0)
    for _ in range(HALVINGS):
        middle = (a + b) / 2
        at_m = np.asarray(values(middle), float)
        first = np.abs(at_m - at_a) >= np.abs(at_b - at_m)
        a, at_a = np.where(first, a, middle), np.where(first, at_a, at_m)
        b, at_b = np.where(first, middle, b), np.where(first, at_m, at_b)
    jumps = np.abs(at_b - at_a) > 1e-6 * size
    return float(b[np.argmax(jumps)]) if jumps.any() else None
