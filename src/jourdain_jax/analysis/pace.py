"""How damping changes from one step of Levenberg-Marquardt to the next, and when steps have become short: of numbers, or in compiled code.

A pace is (damping, growth, fall, lengths |J d| of the last two steps); lengths are NaN where no step was taken.
Source: D. W. Marquardt, SIAM J. Appl. Math. 11 (1963) 431; near the minimum slopes in place of values: W. W. Hager and H. Zhang, SIAM J. Optim. 16 (2005) 170.
"""

import math
import sys
from types import ModuleType, SimpleNamespace

from jaxtyping import Array, Bool, Float

FIRST, LEAST, MOST = 1e-3, 1e-9, 1e9  # damping lambda: at first, at least, and where no step is found
GROWTH = 4.0  # factor by which damping grows after a step that failed, at first; twice as much after each further one
FASTEST = 10.0  # factor by which it falls after a good step
ENOUGH, WELL, OVER = 1e-4, 0.9, 0.6  # of what was promised: F falls by that much in a step that is taken, in a good one, and in one that overshoots
SHORT, FAST = 0.01, 0.1  # standard errors, of a step after which the next may be foretold; by what factor steps shrink then
SURELY = 0.1  # times the tolerance: what the next step is to be below, where it is not looked at
ERROR = 1e-6  # relative, of F: smaller changes may be errors of the simulation
SLOW = 0.25  # of F: what it is to fall to
TINY = sys.float_info.min
BEGIN = (FIRST, GROWTH, FASTEST, math.nan, math.nan)
# What these rules take from `jax.numpy`, of single numbers: they take a thirtieth of NumPy's time.
NUMBERS = SimpleNamespace(where=lambda which, a, b: a if which else b, maximum=max, minimum=min, isfinite=math.isfinite, stack=tuple)

Number = float | Float[Array, ""]
Pace = tuple[float, ...] | Float[Array, "5"]


def shrinkage(xp: ModuleType | SimpleNamespace, pace: Pace, length: Number) -> Number:
    """The factor by which a step is shorter than the last; one, unless steps have become short so fast that the problem is seen to be linear here."""
    *_, before, last = pace
    linear = (length <= SHORT) & (last <= FAST * before) & (length <= FAST * last)
    return xp.where(linear, length / xp.maximum(last, TINY), 1.0)


def after_trial(
    xp: ModuleType | SimpleNamespace, pace: Pace, length: Number, before: Number, after: Number, promised: Number, by_slopes: Number, tolerance: Number
) -> tuple[bool | Bool[Array, ""], Pace]:
    """Whether a step is taken from F of `before` to `after` (infinite: the motion failed) where it was `promised` to fall by so much; and the next pace.

    Near the minimum the simulation's own error decides whether F falls: it jumps where a motion takes one step more. There the slopes of F at both ends
    of the step tell it to more digits: `by_slopes`.
    """
    found = before - after
    closely = (abs(found) < ERROR * abs(before)) | ((promised < 100 * tolerance**2) & (abs(found) < tolerance))
    found = xp.where(closely, by_slopes, found)
    taken, ratio = xp.isfinite(found) & (found > ENOUGH * promised), found / xp.maximum(promised, TINY)
    damping, growth, fall, _, last = pace
    # damping rises where steps overshoot: where residuals stay large, undamped ones go to and fro along what shows least;
    # after a step that failed, it falls slowly: in a curved valley every other step would fail
    change = xp.where(taken, xp.where(ratio > WELL, 1 / fall, xp.where(ratio < OVER, 3.0, 1.0)), growth)
    return taken, xp.stack(
        [
            xp.maximum(damping * change, LEAST),
            xp.where(taken, GROWTH, 2 * growth),
            xp.where(taken, xp.minimum(1.5 * fall, FASTEST), 2.0),
            xp.where(taken, last, math.nan),
            xp.where(taken, length, math.nan),
        ]
    )
