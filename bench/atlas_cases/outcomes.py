"""What can become of a method in a case, and how it is decided from a measured error and from what the method
says of itself.
"""

from dataclasses import dataclass

import numpy as np

OUTCOMES = ("right", "flagged", "wrong", "nan", "stalled", "not applicable")
RIGHT, FLAGGED, WRONG, NAN, STALLED, NOT_APPLICABLE = OUTCOMES


@dataclass(frozen=True)
class Outcome:
    """One cell of the atlas. `flag`: what the method says of its own failure, in words; empty where it claims
    success.
    """

    outcome: str
    error: float | None = None
    flag: str = ""


def judged(error, tolerance, flag="", stalled=False) -> Outcome:
    """Right where the error is within the tolerance and nothing is flagged; else flagged, NaN or wrong."""
    known = None if np.isnan(error) else float(error)
    if stalled or flag:
        return Outcome(STALLED if stalled else FLAGGED, known, flag)
    return Outcome(NAN if known is None else RIGHT if known <= tolerance else WRONG, known)


def not_applicable(why) -> Outcome:
    """The method cannot be asked about this case."""
    return Outcome(NOT_APPLICABLE, None, why)


def worst(values, expected, scale=None):
    """Largest |value - expected| relative to `scale` (default: the largest |expected|, at least 1e-300); NaN
    where a value is not finite.
    """
    values, expected = np.asarray(values, float), np.asarray(expected, float)
    if not np.all(np.isfinite(values)):
        return float("nan")
    size = max(np.max(np.abs(expected), initial=0.0), 1e-300) if scale is None else scale
    return float(np.max(np.abs(values - expected), initial=0.0) / size)
