"""Oscillators with exact solutions: stiff ones, pushed by samples with short features, at far times, and in
other units.

x'' + 2 c x' + k x = f(t), f linear between knots: exact from knot to knot by the exponential of a matrix.
"""

from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
from scipy.linalg import expm
from small_scenes import OnLine

import jourdain_jax as jj
from hunting.family import Ask, Family, drawn, one_by_one, one_of, power


class Oscillator(OnLine):
    """Mass, spring, damper, and a push."""

    inputs = jj.inputs("push")
    mass: object = jj.parameter(1.0, positive=True)
    k: object = jj.parameter(4.0)
    c: object = jj.parameter(0.0)

    def loads(self, motion):
        q, u = motion.q, motion.u
        return jj.generalized_force(motion, x_rate=motion.inputs.push - self.k * q.x - self.c * u.x_rate)


def pushed_by(push):
    """The truth of oscillators; `push(numbers of one case)` gives knots and values."""
    return one_by_one(lambda n, ts: _one(n, ts, *map(np.asarray, push(n))))


def _one(n, ts, knots, values):
    """States (times, 2) of one oscillator; the push is constant beyond its knots."""
    n = SimpleNamespace(**{"mass": 1.0, "c": 0.0, "t0": 0.0} | vars(n))
    A = np.array(
        [[0, 1, 0, 0], [-n.k / n.mass, -n.c / n.mass, 1 / n.mass, 0], [0, 0, 0, 1], [0, 0, 0, 0]], float
    )  # x, v, f, f'
    y, t, found = np.array([n.x, n.x_rate]), n.t0, []
    for stop in np.unique(np.concatenate([ts, knots[(knots > n.t0) & (knots < ts[-1])]])):
        f = np.interp([t, stop], knots, values)
        y = (expm(A * (stop - t)) @ np.array([*y, f[0], (f[1] - f[0]) / (stop - t)]))[:2]
        t = stop
        found += [y] if stop in ts else []
    return np.array(found)


def blow(n, space=np):
    """A hammer blow of the given length, up and down in a tenth of it."""
    t, d = n.when, n.length
    return space.stack([t - 0.1 * d, t, t + d, t + 1.1 * d]), n.force * space.asarray([0.0, 1.0, 1.0, 0.0])


def _record(n, space=np):
    """Forty samples of noise, made from one number."""
    k = np.arange(40)
    return n.span * 1.001 * space.asarray(k / 39.0), n.force * space.sin(n.when * (k + 1.0) ** 2)


def _pushed(push, shared):
    inputs = lambda n: {"push": jj.Sampled(*push(n, jnp))}
    how = {"shared": ("span", *shared), "fixed": ("span", "when"), "cases": 72}
    return OSCILLATOR | how | {"truth": pushed_by(push), "inputs": inputs}


BLOWS = drawn(
    span=one_of(2.0, 10.0), length=power(-3.5, -1.0), k=(0.2, 4.0), x=(0, 0.3), x_rate=0.0,
    when=lambda r, n: r.uniform(0.1, 0.8) * n.span, force=lambda r, n: r.uniform(0.5, 3.0) / n.length,
)  # fmt: skip
FAR = drawn(
    k=power(0.0, 6.0), x=(-1, 1), x_rate=lambda r, n: r.uniform(-1, 1) * np.sqrt(n.k),
    t0=one_of(1.7e9, 1e6, -3e4, 1e12), span=lambda r, n: 10 ** r.uniform(1.0, 2.5) / np.sqrt(n.k),
)  # fmt: skip


def _units_drawn(r):
    m, w, size = 10 ** r.uniform(-20, 20), 10 ** r.uniform(-6, 6), 10 ** r.uniform(-12, 12)
    start = {"x": size, "x_rate": 0.3 * size * w}
    tolerance = {"span": r.uniform(1, 10) / w, "atol": 1e-8 * size * min(w, 1.0)}
    return {"mass": m, "k": m * w * w} | start | tolerance


WAYS = (
    Ask("simulate"),
    Ask("jit", 33),
    Ask("vmap"),
    Ask("simulate", 33, 1e-6),
    Ask("rollout", 33, 1e-6),
    Ask("jit rollout"),
)
OSCILLATOR = {"scene": Oscillator, "names": "x x_rate", "asks": WAYS}
FREE = OSCILLATOR | {"truth": pushed_by(lambda n: ([0.0, 1.0], [0.0, 0.0]))}
FAMILIES = (
    Family(
        name="hammer", what="an oscillator that `Sampled` strikes for 0.3 to 100 ms", draw=BLOWS,
        single=False,
        **_pushed(blow, ("when", "length", "force")),
    ),
    Family(
        name="record", what="an oscillator pushed by forty samples of noise", slack=10.0,
        **_pushed(_record, ("when", "force")),
        draw=drawn(k=(0.2, 4.0), c=(0, 1), x=(0, 1), x_rate=0.0, when=(0, 3), force=(1, 20), span=5.0),
    ),
    Family(
        name="far-times", what="an oscillator at t0 from -3e4 to 1e12 s", draw=FAR, cases=72,
        single=False, fixed=("span", "t0", "k"),
        size=lambda n: (np.hypot(n.x, n.x_rate / np.sqrt(n.k)), np.hypot(n.x * np.sqrt(n.k), n.x_rate)),
        **FREE,
    ),
    Family(
        name="far-times-single", what="an oscillator at t0 of 1e3 to 1e5 s, for float32", cases=72,
        fixed=("span", "t0", "k"),
        draw=drawn(k=(1, 100), x=(0, 1), x_rate=(0, 1), t0=one_of(1e3, 1e4, 1e5), span=(1, 10)), **FREE,
    ),
    Family(
        name="stiff", what="overdamped oscillators, rates apart by up to 1e12",
        draw=drawn(
            k=power(3.0, 9.0), c=lambda r, n: 10 ** r.uniform(0.0, 3.0) * np.sqrt(n.k), x=(0.5, 1.0),
            x_rate=0.0, span=(1.0, 10.0),
        ),
        fixed=("span", "k", "c"), cases=48, single=False, **FREE,
    ),
    Family(
        name="units", what="masses of 1e-20 to 1e20 kg, lengths of 1e-12 to 1e12 m, 1e-6 to 1e6 rad/s",
        draw=_units_drawn, single=False, cases=48,
        fixed=("span", "atol"), size=lambda n: (n.x, n.x * np.sqrt(n.k / n.mass)),
        **FREE | {"asks": tuple(ask for ask in WAYS if "rollout" not in ask.way)},
    ),
)  # fmt: skip
