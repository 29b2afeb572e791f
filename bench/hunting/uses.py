"""Uses that are no plain motions: times that do not go together, changed globals, rows that set in later,
tiny coefficients.
"""

import importlib
import time
import tomllib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from small_scenes import OnLine, OnPlane

import jourdain_jax as jj
from hunting.family import Ask, Family, G, drawn
from hunting.oscillators import Oscillator
from hunting.record import BY_CODE, Record, outcome_of, refusal
from hunting.reference import integrate


@dataclass(frozen=True)
class Single:
    """A family whose cases are asked one by one: `ask(seed)` gives words, error over its bound, result code
    and what is said against it.
    """

    name: str
    what: str
    ask: Callable
    cases: int = 20
    single: bool = False

    def run(self, seeds) -> list[Record]:
        """Records of the cases with these seeds."""
        found = []
        for seed in seeds:
            begin, asked, error = time.process_time(), "", None
            try:
                asked, error, code, said = self.ask(seed)
                outcome = outcome_of(code, error, said)
                said = f"code {code}" if outcome == BY_CODE else said
            except Exception as problem:
                outcome, said = refusal(problem)
            spent = time.process_time() - begin
            found.append(Record(self.name, seed, "float64", asked, outcome, error, said, spent))
        return found


def in_way(way, one, lanes, given):
    """The motion by `one` or, of lanes, the last; inside `jit` where the way says so, with what is given
    traced.
    """
    call = (lambda given: jax.tree.map(lambda x: x[-1], lanes(given))) if "rollout" in way else one
    return jax.jit(call)(jax.tree.map(jnp.asarray, given)) if "jit" in way else call(given)


# Times. -----------------------------------------------------------------------------------------------------


def _times(seed):
    """Times outside of the span, against it, or before the start: refused, flagged, NaN, or right at every
    one of them.
    """
    r = np.random.default_rng([seed, 80])
    t0, way = float(r.choice([0.0, 0.8])), ("simulate", "rollout", "jit", "jit rollout")[seed % 4]
    ts = {0: [-0.5, 0.5, 1.0], 1: [0.5, 1.0], 2: [1.0, 0.5], 3: [0.2, 0.9, 1.6]}[seed // 4 % 4]
    t1 = 1.2 if seed // 16 % 2 else None
    scene, options = Oscillator(), {"t0": t0, "rtol": 1e-8, "atol": 1e-8, "t1": t1}
    start = {"x": r.uniform(0.5, 1.0), "x_rate": 0.0}
    asked = f"{way}, t0={t0}, t1={t1}, ts={ts}, x={start['x']!r}"
    many = {name: np.full(2, value) for name, value in start.items()}
    one = lambda ts: jj.simulate(scene, start, ts=ts, **options)
    motion = in_way(way, one, lambda ts: jj.rollout(scene, many, ts=ts, **options).lanes, np.array(ts))
    x = np.asarray(motion.q[:, 0])
    error = np.nanmax(np.abs(x - start["x"] * np.cos(2 * (np.array(ts) - t0))), initial=0.0)
    return asked, np.inf if np.any(np.isnan(x)) else error / 1e-6, int(motion.result), ""


# What a scene reads besides its numbers. --------------------------------------------------------------------

NOTEBOOK = """
class Spring(Oscillator):
    def loads(self, motion):
        return jj.generalized_force(motion, x_rate=-({read}) * motion.q.x)
"""
# what a cell of a notebook says, what the method reads, and what a later cell says
READ = tomllib.loads(Path(__file__).with_suffix(".toml").read_text(encoding="utf-8"))


def _changed(seed):
    """The motion after a change of what a method reads is that of the new value, or what it reads is refused
    where it has state.
    """
    r = np.random.default_rng([seed, 81])
    kind, way = list(READ)[seed % len(READ)], ("simulate", "rollout")[seed // len(READ) % 2]
    k, (first, read, later) = r.uniform(2.0, 9.0), READ[kind]
    cell = {"Oscillator": Oscillator, "jj": jj, "np": np, "jnp": jnp, "__name__": "__main__"}
    modules = ("argparse", "array", "collections", "contextvars", "types")
    cell |= {name: importlib.import_module(name) for name in modules}
    exec(first.format(k=1.0), cell)
    exec(NOTEBOOK.format(read=read), cell)

    def run():
        one = lambda ts: jj.simulate(cell["Spring"](), {"x": 1.0}, ts=ts)
        lanes = lambda ts: jj.rollout(cell["Spring"](), {"x": np.ones(2)}, ts=ts).lanes
        return in_way(way, one, lanes, [1.0])

    motion = run()
    if not later:
        return f"{way}, {kind}", np.inf, int(motion.result), ""
    exec(later.format(k=repr(k)), cell)
    motion = run()
    off = abs(float(motion.q_end[0]) - np.cos(np.sqrt(k)))
    return f"{way}, {kind}, k={k!r}", off / 1e-5, int(motion.result), warnings_of(motion)


def warnings_of(motion):
    """What a motion warns of, in one line."""
    return "; ".join(jax.tree.map(jnp.asarray, motion).warnings)


# Rows that set in later. ------------------------------------------------------------------------------------


class LateRow(OnPlane):
    """Until `late` s the second row says no more than the first; then it holds the speed along y, against a
    force that sets in with it.
    """

    late: object = jj.parameter(1.0)
    speed: object = jj.parameter(0.3)

    def passed(self, motion):
        """How far the row has set in."""
        return jnp.maximum(motion.t - self.late, 0.0)

    def velocity_constraints(self, motion):
        first = motion.u.x_rate - 1.0
        return {"first": first, "second": first + self.passed(motion) * (motion.u.y_rate - self.speed)}

    def loads(self, motion):
        return jj.generalized_force(motion, y_rate=4.0 * jnp.maximum(motion.t - self.late, 0.0))


class ElsewhereRow(LateRow):
    """A row that sets in beyond a place instead of a time."""

    def passed(self, motion):
        return jnp.maximum(motion.q.x - self.late, 0.0)


LATE = {
    "truth": lambda n, ts: (ts, n.speed * ts, 1.0, n.speed), "names": "x y x_rate y_rate", "cases": 28,
    "slack": 100.0, "single": False,
    "draw": drawn(late=(5.0, 8.0), speed=(-0.5, 0.5), span=10.0),
    "start": lambda n: {"x_rate": 1.0, "y_rate": n.speed},
    "asks": (Ask("simulate"), Ask("jit", 33), Ask("rollout", 9, 1e-6), Ask("jit rollout")),
}  # fmt: skip


# Tiny and huge coefficients. --------------------------------------------------------------------------------


class TinyForce(OnLine):
    """A force with a tiny coefficient that grows by e in a tenth of a metre."""

    def loads(self, motion):
        return jj.generalized_force(motion, x_rate=-1e-24 * jnp.exp(motion.q.x / 0.1))


class BesideHugeForce(jj.Scene):
    """A pendulum, and apart from it a block that a huge force pushes."""

    coordinates = jj.coordinates("x y")

    def bodies(self, t, q):
        bob = jj.Particle(1.0, [jnp.sin(q.x), 0.0, -jnp.cos(q.x)])
        return {"bob": bob, "block": jj.Particle(1.0, [0.0, q.y, 0.0])}

    def loads(self, motion):
        weight = -G * motion["bob"].body.mass * jnp.sin(motion.q.x)
        return jj.generalized_force(motion, x_rate=weight, y_rate=1e16 * jnp.cos(motion.t))


def _pushed(push):
    return lambda n, ts: integrate(lambda _, x, v: (v, push(x)), (n.x, n.x_rate), ts)


ASKS = (Ask("simulate"), Ask("jit", 33), Ask("rollout", 9, 1e-6), Ask("vmap"))
ALONE = {"names": "x x_rate", "cases": 20, "single": False, "asks": ASKS}
FAMILIES = (
    Single("times", "times before the start, against the span or beyond it", _times, 32),
    Single(
        "changed",
        "names that methods read: numbers and functions that change between calls, and objects with state",
        _changed, 36,
    ),
    Family(name="late-row", what="a row that sets in after some seconds", scene=LateRow, **LATE),
    Family(name="row-elsewhere", what="a row that sets in beyond a place", scene=ElsewhereRow, **LATE),
    Family(
        name="tiny-force", what="a force of 1e-24 exp(x/0.1)", scene=TinyForce,
        truth=_pushed(lambda x: -1e-24 * np.exp(x / 0.1)), fixed=("span",),
        draw=drawn(x=(5.0, 5.6), x_rate=(-0.3, 0.3), span=1.0), **ALONE,
    ),
    Family(
        name="beside-huge-force", what="a pendulum beside a block that 1e16 N push", scene=BesideHugeForce,
        truth=_pushed(lambda x: -G * np.sin(x)),
        draw=drawn(x=(-2.0, 2.0), x_rate=(-3, 3), span=(0.5, 2)), **ALONE,
    ),
)  # fmt: skip
