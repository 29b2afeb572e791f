"""Uses that are no plain motions: times that do not go together, changed globals, rows that set in later, tiny coefficients, loads of contacts and rods."""

import time
from collections.abc import Callable
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

import jourdain_jax as jj
from hunting.bodies import Robot
from hunting.family import Ask, Family, Truth
from hunting.oscillators import Oscillator
from hunting.pendulums import G, RodPendulum
from hunting.record import BY_CODE, BY_WARNING, RIGHT, WRONG, Record, refusal
from hunting.reference import integrate


@dataclass(frozen=True)
class Single:
    """A family whose cases are asked one by one: `ask(seed)` gives words, error over its bound, result code and what is said against it."""

    name: str
    what: str
    ask: Callable[[int], tuple[str, float, int, str]]
    cases: int = 20
    single: bool = False

    def run(self, seeds: list[int]) -> list[Record]:
        """Records of the cases with these seeds."""
        found = []
        for seed in seeds:
            begin = time.process_time()
            try:
                asked, error, code, said = self.ask(seed)
                outcome = BY_CODE if code not in (0, 1) else RIGHT if error <= 1 else BY_WARNING if said else WRONG
                said = f"code {code}" if outcome == BY_CODE else said
            except Exception as problem:
                asked, error = "", None
                outcome, said = refusal(problem)
            found.append(Record(self.name, seed, "float64", asked, outcome, error, said, time.process_time() - begin))
        return found


# Times. ------------------------------------------------------------------------------------------------------------


def _times(seed: int):
    """Times outside of the span, against it, or before the start: refused, flagged, NaN, or right at every one of them."""
    r = np.random.default_rng([seed, 80])
    t0, way = float(r.choice([0.0, 0.8])), ("simulate", "rollout", "jit", "jit rollout")[seed % 4]
    ts = {0: [-0.5, 0.5, 1.0], 1: [0.5, 1.0], 2: [1.0, 0.5], 3: [0.2, 0.9, 1.6]}[seed // 4 % 4]
    t1 = 1.2 if seed // 16 % 2 else None
    scene, options = Oscillator(), {"t0": t0, "rtol": 1e-8, "atol": 1e-8} | ({} if t1 is None else {"t1": t1})
    start = {"x": r.uniform(0.5, 1.0), "x_rate": 0.0}
    asked = f"{way}, t0={t0}, t1={t1}, ts={ts}, x={start['x']!r}"
    if way == "simulate":
        motion = jj.simulate(scene, start, ts=ts, **options)
    elif way == "jit":
        motion = jax.jit(lambda ts: jj.simulate(scene, start, ts=ts, **options))(jnp.array(ts))
    else:
        many = {name: np.full(2, value) for name, value in start.items()}
        call = lambda ts: jj.rollout(scene, many, ts=ts, **options).lanes  # noqa: E731
        motion = jax.tree.map(lambda x: x[0], jax.jit(call)(jnp.array(ts)) if way == "jit rollout" else call(np.array(ts)))
    x = np.asarray(motion.q[:, 0])
    error = np.nanmax(np.abs(x - start["x"] * np.cos(2 * (np.array(ts) - t0))), initial=0.0)
    return asked, np.inf if np.any(np.isnan(x)) else error / 1e-6, int(motion.result), ""


# What a scene reads besides its numbers. ---------------------------------------------------------------------------

STIFFNESS = 1.0


class ReadsGlobal(Oscillator):
    """Reads a global of its module."""

    def loads(self, motion):
        return (jj.generalized_force(motion, x_rate=-STIFFNESS * motion.q.x),)


class ReadsClass(Oscillator):
    """Reads an attribute of its class."""

    stiffness = 1.0

    def loads(self, motion):
        return (jj.generalized_force(motion, x_rate=-ReadsClass.stiffness * motion.q.x),)


class ReadsBox(Oscillator):
    """Reads what stands in a dictionary of its module."""

    def loads(self, motion):
        return (jj.generalized_force(motion, x_rate=-BOX["k"] * motion.q.x),)


BOX = {"k": 1.0}


def _changed(seed: int):
    """The motion after a change is that of the new value, in the way in which the first was made."""
    global STIFFNESS
    r = np.random.default_rng([seed, 81])
    kind, way = ("global", "class attribute", "dictionary", "replaced method")[seed % 4], ("simulate", "rollout")[seed // 4 % 2]
    k = r.uniform(2.0, 9.0)
    scene = {"global": ReadsGlobal, "class attribute": ReadsClass, "dictionary": ReadsBox, "replaced method": type("Patched", (Oscillator,), {})}[kind]()

    def run():
        if way == "rollout":
            return jax.tree.map(lambda x: x[0], jj.rollout(scene, {"x": np.ones(2), "x_rate": np.zeros(2)}, ts=[1.0]).lanes)
        return jj.simulate(scene, {"x": 1.0, "x_rate": 0.0}, ts=[1.0])

    STIFFNESS = ReadsClass.stiffness = BOX["k"] = 1.0
    run()
    STIFFNESS = ReadsClass.stiffness = BOX["k"] = k
    if kind == "replaced method":
        type(scene).loads = lambda self, motion: (jj.generalized_force(motion, x_rate=-k * motion.q.x),)
    motion = run()
    return (
        f"{way}, {kind}, k={k!r}",
        abs(float(motion.q_end[0]) - np.cos(np.sqrt(k))) / 1e-5,
        int(motion.result),
        "; ".join(jax.tree.map(jnp.asarray, motion).warnings),
    )


# Rows that set in later. -------------------------------------------------------------------------------------------


class LateRow(jj.Scene):
    """Until `late` s the second row says no more than the first; then it holds the speed along y, against a force that sets in with it."""

    coordinates = jj.coordinates("x y")
    late: object = jj.parameter(1.0, unit="s")
    speed: object = jj.parameter(0.3, unit="m/s")

    def bodies(self, t, q):
        return {"block": jj.Particle(1.0, jnp.stack([q.x, q.y, 0.0 * q.x]))}

    def velocity_constraints(self, motion):
        u, more = motion.u, jnp.maximum(motion.t - self.late, 0.0)
        return {"first": u.x_rate - 1.0, "second": u.x_rate - 1.0 + more * (u.y_rate - self.speed)}

    def loads(self, motion):
        return (jj.generalized_force(motion, y_rate=4.0 * jnp.maximum(motion.t - self.late, 0.0)),)


class ElsewhereRow(LateRow):
    """A row that sets in beyond a place instead of a time."""

    def velocity_constraints(self, motion):
        u, more = motion.u, jnp.maximum(motion.q.x - self.late, 0.0)
        return {"first": u.x_rate - 1.0, "second": u.x_rate - 1.0 + more * (u.y_rate - self.speed)}


def _late(name, what, scene):
    def truth(n, ts):
        one = np.ones_like(ts)
        return Truth(np.stack([ts, n["speed"][:, None] * ts, one, n["speed"][:, None] * one], axis=-1))

    return Family(
        name=name, what=what, scene=scene, truth=truth, names=("x", "y", "x_rate", "y_rate"), cases=28, slack=100.0, single=False,
        draw=lambda r: {"late": r.uniform(5.0, 8.0), "speed": r.uniform(-0.5, 0.5), "span": 10.0},
        start=lambda n: {"x": 0.0 * n["speed"], "y": 0.0 * n["speed"], "x_rate": 1.0 + 0.0 * n["speed"], "y_rate": n["speed"]},
        parameters=lambda n: {"late": n["late"], "speed": n["speed"]}, asks=(Ask("simulate"), Ask("jit", 33), Ask("rollout", 9, 1e-6), Ask("jit rollout")),
    )  # fmt: skip


# Tiny and huge coefficients. ---------------------------------------------------------------------------------------


class TinyForce(jj.Scene):
    """A force with a tiny coefficient that grows by e in a tenth of a metre."""

    coordinates = jj.coordinates("x")

    def bodies(self, t, q):
        return {"block": jj.Particle(1.0, jnp.stack([q.x, 0.0 * q.x, 0.0 * q.x]))}

    def loads(self, motion):
        return (jj.generalized_force(motion, x_rate=-1e-24 * jnp.exp(motion.q.x / 0.1)),)


class BesideHugeForce(jj.Scene):
    """A pendulum, and apart from it a block that a huge force pushes."""

    coordinates = jj.coordinates("x y")

    def bodies(self, t, q):
        return {
            "bob": jj.Particle(1.0, jnp.stack([jnp.sin(q.x), 0.0 * q.x, -jnp.cos(q.x)])),
            "block": jj.Particle(1.0, jnp.stack([0.0 * q.y, q.y, 0.0 * q.y])),
        }

    def loads(self, motion):
        weight = -G * motion["bob"].body.mass * jnp.sin(motion.q.x)
        return (jj.generalized_force(motion, x_rate=weight, y_rate=1e16 * jnp.cos(motion.t)),)


def _pushed(push):
    def truth(n, ts):
        rates = lambda _, y: np.stack([y[:, 1], push(y[:, 0])], axis=1)  # noqa: E731
        return Truth(integrate(rates, np.stack([n["x"], n["v"]], axis=1), ts))

    return truth


# Loads. ------------------------------------------------------------------------------------------------------------


def _wheels(seed: int):
    """The normal forces of a robot's wheels add up to its weight."""
    r = np.random.default_rng([seed, 82])
    n = {"mass": r.uniform(1, 5), "ahead": 0.0, "wheel": r.uniform(0.1, 1)}
    motion = jj.simulate(Robot(**n), {"heading": r.uniform(-3, 3), "left_rate": 2.0, "right_rate": r.uniform(-4, 4)}, ts=[0.5, 1.0])
    normal = sum(np.asarray(force.normal) for force in motion.contact_forces().values())
    weight = (n["mass"] + 2 * n["wheel"]) * G
    undetermined = all(not np.any(np.asarray(force.determined)) for force in motion.contact_forces().values())
    return (
        f"contact_forces of a robot, {n}",
        float(np.max(np.abs(normal / weight - 1)) / 1e-8),
        int(motion.result),
        "`determined` is False" if undetermined else "",
    )


def _tension(seed: int):
    """m (v^2 - g z)/l along the rod."""
    r = np.random.default_rng([seed, 83])
    m, v = r.uniform(0.3, 3), r.uniform(1, 9)
    motion = jj.simulate(RodPendulum(mass=m), {"x": 0.0, "z": -1.0, "x_rate": v, "z_rate": 0.0}, ts=np.linspace(0.1, 1.0, 3), rtol=1e-10, atol=1e-10)
    force = np.array([np.asarray(motion.constraint_forces().force[k, 0, 0]) for k in range(3)])
    x, z = np.asarray(motion["x"]), np.asarray(motion["z"])
    pull = m * (np.asarray(motion["x_rate"]) ** 2 + np.asarray(motion["z_rate"]) ** 2 - G * z)
    expected = -pull[:, None] * np.stack([x, 0 * x, z], axis=1)
    asked = f"constraint_forces of a pendulum, m={m!r}, v={v!r}"
    return asked, float(np.max(np.abs(force - expected)) / (1e-6 * np.max(np.abs(pull)))), int(motion.result), "; ".join(motion.warnings)


FEW = (Ask("simulate"), Ask("jit", 33), Ask("rollout", 9, 1e-6), Ask("vmap"))
FAMILIES = (
    Single("times", "times before the start, against the span or beyond it", _times, 32),
    Single("changed", "globals, class attributes, dictionaries and methods that change between calls", _changed, 16),
    Single("wheel-loads", "normal forces of a robot's wheels against its weight", _wheels, 8),
    Single("tension", "constraint forces of a pendulum against its tension", _tension, 8),
    _late("late-row", "a row that sets in after some seconds", LateRow),
    _late("row-elsewhere", "a row that sets in beyond a place", ElsewhereRow),
    Family(
        name="tiny-force", what="a force of 1e-24 exp(x/0.1)", scene=TinyForce, truth=_pushed(lambda x: -1e-24 * np.exp(x / 0.1)), names=("x", "x_rate"),
        draw=lambda r: {"x": r.uniform(5.0, 5.6), "v": r.uniform(-0.3, 0.3), "span": 1.0}, start=lambda n: {"x": n["x"], "x_rate": n["v"]},
        fixed=("span",), cases=20, single=False, asks=FEW,
    ),
    Family(
        name="beside-huge-force", what="a pendulum beside a block that 1e16 N push", scene=BesideHugeForce,
        truth=_pushed(lambda x: -G * np.sin(x)), names=("x", "x_rate"),
        draw=lambda r: {"x": r.uniform(-2.0, 2.0), "v": r.uniform(-3, 3), "span": r.uniform(0.5, 2)}, start=lambda n: {"x": n["x"], "x_rate": n["v"]},
        cases=20, single=False, asks=FEW,
    ),
)  # fmt: skip
