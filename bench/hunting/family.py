"""A family of generated motions: numbers are drawn by seed, the truth is computed apart from the engine, and
cases that ask alike share a compiled program.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from types import SimpleNamespace

import numpy as np

G = 9.81  # m/s^2


@dataclass(frozen=True)
class Truth:
    """Right motions: values of the compared names at the saved times (NaN after an event), and where and how
    they end.
    """

    values: np.ndarray  # (cases, times, names)
    t_end: np.ndarray | None = None  # (cases,), s; None: the last time
    end: np.ndarray | None = None  # (cases, names); None: the last of `values`
    event: list[str] | None = None  # by case; "": none

    @property
    def last(self) -> np.ndarray:
        """Values at the end."""
        return self.values[:, -1] if self.end is None else self.end


def columns(*values) -> np.ndarray:
    """Arrays (cases, times) of names side by side, (cases, times, names)."""
    return np.stack(np.broadcast_arrays(*values), axis=-1)


def stopped(values_at: Callable, t_end, event: list[str], ts) -> Truth:
    """Values at the saved times up to the end (cases, 1), NaN after it."""
    reached = ts <= t_end * (1 + 1e-12)
    return Truth(
        np.where(reached[..., None], columns(*values_at(ts)), np.nan),
        t_end[:, 0],
        columns(*values_at(t_end))[:, 0],
        event,
    )


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


SOME = (
    Ask("simulate"),
    Ask("jit", 33),
    Ask("rollout", 33, 1e-6),
    Ask("vmap"),
    Ask("simulate", 33, 1e-6),
    Ask("rollout"),
    Ask("jit rollout", 1, 1e-6),
)
FEW = SOME[:4]  # of scenes that take long to build


def either(low: float, high: float) -> Callable:
    """A number of either sign."""
    return lambda r: r.choice([-1.0, 1.0]) * r.uniform(low, high)


def one_of(*values) -> Callable:
    """One of some numbers, or of pairs between which one is drawn."""
    return lambda r: r.choice([r.uniform(*x) if isinstance(x, tuple) else x for x in values])


def power(low: float, high: float) -> Callable:
    """Ten to a power between these."""
    return lambda r: 10 ** r.uniform(low, high)


def drawn(**numbers) -> Callable:
    """Numbers one after another: between the two of a pair, by a function of the generator, or as they
    are.
    """
    return lambda r: {
        name: float(r.uniform(*x) if isinstance(x, tuple) else x(r) if callable(x) else x)
        for name, x in numbers.items()
    }


@dataclass(frozen=True)
class Family:
    """Scenes of one class with drawn numbers; see the fields.

    Numbers that are called as a parameter, coordinate or speed of the scene are its value; others serve
    `start` and `truth`. `span` is the length of a motion, `t0` its start. A function of numbers has them as
    attributes, floats or arrays of cases alike.
    """

    name: str
    what: str  # in words
    scene: Callable[[], object]
    draw: Callable[[np.random.Generator], dict[str, float]]
    truth: Callable[
        [SimpleNamespace, np.ndarray], tuple | Truth
    ]  # numbers (cases, 1), ts (cases, times) -> values of `names`, or all of it
    names: str  # coordinates and speeds that are compared
    start: Callable[[SimpleNamespace], dict] = (
        lambda n: {}
    )  # further start values; coordinates without one are zero
    inputs: Callable[[SimpleNamespace], dict] | None = None
    times: Callable[[SimpleNamespace, int], np.ndarray] | None = (
        None  # numbers of one case, count -> ts; default: even ones
    )
    asks: tuple[Ask, ...] = SOME
    cases: int = 70  # of a full search, in proportion
    shared: tuple[str, ...] = ("span", "t0")  # numbers that the lanes of a rollout have in common
    fixed: tuple[str, ...] = (
        "span",
        "t0",
    )  # numbers that are not varied to see how much a motion amplifies errors
    slack: float = 1.0
    size: Callable[[SimpleNamespace], tuple] | None = (
        None  # numbers -> of what counts as small in each name; default 1
    )
    single: bool = True  # whether it is asked in float32, too

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

    def parameters(self, numbers: dict) -> dict:
        """Values of the scene's parameters."""
        fields = self.scene().__dataclass_fields__
        return {name: value for name, value in numbers.items() if name in fields}

    def begin(self, numbers: dict) -> dict:
        """Values at the start, each as long as the numbers."""
        coordinates, speeds = self.scene().coordinate_names.entries, self.scene().speed_names.entries
        given = dict.fromkeys(coordinates, 0.0) | {
            name: numbers[name] for name in (*coordinates, *speeds) if name in numbers
        }
        return {
            name: value + 0.0 * numbers["span"]
            for name, value in (given | self.start(SimpleNamespace(**numbers))).items()
        }

    def given_inputs(self, numbers: dict) -> dict:
        """The option `inputs` of `simulate`, where there are any."""
        return {} if self.inputs is None else {"inputs": self.inputs(SimpleNamespace(**numbers))}

    def right(self, numbers: dict[str, np.ndarray], ts: np.ndarray) -> Truth:
        """The truth of cases whose numbers are arrays."""
        found = self.truth(
            SimpleNamespace(**{name: np.asarray(value)[:, None] for name, value in numbers.items()}), ts
        )
        return found if isinstance(found, Truth) else Truth(columns(*found))

    def saved(self, ask: Ask, numbers: dict, single: bool = False) -> np.ndarray:
        """Times to save at; what they are after rounding to the engine's floats."""
        even = numbers.get("t0", 0.0) + numbers["span"] * np.arange(1, ask.times + 1) / ask.times
        ts = self.times(SimpleNamespace(**numbers), ask.times) if self.times else even
        return np.asarray(ts, np.float32 if single else float).astype(float)


def together(numbers: list[dict]) -> dict[str, np.ndarray]:
    """Numbers of many cases as arrays."""
    return {name: np.array([one[name] for one in numbers]) for name in numbers[0]}
