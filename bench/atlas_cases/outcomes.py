"""What can become of a method in a case, and how it is decided from a measured error and from what the method
says of itself.
"""

from dataclasses import dataclass

import numpy as np

RIGHT, FLAGGED, WRONG, NAN, STALLED, NOT_APPLICABLE = (
    "right",
    "flagged",
    "wrong",
    "nan",
    "stalled",
    "not applicable",
)
OUTCOMES = (RIGHT, FLAGGED, WRONG, NAN, STALLED, NOT_APPLICABLE)


@dataclass(frozen=True)
class Outcome:
    """One cell of the atlas. `flag`: what the method says of its own failure, in words; empty where it claims
    success.
    """

    outcome: str
    error: float | None = None
    flag: str = ""


def judged(error: float, tolerance: float, flag: str = "", stalled: bool = False) -> Outcome:
    """Right where the error is within the tolerance and nothing is flagged; else flagged, NaN or wrong."""
    error = float(error)
    known = None if np.isnan(error) else error
    if stalled:
        return Outcome(STALLED, known, flag)
    if flag:
        return Outcome(FLAGGED, known, flag)
    if np.isnan(error):
        return Outcome(NAN)
    return Outcome(RIGHT if error <= tolerance else WRONG, error)


def not_applicable(why: str) -> Outcome:
    """The method cannot be asked about this case."""
    return Outcome(NOT_APPLICABLE, None, why)


def worst(values, expected, scale=None) -> float:
    """Largest |value - expected| relative to `scale` (default: the largest |expected|, at least 1e-300); NaN
    where a value is not finite.
    """
    values, expected = np.asarray(values, float), np.asarray(expected, float)
    size = max(float(np.max(np.abs(expected), initial=0.0)), 1e-300) if scale is None else scale
    return (
        float("nan")
        if not np.all(np.isfinite(values))
        else float(np.max(np.abs(values - expected), initial=0.0) / size)
    )
