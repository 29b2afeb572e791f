"""Check what is handed to `simulate` and its kin: the span, times to save at, starts.

Times are checked where they are known; where they are traced, whether they go together is found while the motion runs.

t0 <= ts_1 < ts_2 < ... <= t1,   or the other way round in reversed time
"""

from collections.abc import Mapping

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jourdain_jax.calculus.reals import as_array, checked_unless_traced, described, is_traced, real_type
from jourdain_jax.motion.start import State, named_start
from jourdain_jax.scene.scene import Scene

DEFAULT_SAMPLES = 201
_EVEN = np.linspace(0.0, 1.0, DEFAULT_SAMPLES)
_SHORT = 1e-9  # s, a span for motions that are not asked for


def as_state(scene: Scene, given, *, what: str = "start", t0=0.0, inputs=None, native: bool = True) -> State:
    """A state from a `State`, a dictionary of named values (the rest is solved for, as by `jj.start`), or None for the scene's example.

    `inputs`: the scene's inputs at that instant, a vector or by name (default: zero); they count where velocity rows depend on them.
    `native`: whether machine code may put it onto the rows.
    """
    if isinstance(given, State):
        return given
    if given is not None and not isinstance(given, Mapping):
        raise ValueError(
            f"`{what}` is {described(given)}, expected a State (from `jj.start` or `jj.consistent`), a dictionary of named values, or None for the "
            f"scene's example{'; write `.state` after it' if isinstance(getattr(given, 'state', None), State) else ''}"
        )
    return named_start(scene, scene.example if given is None else given, t0, inputs, native=native)


def span_and_times(scene: Scene, start, t0, t1, ts):
    """t0, the times to save at, t1; a ValueError where they are known and do not go together."""
    real = real_type()
    if isinstance(start, State) and start.q.ndim != 1:
        raise ValueError(f"`start` holds a batch of shape {start.q.shape[:-1]}; use `jj.rollout` or `jax.vmap` for many starts")
    ts = None if ts is None else saved_times(ts)
    t0, t1 = (as_end(name, value) for name, value in (("t0", t0), ("t1", t1)))
    if t0 is None:
        t0 = as_end("t", start.t if isinstance(start, State) else 0.0)
    if t1 is None:
        t1 = t0 + scene.example_span if ts is None else ts[-1]
    if not is_traced(t0, t1):
        check_span(t0, t1)
    if ts is None:
        ts = t0 + (t1 - t0) * _EVEN  # of known ends: nothing to compile
    elif not is_traced(ts, t0, t1):
        check_times(ts, t0, t1)
    return tuple(as_array(x, real) for x in (t0, ts, t1))


def as_end(name: str, value):
    """One end of the span; None stays. A ValueError where it is no number."""
    return None if value is None else checked_unless_traced(value, f"`{name}`", (), advice="give one time in s")


def check_span(t0, t1) -> None:
    """ValueError for a span of known ends that is empty or not finite."""
    if not (np.isfinite(t0) and np.isfinite(t1)) or t0 == t1:
        raise ValueError(f"the span from t0 = {t0} to t1 = {t1} s is empty or not finite; give a finite `t1` different from `t0`")


def check_times(ts, t0, t1) -> None:
    """ValueError for known times to save at that leave the span, or go against it."""
    if not times_fit(ts, t0, t1):
        raise ValueError(f"`ts` runs from {ts[0]} to {ts[-1]} s, outside of the span from t0 = {t0} to t1 = {t1} s or against it; give `t0` and `t1` around it")


def times_fit(ts, t0, t1) -> "Bool[Array, ''] | np.bool_":
    """Whether the span is finite and not empty, and the times to save at lie in it, one after another; also of traced times."""
    xp = jnp if is_traced(ts, t0, t1) else np
    direction = xp.sign(t1 - t0)
    # times at an end of the span may lie beyond it by four units in the last place
    slack = 4 * np.finfo(ts.dtype).eps * xp.maximum(xp.abs(t0), xp.abs(t1))
    from_start, to_end = (ts[0] - t0) * direction, (t1 - ts[-1]) * direction
    return (direction != 0) & xp.isfinite(t1 - t0) & xp.all((ts[1:] - ts[:-1]) * direction > 0) & (from_start >= -slack) & (to_end >= -slack)


def fitting_times(ts, t0, t1, dt0, longest):
    """`ts`, `t0`, `t1`, the first step and the longest one where they go together, none beyond an end by round-off; otherwise those of a short span."""
    fits, direction = times_fit(ts, t0, t1), jnp.sign(t1 - t0)
    inside = jnp.where((t1 - ts) * direction < 0, t1, jnp.where((ts - t0) * direction < 0, t0, ts))
    short = _SHORT * jnp.linspace(0.0, 1.0, ts.shape[-1], dtype=ts.dtype), jnp.zeros_like(t0)
    short += tuple(share * _SHORT * jnp.ones_like(x) for share, x in ((1.0, t1), (0.1, dt0), (1.0, longest)))
    return tuple(jnp.where(fits, own, other) for own, other in zip((inside, t0, t1, dt0, longest), short, strict=True))


def saved_times(ts) -> "Float[Array, 'times'] | Float[np.ndarray, 'times']":
    """Times to save at, on NumPy where they are known; a ValueError where they are no monotonic vector of finite numbers."""
    ts = checked_unless_traced(ts, "`ts`", advice="give a vector of times in s")
    if ts.ndim != 1 or ts.shape[0] == 0:
        raise ValueError(f"`ts` has shape {ts.shape}, expected a vector of at least one time in s")
    if not is_traced(ts):
        steps = np.diff(ts)
        if not np.all(np.isfinite(ts)) or not (np.all(steps > 0) or np.all(steps < 0)):
            raise ValueError("`ts` must be finite and strictly increasing (or decreasing, for reversed time); sort it and drop repeated times")
    return ts
