"""Warn of inaccurate derivatives: of motions that amplify errors, and of motions that cross a jump of their
loads.

The amplification is measured during differentiation. In reverse mode, a function L of a motion has cotangents
g = dL/dy at the states on which it depends and g_0 = dL/dy_0 at the start. With s = atol + rtol |y|, the
error that step-size control allows per step,

    amplification = sum |g_0| s_0 / sum |g| s
    relative error of a derivative <~ steps amplification rtol

because each step adds an error s, and the derivative is evaluated along a path displaced by the sum of these
errors. In forward mode, let d_0, d_m and d_1 be the tangents of the start, of the middle saved state and of
the end, and s the error for the largest |y| of each entry of the state:

    amplification = max |d_1|/s / max |d_0|/s              if only the start varies
                    (max |d_1|/s / max |d_m|/s)^2          otherwise; the smaller of both if the start varies

If the rates are f_1 before and f_2 after a jump at time s(p),

    dy/dp = (JAX's derivative) + (f_1 - f_2) ds/dp

The loop over steps counts how often a motion crosses a relation such as `a < b` (`lowering/sides.py`).
"""

import warnings

import equinox as eqx
import jax
import numpy as np

from jourdain_jax.calculus.markers import tap_cotangents, tap_tangents
from jourdain_jax.calculus.reals import at_index, is_traced
from jourdain_jax.integrate.own_steps import moving_jumps
from jourdain_jax.integrate.setup import Setup
from jourdain_jax.integrate.vector_fields.field import VectorField
from jourdain_jax.motion.trajectories.trajectory import Trajectory
from jourdain_jax.scene.arguments import warn


class SensitivityWarning(UserWarning):
    """Warning that a derivative has few correct digits because the motion amplifies errors, or that it omits
    the effect of a jump of the loads.
    """


def _judge(amplification: float, rtol: float, steps: int) -> None:
    """Warn if the errors of all steps together make a derivative inaccurate (more than 5 %)."""
    error = steps * amplification * rtol
    if error > 0.05:
        text = (
            f"the motion amplifies errors {amplification:.1e} times: with rtol = {rtol:g} and {steps} steps, "
            f"its derivative may have a relative error of {error:.0e}; tighten `rtol` and `atol` (in "
            "float64), or shorten the span"
        )
        warnings.warn(text, SensitivityWarning, stacklevel=3)


def warn_if_ill_conditioned(setup: Setup, integrate) -> Trajectory:
    """Return `integrate(setup)`. Differentiating the result outside `jit` warns if the motion amplifies
    errors too much.
    """
    varies = tuple(name for name, part in setup._asdict().items() if is_traced(part))
    if not varies:
        return integrate(setup)
    start = setup.start
    known = numbers_where_known((start.q, start.u, *setup.tolerances))
    if known is None:
        return integrate(setup)
    rtol, atol = float(known[2]), float(known[3])
    begun: list[np.ndarray] = []  # tangents of the start
    looked_at: list[float] = []  # sum |g| s over the states on which the result depends

    def weighed(values, cotangents) -> float:
        """Return `sum |g| (atol + rtol |y|)`, ignoring values that are not finite."""
        return float(
            sum(
                np.sum(np.nan_to_num(np.abs(g) * (atol + rtol * np.abs(y)), posinf=0.0))
                for y, g in zip(values, cotangents, strict=True)
            )
        )

    def start_varies(tangents):
        begun[:] = tangents

    def ends_vary(tangents):
        (q, u, q_end, u_end), middle = seen[:-1], len(seen[0]) // 2
        tops = [
            np.max(np.nan_to_num(np.abs(np.concatenate([x, last[None]]))), axis=0)
            for x, last in ((q, q_end), (u, u_end))
        ]

        def sizes(tangents):
            return np.maximum(
                *(
                    np.max(np.abs(d) / (atol + rtol * top), axis=1, initial=0.0)
                    for d, top in zip(tangents, tops, strict=True)
                )
            )

        ended = sizes(tangents[2:])
        first = sizes(begun) if begun else np.zeros_like(ended)  # zero if the start does not vary
        half = sizes([d[:, middle] for d in tangents[:2]]) if middle else np.zeros_like(ended)
        with np.errstate(divide="ignore", invalid="ignore"):
            from_start = np.where(first > 0, ended / first, np.inf)
            from_middle = np.where(half > 0, (ended / half) ** 2, 0.0)
        grown = (
            np.where(first > 0, from_start, 0.0)
            if varies == ("start",)
            else np.minimum(from_start, from_middle)
        )
        _judge(float(np.max(grown)), rtol, steps)

    def start_is_asked(cotangents):  # called last in reverse mode
        ended = sum(looked_at)
        looked_at.clear()
        if ended > 0:  # zero if the motion is traced: its end states are unknown
            _judge(weighed(known[:2], cotangents) / ended, rtol, steps)

    at_start = tap_cotangents(tap_tangents((start.q, start.u), start_varies), start_is_asked)
    motion = integrate(eqx.tree_at(lambda s: (s.start.q, s.start.u), setup, at_start))
    parts = (motion.q, motion.u, motion.q_end, motion.u_end)
    seen = numbers_where_known((*parts, motion.accepted))
    if seen is None:
        return motion
    steps = int(seen[-1])
    if {"scene", "start", "inputs", "t0"}.intersection(varies):
        warn_of_jumps(setup.field, motion, "scene" in varies)
    parts = tap_cotangents(
        tap_tangents(parts, ends_vary), lambda cotangents: looked_at.append(weighed(seen[:-1], cotangents))
    )
    return eqx.tree_at(lambda m: (m.q, m.u, m.q_end, m.u_end), motion, parts)


def warn_of_jumps(field: VectorField, motions: Trajectory, scene_varies: bool) -> None:
    """Warn if a differentiated motion crossed a relation at which rates jump. No warning if the number of
    crossings is traced.
    """
    crossings = numbers_where_known(motions.crossings)
    if crossings is None or not np.any(crossings):
        return
    names = at_index(motions.scene, 0) if motions.q.ndim > 2 else motions.scene
    if moving_jumps(field, names, motions.inputs, scene_varies, bool(np.all(crossings >= 0))):
        met = "crossed" if np.any(crossings > 0) else "may have crossed"
        text = (
            f"a motion of `{type(motions.scene).__name__}` {met} a jump of its loads (`<`, `where`, `sign`, "
            "`floor`, ...); its derivatives omit the shift of the jump's time. Smooth the load, as with "
            "`jnp.tanh`, or let an event end the motion there and start another"
        )
        warn(text, SensitivityWarning)


def numbers_where_known(values):
    """Return the values as numbers, even while they are differentiated outside `jit`; None if traced."""
    bare = jax.tree.map(lambda x: jax.lax.stop_gradient(x) if isinstance(x, jax.Array) else x, values)
    if is_traced(bare):
        return None
    return jax.tree.map(lambda x: np.asarray(x) if isinstance(x, jax.Array) else x, bare)
