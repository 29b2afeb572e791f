"""How far an unknown may be moved before the data object, all others being fitted anew: profile likelihood.

    rise(x) = 2 min (F - F_min) / inflation       over all unknowns but one, which is held at x; inflation: as of the covariance, for the loss and for sigmas
    interval: where rise(x) <= 3.841, the 95 % quantile of chi-square with one degree of freedom              that are estimated

bounded: both ends are found; one-sided: one of them; flat: none, the data do not tell the unknown. From the estimate outwards, each point begins where the
one before it ended. Correlation times are held. Source: D. J. Venzon and S. H. Moolgavkar, Applied Statistics 37 (1988) 87; A. Raue et al., Bioinformatics 25
(2009) 1923.
"""

from collections.abc import Iterable

import equinox as eqx
import numpy as np
from jaxtyping import Float

from jourdain_jax.analysis.asked import TakenUp
from jourdain_jax.analysis.at_bounds import RISE_95
from jourdain_jax.analysis.levenberg_marquardt import minimum_beside
from jourdain_jax.scene.names import UnknownNameError, nearest
from jourdain_jax.scene.printing import Printed

_CLOSE = 0.01  # of the rise at the end of an interval
_POINTS, _REFINED = 16, 8  # at most, on one side: outwards, and between the last two
_JUMP = 3.0  # times the rise at the end of an interval: with more between two points, it may jump
_STEP = 0.6  # of sqrt(rise), from point to point
_FAR = 1e3  # sizes of the unknown, beyond which nothing is looked for
_LOWER = 0.02  # of the rise, by which a lower minimum is found


class Profile(Printed, eqx.Module):
    """The rise of the sum of squares along one unknown, and the 95 % interval that follows from it."""

    name: str = eqx.field(static=True)
    unit: str = eqx.field(static=True)
    estimate: float
    values: Float[np.ndarray, "points"]  # increasing, the estimate among them
    rise: Float[np.ndarray, "points"]  # zero at the estimate
    low: float  # ends of the interval; where the data set none, the bound, or infinite
    high: float
    is_closed: tuple[bool, bool] = eqx.field(static=True)  # whether the data set them
    kind: str = eqx.field(static=True)  # "bounded", "one-sided" or "flat"
    notes: tuple[str, ...] = eqx.field(static=True)  # what else was seen

    def _text(self) -> str:
        unit = f" {self.unit}" if self.unit else ""
        ends = "no data set an end to it" if self.kind == "flat" else f"[{self.low:.6g}, {self.high:.6g}]{unit}"
        return "; ".join((f"`{self.name}` = {self.estimate:.6g}{unit}, profile {self.kind}: {ends}", *self.notes))


def profiles(fitted: TakenUp, names: Iterable[str], errors: dict[str, float], inflation: dict[str, float]) -> dict[str, Profile]:
    """Profiles of the unknowns named. `errors`: standard errors by name, for the first step; `inflation`: by what the rise is divided."""
    unknowns, found = fitted.problem.unknowns, {}
    for name in names:
        if name not in unknowns.labels:
            raise UnknownNameError(f"`{name}` was not estimated; {nearest(name, unknowns.labels)}")
        place = int(unknowns.estimated[unknowns.labels.index(name)])
        sides = [_Side(fitted, place, errors[name], inflation[name], way) for way in (-1.0, 1.0)]
        ends = [side.end() for side in sides]
        points = sorted({(float(fitted.theta[0, place]), 0.0), *sides[0].points, *sides[1].points})
        closed = sides[0].is_closed, sides[1].is_closed
        kind = ("flat", "one-sided", "bounded")[sum(closed)]
        notes = tuple(dict.fromkeys(side.note for side in sides if side.note))
        values, rise = np.array(points).T
        estimate = float(fitted.theta[0, place])
        found[name] = Profile(name, unknowns.units[unknowns.labels.index(name)], estimate, values, rise, ends[0], ends[1], closed, kind, notes)
    return found


class _Side:
    """The profile from the estimate to one side."""

    def __init__(self, fitted: TakenUp, place: int, error: float, inflation: float, way: float):
        self._fitted, self._place, self._inflation, self._way = fitted, place, inflation, way
        self._size = float(fitted.problem.unknowns.sizes(fitted.theta)[0, place])
        self._first = _STEP * error if np.isfinite(error) and error > 0 else 0.1 * self._size
        self._bound = float((fitted.limits.low if way < 0 else fitted.limits.high)[place])
        self.points: list[tuple[float, float]] = []
        self.is_closed, self.note = False, ""

    def end(self) -> float:
        """The end of the interval on this side; infinite, or the bound, where there is none."""
        theta, origin, step = self._fitted.theta, float(self._fitted.theta[0, self._place]), self._first
        far, rise, slope = 0.0, 0.0, None
        room = min(abs(self._bound - origin), _FAR * max(self._size, self._first))
        for _ in range(_POINTS):
            if far >= room:
                break
            at = min(far + step, room)
            # others go on as they went from the point before to this one
            found, there = self._solved(theta if slope is None else theta + slope * (at - far), origin + self._way * at)
            if not np.isfinite(found):
                step = (at - far) / 4
                if step < 1e-3 * self._first:
                    break
                self.note = f"the motion fails near {origin + self._way * at:.4g}"
                continue
            self.points.append((origin + self._way * at, found))
            if found < -_LOWER * RISE_95:
                self.note = f"a lower minimum than that of the fit lies near {origin + self._way * at:.6g}: fit again from there"
            if found >= RISE_95:
                self.is_closed, self.note = True, "" if "fails" in self.note else self.note
                return origin + self._way * self._crossing(theta, origin, (far, rise), (at, found))
            speed = (np.sqrt(max(found, 0.0)) - np.sqrt(max(rise, 0.0))) / (at - far)
            step = (at - far) * float(np.clip(_STEP / max(speed * (at - far), 1e-9), 0.5, 4.0))
            slope, theta, far, rise = (there - theta) / (at - far), there, at, found
        return self._bound if np.isfinite(self._bound) else self._way * np.inf

    def _solved(self, theta: np.ndarray, value: float) -> tuple[float, np.ndarray]:
        """The rise at a value of the unknown, and all others there; infinite where the motion fails."""
        found = minimum_beside(self._fitted.evaluate, theta, self._place, value, self._fitted.limits, self._fitted.asked.control)
        if np.isfinite(found.at.cost[0]) and not found.converged[0]:
            self.note = f"no minimum over the others was found near {value:.4g}, so that the interval may be too narrow"
        return 2 * float(found.at.cost[0] - self._fitted.at.cost[0]) / self._inflation, found.theta

    def _crossing(self, theta: np.ndarray, origin: float, inner: tuple[float, float], outer: tuple[float, float]) -> float:
        """Where the rise is that of the interval's end, between two points: by halves where it jumps, else by secants of its root, which is nearly straight.

        `theta`: all unknowns at the inner point, from which the others follow; beyond the outer one they may have gone elsewhere.
        """
        for _ in range(_REFINED):
            low, end, high = np.sqrt(np.maximum([inner[1], RISE_95, outer[1]], 0.0))
            middle = inner[0] + (outer[0] - inner[0]) * (0.5 if outer[1] > _JUMP * RISE_95 else float((end - low) / (high - low)))
            found, there = self._solved(theta, origin + self._way * middle)
            self.points.append((origin + self._way * middle, found))
            if abs(found / RISE_95 - 1) < _CLOSE:
                return middle
            if found < RISE_95:
                inner, theta = (middle, found), there
            else:
                outer = middle, found
        self.note = f"the sum of squares jumps near {origin + self._way * outer[0]:.4g}: beyond it, other unknowns are elsewhere"
        return outer[0]
