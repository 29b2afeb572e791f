"""Warnings about derivatives through motions that amplify errors, as measured by differentiation itself, or
that cross a jump of their loads.

A value L of a motion has the cotangents g = dL/dy at the states it looks at and g_0 = dL/dy_0 at the start. With s = atol + rtol |y|, what the step-size
control lets pass at one state,

    amplification = sum |g_0| s_0 / sum |g| s          relative error of a derivative <~ steps amplification rtol

for every step adds an error of s, the derivative is taken along a path that is off by their sum, and changes along it as much as the motion itself does.
Forward mode has tangents d instead, of the states saved and of the start, and s of the largest |y| of each:

    amplification = max |d_1|/s / max |d_0|/s                  where nothing but the start depends on what is varied
                    (max |d_1|/s / max |d_middle|/s)^2         otherwise, and the smaller of both where the start does, too

Where rates are f_1 before and f_2 after the time s(p) of a jump,

    dy/dp = (what JAX finds) + (f_1 - f_2) ds/dp

and relations that a motion crossed are counted by its steps (`lowering/sides.py`).
"""

import warnings

import equinox as eqx
import jax
import numpy as np

from jourdain_jax.calculus.markers import tap_cotangents, tap_tangents
from jourdain_jax.calculus.reals import at_index, is_traced
from jourdain_jax.motion.own_steps import moving_jumps
from jourdain_jax.motion.setup import Setup
from jourdain_jax.motion.trajectories.trajectory import Trajectory
from jourdain_jax.motion.vector_fields.field import VectorField
from jourdain_jax.scene.arguments import warn


class SensitivityWarning(UserWarning):
    """A derivative through a motion that amplifies errors so much that few of its digits are right, or whose
    loads jump.
    """


def _judge(amplification: float, rtol: float, steps: int) -> None:
    """Warn if so many steps, each wrong by the tolerance, spoil a derivative."""
    error = steps * amplification * rtol
    if error > 0.05:
        text = (
            f"the derivative goes through a motion that amplifies errors {amplification:.1e} times: with "
            f"rtol = {rtol:g} in each of {steps} steps its relative error may be {error:.0e}; tighten `rtol` "
            "and `atol` (in float64), or shorten the span"
        )
        warnings.warn(text, SensitivityWarning, stacklevel=3)


def warn_if_ill_conditioned(setup: Setup, integrate) -> Trajectory:
    """Return `integrate(setup)`. Its derivative, taken outside of `jit`, warns where the motion amplifies
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
    looked_at: list[float] = []  # the ends that are looked at, weighed by their cotangents

    def weighed(values, cotangents) -> float:
        """Return `sum |g| (atol + rtol |y|)`; values that are not finite do not count."""
        return float(sum(np.sum(np.nan_to_num(np.abs(g) * (atol + rtol * np.abs(y)), posinf=0.0)) for y, g in zip(values, cotangents, strict=True)))

    def start_varies(tangents):
        begun[:] = tangents

    def ends_vary(tangents):
        (q, u, q_end, u_end), middle = seen[:-1], len(seen[0]) // 2
        tops = [np.max(np.nan_to_num(np.abs(np.concatenate([x, last[None]]))), axis=0) for x, last in ((q, q_end), (u, u_end))]

        def sizes(tangents):
            return np.maximum(*(np.max(np.abs(d) / (atol + rtol * top), axis=1, initial=0.0) for d, top in zip(tangents, tops, strict=True)))

        ended = sizes(tangents[2:])
        first = sizes(begun) if begun else np.zeros_like(ended)  # a start that nothing varies is not asked
        half = sizes([d[:, middle] for d in tangents[:2]]) if middle else np.zeros_like(ended)
        with np.errstate(divide="ignore", invalid="ignore"):
            from_start, from_middle = np.where(first > 0, ended / first, np.inf), np.where(half > 0, (ended / half) ** 2, 0.0)
        grown = np.where(first > 0, from_start, 0.0) if varies == ("start",) else np.minimum(from_start, from_middle)
        _judge(float(np.max(grown)), rtol, steps)

    def start_is_asked(cotangents):  # which comes last
        ended = sum(looked_at)
        looked_at.clear()
        if ended > 0:  # nothing is known of the ends of a motion that JAX traces
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
    parts = tap_cotangents(tap_tangents(parts, ends_vary), lambda cotangents: looked_at.append(weighed(seen[:-1], cotangents)))
    return eqx.tree_at(lambda m: (m.q, m.u, m.q_end, m.u_end), motion, parts)


def warn_of_jumps(field: VectorField, motions: Trajectory, scene_varies: bool) -> None:
    """Warn if one of the differentiated `motions` crossed relations at which rates jump. If crossings are
    unknown, there is no warning.
    """
    crossings = numbers_where_known(motions.crossings)
    if crossings is None or not np.any(crossings):
        return
    names = at_index(motions.scene, 0) if motions.q.ndim > 2 else motions.scene
    if moving_jumps(field, names, motions.inputs, scene_varies, bool(np.all(crossings >= 0))):
        met = "crossed" if np.any(crossings > 0) else "may have crossed"
        text = (
            f"a motion of `{type(motions.scene).__name__}` that is differentiated {met} relations (`<`, "
            "`where`, `sign`, `floor`, ...) at which loads jump: its derivatives omit the shift of the time "
            "of the jump. Let loads change within a short time or length, as by `jnp.tanh`, or end the "
            "motion there by an event and start another; the motion itself is right"
        )
        warn(text, SensitivityWarning)


def numbers_where_known(values):
    """Return the values with numbers if they are differentiated outside `jit`; None if they have no numbers.
    """
    bare = jax.tree.map(lambda x: jax.lax.stop_gradient(x) if isinstance(x, jax.Array) else x, values)
    return None if is_traced(bare) else jax.tree.map(lambda x: np.asarray(x) if isinstance(x, jax.Array) else x, bare)
