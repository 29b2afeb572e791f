"""Oscillators with exact solutions: stiff ones, pushed by samples with short features, at far times, and in other units.

x'' + 2 c x' + k x = f(t), f linear between knots: exact from knot to knot by the exponential of a matrix.
"""

import jax.numpy as jnp
import numpy as np
from scipy.linalg import expm

import jourdain_jax as jj
from hunting.family import Ask, Family, Truth


class Oscillator(jj.Scene):
    """Mass, spring, damper, and a push."""

    coordinates = jj.coordinates("x")
    inputs = jj.inputs("push")
    mass: object = jj.parameter(1.0, unit="kg", positive=True)
    k: object = jj.parameter(4.0, unit="N/m")
    c: object = jj.parameter(0.0, unit="N s/m")

    def bodies(self, t, q):
        return {"block": jj.Particle(self.mass, jnp.stack([q.x, 0.0 * q.x, 0.0 * q.x]))}

    def loads(self, motion):
        q, u = motion.q, motion.u
        return (jj.generalized_force(motion, x_rate=motion.inputs.push - self.k * q.x - self.c * u.x_rate),)


def _one(m, k, c, x, v, t0, ts, knots, values) -> np.ndarray:
    """States at ts of one oscillator; the push is constant beyond its knots."""
    A = np.array([[0, 1, 0, 0], [-k / m, -c / m, 1 / m, 0], [0, 0, 0, 1], [0, 0, 0, 0]], float)  # x, v, f, f'
    y, t, found = np.array([x, v]), t0, []
    for stop in np.unique(np.concatenate([ts, knots[(knots > t0) & (knots < ts[-1])]])):
        f = np.interp([t, stop], knots, values)
        y = (expm(A * (stop - t)) @ np.array([*y, f[0], (f[1] - f[0]) / (stop - t)]))[:2]
        t = stop
        found += [y] if stop in ts else []
    return np.array(found)


def truth_with(pushed):
    """The truth of oscillators; `pushed(numbers of one case)` gives knots and values of the push."""

    def truth(n, ts):
        found = []
        for i in range(len(ts)):
            one = {name: value[i] for name, value in n.items()}
            t0, (knots, values) = one.get("t0", 0.0), pushed(one)
            found.append(_one(one.get("m", 1.0), one["k"], one.get("c", 0.0), one["x"], one["v"], t0, ts[i], np.asarray(knots), np.asarray(values)))
        return Truth(np.array(found))

    return truth


def _blow(n, space=np):
    """A hammer blow of the given length, up and down in a tenth of it."""
    t, d = n["when"], n["length"]
    return space.stack([t - 0.1 * d, t, t + d, t + 1.1 * d]), n["force"] * space.asarray([0.0, 1.0, 1.0, 0.0])


def _record(n, space=np):
    """Forty samples of noise, made from one number."""
    k = np.arange(40)
    return n["span"] * 1.001 * space.asarray(k / 39.0), n["force"] * space.sin(n["when"] * (k + 1.0) ** 2)


def _no_push(n, space=np):
    return np.array([0.0, 1.0]), np.zeros(2)


def _sampled(pushed):
    return lambda n: {"push": jj.Sampled(*pushed(n, jnp))}


BASE = {
    "scene": Oscillator, "names": ("x", "x_rate"), "start": lambda n: {"x": n["x"], "x_rate": n["v"]},
    "parameters": lambda n: {name: n[key] for name, key in (("mass", "m"), ("k", "k"), ("c", "c")) if key in n},
}  # fmt: skip


def _blow_drawn(r):
    span, length = float(r.choice([2.0, 10.0])), 10 ** r.uniform(-3.5, -1.0)
    return {
        "k": r.uniform(0.2, 4.0),
        "x": r.uniform(0, 0.3),
        "v": 0.0,
        "when": r.uniform(0.1, 0.8) * span,
        "length": length,
        "force": r.uniform(0.5, 3.0) / length,
        "span": span,
    }


def _record_drawn(r):
    return {"k": r.uniform(0.2, 4.0), "c": r.uniform(0, 1), "x": r.uniform(0, 1), "v": 0.0, "when": r.uniform(0, 3), "force": r.uniform(1, 20), "span": 5.0}


def _far_drawn(r):
    k = 10 ** r.uniform(0.0, 6.0)
    return {
        "k": k,
        "x": r.uniform(-1, 1),
        "v": r.uniform(-1, 1) * np.sqrt(k),
        "t0": float(r.choice([1.7e9, 1e6, -3e4, 1e12])),
        "span": 10 ** r.uniform(1.0, 2.5) / np.sqrt(k),
    }


def _stiff_drawn(r):
    k, c = 10 ** r.uniform(3.0, 9.0), 10 ** r.uniform(0.0, 3.0)
    return {"k": k, "c": c * np.sqrt(k), "x": r.uniform(0.5, 1.0), "v": 0.0, "span": r.uniform(1.0, 10.0)}


def _units_drawn(r):
    m, w, size = 10 ** r.uniform(-20, 20), 10 ** r.uniform(-6, 6), 10 ** r.uniform(-12, 12)
    return {"m": m, "k": m * w * w, "x": size, "v": 0.3 * size * w, "span": r.uniform(1, 10) / w, "atol": 1e-8 * size * min(w, 1.0)}


WAYS = (Ask("simulate"), Ask("jit", 33), Ask("vmap"), Ask("simulate", 33, 1e-6), Ask("rollout", 33, 1e-6), Ask("jit rollout"))
FAMILIES = (
    Family(
        name="hammer", what="an oscillator that `Sampled` strikes for 0.3 to 100 ms", draw=_blow_drawn, truth=truth_with(_blow), inputs=_sampled(_blow),
        asks=WAYS, shared=("span", "when", "length", "force"), fixed=("span", "when"), cases=72, single=False, **BASE,
    ),
    Family(
        name="record", what="an oscillator pushed by forty samples of noise", draw=_record_drawn, truth=truth_with(_record), inputs=_sampled(_record),
        asks=WAYS, shared=("span", "when", "force"), fixed=("span", "when"), cases=72, slack=10.0, **BASE,
    ),
    Family(
        name="far-times", what="an oscillator at t0 from -3e4 to 1e12 s", draw=_far_drawn, truth=truth_with(_no_push), cases=72,
        single=False, fixed=("span", "t0", "k"),
        size=lambda n: np.stack([np.hypot(n["x"], n["v"] / np.sqrt(n["k"])), np.hypot(n["x"] * np.sqrt(n["k"]), n["v"])], axis=1), asks=WAYS, **BASE,
    ),
    Family(
        name="far-times-single", what="an oscillator at t0 of 1e3 to 1e5 s, for float32", truth=truth_with(_no_push), asks=WAYS, cases=72,
        fixed=("span", "t0", "k"),
        draw=lambda r: {"k": r.uniform(1, 100), "x": r.uniform(0, 1), "v": r.uniform(0, 1), "t0": float(r.choice([1e3, 1e4, 1e5])), "span": r.uniform(1, 10)},
        **BASE,
    ),
    Family(
        name="stiff", what="overdamped oscillators, rates apart by up to 1e12", draw=_stiff_drawn, truth=truth_with(_no_push), asks=WAYS,
        fixed=("span", "k", "c"), cases=48, single=False, **BASE,
    ),
    Family(
        name="units", what="masses of 1e-20 to 1e20 kg, lengths of 1e-12 to 1e12 m, 1e-6 to 1e6 rad/s", draw=_units_drawn, truth=truth_with(_no_push),
        single=False,
        asks=tuple(a for a in WAYS if "rollout" not in a.way), fixed=("span", "atol"), cases=48,
        size=lambda n: np.stack([n["x"], n["x"] * np.sqrt(n["k"] / n["m"])], axis=1), **BASE,
    ),
)  # fmt: skip
