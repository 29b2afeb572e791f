"""What can become of a generated case, and the record of it.

A motion is `right` where its error is within a bound; otherwise it must say so: by a result code
(`flagged by code`, what also a lane under `jit` has), by `motion.warnings` (`flagged by warning`), or by an
error of the engine's own kind (`refused`). Else it is `wrong`; any other error is `crashed`.
"""

from dataclasses import asdict, dataclass
from traceback import walk_tb

import numpy as np

RIGHT, BY_CODE, BY_WARNING = "right", "flagged by code", "flagged by warning"
REFUSED, WRONG, CRASHED = "refused", "wrong", "crashed"
UNDECIDED = "no reference"  # it did not settle: neither right nor wrong
OUTCOMES = (RIGHT, BY_CODE, BY_WARNING, REFUSED, WRONG, CRASHED, UNDECIDED)
LOST = (WRONG, CRASHED)  # what a search is for


@dataclass(frozen=True)
class Record:
    """One case: how it was made, what was asked, and what became of it."""

    family: str
    seed: int
    dtype: str
    asked: str  # in words: way, tolerance, times, numbers
    outcome: str
    error: float | None = None  # largest error over its bound
    said: str = ""  # by the engine, where it flagged, refused or crashed; where it is wrong, by the judge
    seconds: float = 0.0

    def as_dict(self):
        """As JSON holds it."""
        error = None if self.error is None or not np.isfinite(self.error) else float(self.error)
        return asdict(self) | {"error": error}


def outcome_of(code, error, said):
    """What became of a motion: by its result code, its error over what is allowed, and what is said against
    it.
    """
    return BY_CODE if code not in (0, 1) else RIGHT if error <= 1 else BY_WARNING if said else WRONG


def refusal(error: Exception):
    """Outcome and words of an error: the engine's own kinds are refusals, others crashes."""
    import jourdain_jax as jj

    own = isinstance(error, ValueError | jj.SimulationError | jj.DifferentiationModeError) and not _raw(error)
    text = str(error).strip().splitlines()
    return (REFUSED if own else CRASHED), f"{type(error).__name__}: {text[0][:160] if text else ''}"


def _raw(error: Exception):
    """Whether a ValueError was raised below the engine (JAX, NumPy, diffrax raise such too)."""
    *_, (raised, _) = walk_tb(error.__traceback__)
    return not raised.f_globals["__name__"].startswith("jourdain_jax")
