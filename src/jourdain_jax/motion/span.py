"""The span of a motion and the times to save at, checked where they are known."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jourdain_jax.motion.arguments import as_state
from jourdain_jax.motion.inputs import Inputs
from jourdain_jax.motion.start import State
from jourdain_jax.scene.numbers import checked_real
from jourdain_jax.scene.scene import Scene

DEFAULT_SAMPLES = 201


def span_and_start(scene: Scene, start, t0, t1, ts, inputs: Inputs):
    """The start as a state (with the inputs at t0), t0, the times to save at, t1; a ValueError where they do not go together."""
    real = jnp.result_type(float)
    ts = None if ts is None else saved_times(ts)
    for name, value in (("t0", t0), ("t1", t1)):
        if value is not None:
            checked_real(value, f"`{name}`", (), advice="give one time in s")
    if t0 is None:
        t0 = start.t if isinstance(start, State) else 0.0
    if t1 is None:
        t1 = t0 + scene.example_span if ts is None else ts[-1]
    start = as_state(scene, start, t0=t0, inputs=None if isinstance(start, State) else inputs(jnp.asarray(t0, real)))
    if start.q.ndim != 1:
        raise ValueError(f"`start` holds a batch of shape {start.q.shape[:-1]}; use `jj.rollout` or `jax.vmap` for many starts")
    t0, t1 = jnp.asarray(t0, real), jnp.asarray(t1, real)
    known = not isinstance(t0, jax.core.Tracer) and not isinstance(t1, jax.core.Tracer)
    if known:
        check_span(t0, t1)
    if ts is None:
        first, last = (np.asarray(t0), np.asarray(t1)) if known else (t0, t1)  # known numbers: nothing to compile
        return start, t0, jnp.asarray(first + (last - first) * np.linspace(0.0, 1.0, DEFAULT_SAMPLES), real), t1
    _check_inside(ts, t0, t1)
    return start, t0, ts, t1


def check_span(t0, t1) -> None:
    """ValueError for a span of known ends that is empty or not finite."""
    if not (np.isfinite(t0) and np.isfinite(t1)) or t0 == t1:
        raise ValueError(f"the span from t0 = {t0} to t1 = {t1} s is empty or not finite; give a finite `t1` different from `t0`")


def _check_inside(ts, t0, t1) -> None:
    if any(isinstance(x, jax.core.Tracer) for x in (ts, t0, t1)):
        return
    first, last = (float(ts[0]), float(ts[-1])) if t1 > t0 else (float(ts[-1]), float(ts[0]))
    backwards = ts.shape[0] > 1 and bool((ts[-1] > ts[0]) != (t1 > t0))
    if backwards or first < min(t0, t1) or last > max(t0, t1):
        raise ValueError(f"`ts` runs from {ts[0]} to {ts[-1]} s, outside of the span from t0 = {t0} to t1 = {t1} s or against it; give `t0` and `t1` around it")


def saved_times(ts) -> Float[Array, "times"]:
    """Times to save at, as an array; a ValueError where they are no monotonic vector of finite numbers."""
    ts = checked_real(ts, "`ts`", advice="give a vector of times in s").astype(jnp.result_type(float))
    if ts.ndim != 1 or ts.shape[0] == 0:
        raise ValueError(f"`ts` has shape {ts.shape}, expected a vector of at least one time in s")
    if not isinstance(ts, jax.core.Tracer):
        steps = np.diff(np.asarray(ts))
        if not np.all(np.isfinite(np.asarray(ts))) or not (np.all(steps > 0) or np.all(steps < 0)):
            raise ValueError("`ts` must be finite and strictly increasing (or decreasing, for reversed time); sort it and drop repeated times")
    return ts
