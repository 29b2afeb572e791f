"""Derivatives through simulations, against complex steps through references: exact to round-off.

A derivative that is NaN while the motion claims success is wrong; `SensitivityWarning` and errors of the engine's own are flags.
"""

import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

import jourdain_jax as jj
from hunting.bodies import sleigh_states
from hunting.family import Family
from hunting.pendulums import ROD, G
from hunting.record import BY_CODE, BY_WARNING, RIGHT, WRONG, Record, refusal
from hunting.reference import integrate

MODES = ("reverse", "forward", "reverse of a batch")
STEP = 1e-20


@dataclass(frozen=True)
class Slopes:
    """A family of derivatives of the weighted end of a motion by every number but those that are `fixed`."""

    name: str
    what: str
    family: Family
    end: Callable  # numbers (complex arrays by case) -> (cases, names), the end of the motion
    rtol: float = 1e-9
    slack: float = 1e4  # error of a derivative over rtol
    cases: int = 30
    single: bool = False

    def run(self, seeds: list[int]) -> list[Record]:
        """Records of the cases with these seeds."""
        found: list[Record] = []
        for k, mode in enumerate(MODES):
            own = [seed for seed in seeds if seed % len(MODES) == k]
            if own:
                found += self._asked(mode, own)
        return sorted(found, key=lambda record: record.seed)

    def _asked(self, mode: str, seeds: list[int]) -> list[Record]:
        begin, f = time.process_time(), self.family
        numbers = [f.draw(np.random.default_rng([seed, 79])) for seed in seeds]
        names = [name for name in numbers[0] if name not in f.fixed]
        weights = np.cos(np.arange(len(f.names)))
        expected = np.array([[self._slope(one, name, weights) for name in names] for one in numbers])

        def value(x, span):
            own = dict(zip(names, x, strict=True)) | {"span": span}
            motion = jj.simulate(f.scene().replace(**f.parameters(own)), f.start(own), t1=span, ts=span[None], rtol=self.rtol, atol=self.rtol)
            ends = [motion.q_end[i] if kind == "q" else motion.u_end[i] for kind, i in _columns(f)]
            end = jnp.stack(ends) @ weights
            return end, (end, motion.result)

        slope = jax.jit((jax.jacfwd if mode == "forward" else jax.grad)(value, has_aux=True))
        many = jax.jit(jax.grad(lambda x, span: (lambda v: (jnp.sum(v[0]), v[1]))(jax.vmap(value)(x, span)), has_aux=True))
        exact = np.array([float(np.real(self.end({key: np.array([complex(v)]) for key, v in one.items()})[0] @ weights)) for one in numbers])
        x = jnp.array([[one[name] for name in names] for one in numbers])
        spans = jnp.array([one["span"] for one in numbers])
        records = []
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            try:
                both = many(x, spans) if mode == MODES[2] else jax.tree.map(lambda *one: jnp.stack(one), *(slope(a, s) for a, s in zip(x, spans, strict=True)))
                failed = None
            except Exception as error:
                failed = refusal(error)
        told = "; ".join(str(w.message) for w in said if issubclass(w.category, jj.SensitivityWarning))
        seconds = (time.process_time() - begin) / len(seeds)
        for i, seed in enumerate(seeds):
            asked = f"gradient, {mode}, rtol={self.rtol:g}; " + ", ".join(f"{name}={float(value)!r}" for name, value in numbers[i].items())
            if failed:
                records.append(Record(self.name, seed, "float64", asked, failed[0], None, failed[1], seconds))
                continue
            got, end, code = np.asarray(both[0][i]), float(both[1][0][i]), int(both[1][1][i])
            size = np.max(np.abs(expected[i])) + 1.0
            tolerance = max(self.rtol, abs(end - exact[i]) / (1.0 + abs(exact[i])))  # a derivative need not be better than its motion
            error = float(np.max(np.abs(got - expected[i])) / (self.slack * tolerance * size))
            text = f"slopes {got} for {expected[i]}"
            outcome = BY_CODE if code not in (0, 1) else RIGHT if error <= 1 else BY_WARNING if told else WRONG
            words = {BY_CODE: f"code {code}", RIGHT: "", BY_WARNING: told[:160], WRONG: text}[outcome]
            records.append(Record(self.name, seed, "float64", asked, outcome, error, words, seconds))
        return records

    def _slope(self, numbers: dict, name: str, weights) -> float:
        shifted = {key: np.array([value + (1j * STEP if key == name else 0.0)]) for key, value in numbers.items()}
        return float(np.imag(self.end(shifted)[0] @ weights) / STEP)


def _columns(f: Family):
    from hunting.judging import _columns

    return _columns(f.scene(), f.names)


def _rod_end(n):
    rates = lambda t, y: np.stack([y[:, 1], -G / n["l"] * np.sin(y[:, 0])], axis=1)  # noqa: E731
    angle, rate = integrate(rates, np.stack([0.0 * n["v"], n["v"] / n["l"]], axis=1), np.real(n["span"])[:, None])[:, -1].T
    s, c, l = np.sin(angle), np.cos(angle), n["l"]
    return np.stack([l * s, -l * c, l * c * rate, l * s * rate], axis=1)


def _flight_end(n):
    """Where and when a ball in a room meets the floor or the wall, whichever comes first."""
    fall = (n["vz"] + np.sqrt(n["vz"] ** 2 + 2 * G * n["z"])) / G
    reach = n["width"] / n["vx"]
    t = np.where(np.real(fall) < np.real(reach), fall, reach)
    return np.stack([n["vx"] * t, n["z"] + n["vz"] * t - G / 2 * t**2, n["vx"] + 0 * t, n["vz"] - G * t], axis=1)


def families() -> tuple[Slopes, ...]:
    """All families of derivatives."""
    from dataclasses import replace

    from hunting.bodies import FAMILIES as BODIES
    from hunting.events import ROOM
    from hunting.linkages import FAMILIES as LINKAGES

    rod = Family(name="rod", what="", draw=lambda r: {"l": 1.0, "m": 1.0, "v": r.uniform(2, 9), "span": r.uniform(0.3, 2)}, fixed=("span", "m"), **ROD)
    rod = replace(rod, parameters=lambda n: {"length": n["l"]})
    flight = {"z": (0.5, 2.5), "vx": (0.5, 8.0), "vz": (-4.0, 4.0), "width": (0.5, 3.0)}
    room = Family(
        name="room", what="", draw=lambda r: {k: r.uniform(*v) for k, v in flight.items()} | {"span": 3.0}, fixed=("span",),
        **ROOM | {"parameters": lambda n: {"width": n["width"], "height": 100.0}},
    )  # fmt: skip
    sleigh = next(f for f in BODIES if f.name == "sleigh")
    flat = next(f for f in LINKAGES if f.name == "parallelogram")
    bar = replace(flat, draw=lambda r: flat.draw(r) | {"g": 9.81}, fixed=("span", "r1", "r2", "r3", "d", "m1", "m2", "m3", "g"), parameters=lambda n: FIXED)
    bar = replace(
        bar, draw=lambda r: {"s": r.uniform(0.5, 2.0), "s_rate": r.uniform(3.0, 6.0), "span": r.uniform(0.3, 1.0)}, start=lambda n: flat.start({**FIXED, **n})
    )
    return (
        Slopes("gradient-rod", "gradients of the pendulum with a rod and a narrow domain", rod, _rod_end),
        Slopes("gradient-sleigh", "gradients of Chaplygin's sleigh", sleigh, lambda n: sleigh_states(n, np.real(n["span"])[:, None])[:, -1]),
        Slopes("gradient-room", "gradients of where a ball in a room is stopped", room, _flight_end),
        Slopes("gradient-parallelogram", "gradients of a parallelogram laid flat", bar, _bar_end, cases=15, slack=1e5),
    )


FIXED = {"r1": 1.0, "r2": 2.0, "r3": 1.0, "d": 2.0, "m1": 1.0, "m2": 1.0, "m3": 1.0, "g": 9.81}


def _bar_end(n):
    """One angle: (m1/3 + m2 + m3/3) r^2 a'' = -g r (m1/2 + m2 + m3/2) cos(a)."""
    rates = lambda _, y: np.stack([y[:, 1], -G * 2.0 / (5.0 / 3.0) * np.cos(y[:, 0])], axis=1)  # noqa: E731
    a, w = integrate(rates, np.stack([n["s"], n["s_rate"]], axis=1), np.real(n["span"])[:, None])[:, -1].T
    return np.stack([a, 0 * a, a, w, 0 * a, w], axis=1)
