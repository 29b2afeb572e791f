"""How damping changes from one step of Levenberg-Marquardt to the next, and when steps have become short.

Source: D. W. Marquardt, SIAM J. Appl. Math. 11 (1963) 431; near the minimum slopes in place of values: W. W. Hager and H. Zhang, SIAM J. Optim. 16 (2005) 170.
"""

import math
import sys
from typing import NamedTuple

FIRST, LEAST, MOST = 1e-3, 1e-9, 1e9  # damping lambda: at first, at least, and where no step is found
GROWTH = 4.0  # factor by which damping grows after a step that failed, at first; twice as much after each further one
FASTEST = 10.0  # factor by which it falls after a good step
ENOUGH, WELL, OVER = 1e-4, 0.9, 0.6  # of what was promised: F falls by that much in a step that is taken, in a good one, and in one that overshoots
SHORT, FAST = 0.01, 0.1  # standard errors, of a step after which the next may be foretold; by what factor steps shrink then
SURELY = 0.1  # times the tolerance: what the next step is to be below, where it is not looked at
ERROR = 1e-6  # relative, of F: smaller changes may be errors of the simulation
SLOW = 0.25  # of F: what it is to fall to
TINY = sys.float_info.min


class Pace(NamedTuple):
    """Damping of the next step, and by what it changes."""

    damping: float = FIRST
    growth: float = GROWTH
    fall: float = FASTEST
    before: float = math.nan  # |J d| of the last step but one; NaN where none was taken
    last: float = math.nan  # and of the last

    def shrinkage(self, length: float) -> float:
        """Return the factor by which a step is shorter than the last; one, unless steps have become short so fast that the problem is linear here."""
        linear = length <= SHORT and self.last <= FAST * self.before and length <= FAST * self.last
        return length / max(self.last, TINY) if linear else 1.0

    def after_trial(self, length: float, before: float, after: float, promised: float, by_slopes: float, tolerance: float) -> "tuple[bool, Pace]":
        """Return whether a step is taken from F of `before` to `after` (infinite: the motion failed) where `promised` was its fall; and the next pace.

        Near the minimum the simulation's own error decides whether F falls: it jumps where a motion takes one step more. There the slopes of F at both
        ends of the step tell it to more digits: `by_slopes`.
        """
        found = before - after
        if abs(found) < ERROR * abs(before) or (promised < 100 * tolerance**2 and abs(found) < tolerance):
            found = by_slopes
        if not (math.isfinite(found) and found > ENOUGH * promised):
            # afterwards it falls slowly: in a curved valley every other step would fail
            return False, Pace(max(self.damping * self.growth, LEAST), 2 * self.growth, 2.0)
        ratio = found / max(promised, TINY)
        # damping rises where steps overshoot: where residuals stay large, undamped ones go to and fro along what shows least
        change = 1 / self.fall if ratio > WELL else 3.0 if ratio < OVER else 1.0
        return True, Pace(max(self.damping * change, LEAST), GROWTH, min(1.5 * self.fall, FASTEST), self.last, length)
