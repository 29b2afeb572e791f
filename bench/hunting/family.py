"""A family of generated motions: numbers are drawn by seed, the truth is computed apart from the engine, and
cases that ask alike share a compiled program.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from types import SimpleNamespace

import numpy as np
from scipy.integrate import solve_ivp

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
    def last(self):
        """Values at the end."""
        return self.values[:, -1] if self.end is None else self.end


def columns(*values):
    """Arrays (cases, times) of names side by side, (cases, times, names)."""
    return np.stack(np.broadcast_arrays(*values), axis=-1)


def stopped(values_at, t_end, event, ts) -> Truth:
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

    def __str__(self):
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


def either(low, high):
    """A number of either sign."""
    return lambda r, n: r.choice([-1.0, 1.0]) * r.uniform(low, high)


def one_of(*values):
    """One of some numbers, or of pairs between which one is drawn."""
    return lambda r, n: r.choice([r.uniform(*x) if isinstance(x, tuple) else x for x in values])


def power(low, high):
    """Ten to a power between these."""
    return lambda r, n: 10 ** r.uniform(low, high)


def drawn(**numbers):
    """Numbers one after another: between the two of a pair, by a function of the generator and of those
    before, or as they are.
    """

    def draw(r):
        n = SimpleNamespace()
        for name, x in numbers.items():
            value = r.uniform(*x) if isinstance(x, tuple) else x(r, n) if callable(x) else x
            setattr(n, name, float(value))
        return vars(n)

    return draw


@dataclass(frozen=True)
class Family:
    """Scenes of one class with drawn numbers; see the fields.

    Numbers that are called as a parameter, coordinate or speed of the scene are its value; others serve
    `start` and `truth`. `span` is the length of a motion, `t0` its start. A function of numbers has them as
    attributes, floats or arrays of cases alike.
    """

    name: str
    what: str  # in words
    scene: Callable
    draw: Callable  # generator -> numbers by name
    truth: Callable  # numbers (cases, 1), ts (cases, times) -> values of `names`, or a `Truth`
    names: str  # coordinates and speeds that are compared
    start: Callable = lambda n: {}  # further start values; coordinates without one are zero
    inputs: Callable | None = None  # numbers -> inputs
    times: Callable | None = None  # numbers of one case, count -> ts; default: even ones
    asks: tuple[Ask, ...] = SOME
    cases: int = 70  # of a full search, in proportion
    shared: tuple[str, ...] = ("span", "t0")  # numbers that the lanes of a rollout have in common
    # numbers that are not varied to see how much a motion amplifies errors
    fixed: tuple[str, ...] = ("span", "t0")
    slack: float = 1.0
    size: Callable | None = None  # numbers -> of what counts as small in each name; default 1
    single: bool = True  # whether it is asked in float32, too

    def numbers(self, seed, single=False):
        """What is asked in the case with this seed, and its numbers."""
        ask = self.asks[seed % len(self.asks)]
        numbers = self.draw(np.random.default_rng([seed, 77]))
        if "rollout" in ask.way:
            common = self.draw(np.random.default_rng([seed % len(self.asks), 78]))
            numbers |= {name: common[name] for name in self.shared if name in common}
        if single:
            numbers = {name: float(np.float32(value)) for name, value in numbers.items()}
        return ask, numbers

    def run(self, seeds):
        """Records of the cases with these seeds."""
        from hunting.judging import search

        return search(self, seeds)

    def parameters(self, numbers):
        """Values of the scene's parameters."""
        fields = self.scene().__dataclass_fields__
        return {name: value for name, value in numbers.items() if name in fields}

    def begin(self, numbers):
        """Values at the start, each as long as the numbers."""
        scene = self.scene()
        coordinates, speeds = scene.coordinate_names.entries, scene.speed_names.entries
        given = dict.fromkeys(coordinates, 0.0)
        given |= {name: numbers[name] for name in (*coordinates, *speeds) if name in numbers}
        given |= self.start(SimpleNamespace(**numbers))
        return {name: value + 0.0 * numbers["span"] for name, value in given.items()}

    def given_inputs(self, numbers):
        """The option `inputs` of `simulate`, where there are any."""
        return {} if self.inputs is None else {"inputs": self.inputs(SimpleNamespace(**numbers))}

    def right(self, numbers, ts) -> Truth:
        """The truth of cases whose numbers are arrays."""
        rows = {name: np.asarray(value)[:, None] for name, value in numbers.items()}
        found = self.truth(SimpleNamespace(**rows), ts)
        return found if isinstance(found, Truth) else Truth(columns(*found))

    def saved(self, ask: Ask, numbers, single=False):
        """Times to save at; what they are after rounding to the engine's floats."""
        even = numbers.get("t0", 0.0) + numbers["span"] * np.arange(1, ask.times + 1) / ask.times
        ts = self.times(SimpleNamespace(**numbers), ask.times) if self.times else even
        return np.asarray(ts, np.float32 if single else float).astype(float)


def one_by_one(follow):
    """The truth of cases that are followed each by itself: `follow(numbers, ts)` gives (times, names)."""

    def truth(n, ts):
        cases = (
            SimpleNamespace(**{name: float(x[i, 0]) for name, x in vars(n).items()}) for i in range(len(ts))
        )
        return Truth(np.stack([follow(*case) for case in zip(cases, ts, strict=True)]))

    return truth


def piece(rates, t, y, end, events=()):
    """A piece of a motion by SciPy, until the value of one of the events passes zero."""
    for event in events:
        event.terminal = True
    return solve_ivp(
        rates,
        (t, end),
        y,
        "DOP853",
        rtol=1e-12,
        atol=1e-13,
        max_step=0.02,
        events=events or None,
        dense_output=True,
    )


def together(numbers):
    """Numbers of many cases as arrays."""
    return {name: np.array([one[name] for one in numbers]) for name in numbers[0]}
