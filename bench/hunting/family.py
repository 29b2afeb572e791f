"""A family of generated motions: numbers are drawn by seed, the truth is computed apart from the engine, and cases that ask alike share a compiled program."""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

Numbers = dict[str, np.ndarray]  # name -> one number per case, shape (cases,)


@dataclass(frozen=True)
class Truth:
    """Right motions: values of the compared names at the saved times (NaN after an event), and where and how they end."""

    values: np.ndarray  # (cases, times, names)
    t_end: np.ndarray | None = None  # (cases,), s; None: the last time
    end: np.ndarray | None = None  # (cases, names); None: the last of `values`
    event: list[str] | None = None  # by case; "": none

    @property
    def last(self) -> np.ndarray:
        """Values at the end."""
        return self.values[:, -1] if self.end is None else self.end


@dataclass(frozen=True)
class Ask:
    """How a motion is asked for."""

    way: str  # "simulate", "jit", "vmap", "rollout", "jit rollout"
    times: int = 1
    rtol: float = 1e-8
    options: dict = field(default_factory=dict)  # of `simulate`

    def __str__(self) -> str:
        more = "".join(f", {name}={value}" for name, value in self.options.items())
        return f"{self.way}, {self.times} times, rtol={self.rtol:g}{more}"


SOME = (Ask("simulate"), Ask("jit", 33), Ask("rollout", 33, 1e-6), Ask("vmap"), Ask("simulate", 33, 1e-6), Ask("rollout"), Ask("jit rollout", 1, 1e-6))


@dataclass(frozen=True)
class Family:
    """Scenes of one class with drawn numbers; see the fields.

    Numbers may be named freely, `span` is the length of a motion, `t0` its start. Functions of numbers work on floats and on arrays of cases alike.
    """

    name: str
    what: str  # in words
    scene: Callable[[], object]
    draw: Callable[[np.random.Generator], dict[str, float]]
    start: Callable[[dict], dict]  # numbers -> name -> start value
    truth: Callable[[Numbers, np.ndarray], Truth]  # numbers, ts (cases, times) -> Truth
    names: tuple[str, ...]  # coordinates and speeds that are compared
    parameters: Callable[[dict], dict] = lambda n: {}
    inputs: Callable[[dict], dict] | None = None
    times: Callable[[dict, int], np.ndarray] | None = None  # numbers of one case, count -> ts; default: even ones
    asks: tuple[Ask, ...] = SOME
    cases: int = 70  # of a full search, in proportion
    shared: tuple[str, ...] = ("span", "t0")  # numbers that the lanes of a rollout have in common
    fixed: tuple[str, ...] = ("span", "t0")  # numbers that are not varied to see how much a motion amplifies errors
    slack: float = 1.0
    size: Callable[[Numbers], np.ndarray] | None = None  # numbers -> (cases, names): of what counts as small in each name; default 1
    single: bool = True  # whether it is asked in float32, too
    rtol32: float = 1e-5

    def numbers(self, seed: int, single: bool = False) -> tuple[Ask, dict[str, float]]:
        """What is asked in the case with this seed, and its numbers."""
        ask = self.asks[seed % len(self.asks)]
        numbers = self.draw(np.random.default_rng([seed, 77]))
        if "rollout" in ask.way:
            common = self.draw(np.random.default_rng([seed % len(self.asks), 78]))
            numbers |= {name: common[name] for name in self.shared if name in common}
        if single:
            numbers = {name: float(np.float32(value)) for name, value in numbers.items()}
        return ask, numbers

    def run(self, seeds: list[int]):
        """Records of the cases with these seeds."""
        from hunting.judging import search

        return search(self, seeds)

    def saved(self, ask: Ask, numbers: dict, single: bool = False) -> np.ndarray:
        """Times to save at; what they are after rounding to the engine's floats."""
        t0 = numbers.get("t0", 0.0)
        ts = self.times(numbers, ask.times) if self.times else t0 + numbers["span"] * np.arange(1, ask.times + 1) / ask.times
        return np.asarray(ts, np.float32 if single else float).astype(float)


def together(numbers: list[dict]) -> Numbers:
    """Numbers of many cases as arrays."""
    return {name: np.array([one[name] for one in numbers]) for name in numbers[0]}
