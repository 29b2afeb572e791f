"""Derivatives through motions that amplify errors: what reverse mode finds out anyway, said aloud.

A value L of a motion has the cotangents g = dL/dy at the states it looks at and g_0 = dL/dy_0 at the start. With s = atol + rtol |y|, what the step-size
control lets pass at one state,

    amplification = sum |g_0| s_0 / sum |g| s          relative error of a derivative <~ steps amplification rtol

for every step adds an error of s, the derivative is taken along a path that is off by their sum, and changes along it as much as the motion itself does.
"""

import warnings

import diffrax
import equinox as eqx
import jax
import numpy as np

from jourdain_jax.calculus.cotangents import shown_backwards
from jourdain_jax.motion.integration import Setup
from jourdain_jax.motion.trajectory import Trajectory
from jourdain_jax.scene.numbers import is_traced

LARGEST_ERROR = 0.05  # relative, of a derivative, beyond which a warning is given


class SensitivityWarning(UserWarning):
    """A derivative was taken through a motion that amplifies errors so much that few of its digits are right."""


class _Sizes:
    """What a state is off by, one tolerance, weighed by cotangents: of the states that are looked at, then of the start."""

    def __init__(self, rtol: float, atol: float):
        self.rtol, self.atol, self.steps, self.looked_at = rtol, atol, 0, 0.0

    def weighed(self, values, cotangents) -> float:
        """`sum |g| (atol + rtol |y|)`; what is not finite does not count."""
        parts = [np.abs(g) * (self.atol + self.rtol * np.abs(y)) for y, g in zip(values, cotangents, strict=True)]
        return float(sum(np.sum(np.where(np.isfinite(part), part, 0.0)) for part in parts))

    def ends(self, values, steps: int):
        """What to do with the cotangents of the states that are looked at, which come after so many steps."""
        self.steps = steps

        def look(cotangents):
            self.looked_at += self.weighed(values, cotangents)

        return look

    def start(self, values):
        """What to do with those of the start, which come last."""

        def look(cotangents):
            begun, self.looked_at, ended = self.weighed(values, cotangents), 0.0, self.looked_at
            error = self.steps * begun / ended * self.rtol if ended > 0 else 0.0
            if error > LARGEST_ERROR:
                warnings.warn(_text(begun / ended, self.rtol, self.steps, error), SensitivityWarning, stacklevel=2)

        return look


def _text(amplification: float, rtol: float, steps: int, error: float) -> str:
    return (
        f"the derivative goes through a motion that amplifies errors {amplification:.1e} times: with rtol = {rtol:g} in each of {steps} steps its "
        f"relative error may be {error:.0e}; tighten `rtol` and `atol` (in float64), or shorten the span"
    )


def watched(setup: Setup, integrate) -> Trajectory:
    """`integrate(setup)`; its derivative in reverse mode, taken outside of `jit`, warns where the motion amplifies errors too much."""
    if isinstance(setup.options.adjoint, diffrax.ForwardMode) or not is_traced(setup):
        return integrate(setup)
    start, (rtol, atol) = setup.start, setup.options.tolerances
    known = _known((start.q, start.u, rtol, atol))
    if known is None:
        return integrate(setup)
    sizes = _Sizes(float(known[2]), float(known[3]))
    at_start = shown_backwards((start.q, start.u), sizes.start(known[:2]))
    motion = integrate(eqx.tree_at(lambda s: (s.start.q, s.start.u), setup, at_start))
    parts = (motion.q, motion.u, motion.q_end, motion.u_end)
    seen = _known((*parts, motion.accepted))
    if seen is None:
        return motion
    shown = shown_backwards(parts, sizes.ends(seen[:-1], int(seen[-1])))
    return eqx.tree_at(lambda m: (m.q, m.u, m.q_end, m.u_end), motion, shown)


def _known(values) -> tuple | None:
    """The numbers of values that are being differentiated outside of `jit`; None where they have none."""
    bare = jax.tree.map(lambda x: jax.lax.stop_gradient(x) if isinstance(x, jax.Array) else x, values)
    return None if is_traced(bare) else tuple(np.asarray(x) for x in bare)
