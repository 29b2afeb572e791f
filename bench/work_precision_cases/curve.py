"""A curve of a chart: a method prepared once, then run at each of its settings."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

TOLERANCES = tuple(10.0**-k for k in range(4, 13))


@dataclass(frozen=True)
class Solved:
    """A final state: either `y` (coordinates and privileged speeds) or `q` and `u`; what it cost."""

    y: np.ndarray | None = None
    q: np.ndarray | None = None
    u: np.ndarray | None = None
    steps: float | None = None
    failed: str = ""  # why, where the end was not reached


@dataclass(frozen=True)
class Prepared:
    """A method ready to run: `run(setting)`, which is timed, and `read(raw)`, which is not."""

    run: Callable
    read: Callable


class NotApplicable(Exception):
    """The method cannot be asked this problem; the text says why."""


@dataclass(frozen=True)
class Curve:
    """A method on a problem. `prepare` may raise `NotApplicable` or `ImportError`, whose text is printed and
    recorded.
    """

    method: str
    settings: tuple
    prepare: Callable
    packages: tuple[str, ...] = ("jax", "jaxlib", "diffrax")
    kind: str = "peer"  # or "ours"
    setting_unit: str = "tolerance"  # or "step (s)"
    note: str = ""
