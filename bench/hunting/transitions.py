"""Events after which motions go on, with modes and jumps, against SciPy's steps from one event to the
next.
"""

import diffrax
import jax.numpy as jnp
import numpy as np
from small_scenes import OnPlane

import jourdain_jax as jj
from hunting.family import Ask, Family, drawn, either, one_by_one, one_of, piece

MOST = 40


class Switched(OnPlane):
    """A mass on springs that stiffen; in the second mode on others, and pulled by another weight along x."""

    stiff: object = jj.parameter(4.0)
    soft: object = jj.parameter(1.0)
    cube: object = jj.parameter(0.5)
    a: object = jj.parameter(1.0)
    b: object = jj.parameter(1.0)
    limit: object = jj.parameter(0.5)
    kept: object = jj.parameter(0.5)
    moved: object = jj.parameter(0.1)
    modes = jj.modes(spring=("stiff", "soft"))

    def loads(self, motion):
        q, mode = motion.q, motion.modes.spring
        k = self.stiff + (self.soft - self.stiff) * mode
        x, y = (-k * q.x - self.cube * q.x**3 + jnp.cos(2 * motion.t), -3 * q.y + mode * q.x)
        return (
            jj.generalized_force(motion, x_rate=x, y_rate=y),
            jj.gravity(motion, mode, jnp.array([1.0, 0.0, 0.0])),
        )

    def events(self, motion):
        q, u = motion.q, motion.u
        over, under, side = _values(self, motion.t, q.x, q.y, u.x_rate, u.y_rate)
        turned = {"x_rate": -self.kept * u.x_rate, "y": q.y + self.moved * u.y_rate}
        return {
            "over": jj.Event(over, to={"spring": "soft"}, jump=turned),
            "side": jj.Event(side, jump={"y_rate": -self.kept * u.y_rate}),
            "under": jj.Event(jnp.where(motion.modes.spring == 1, under, 1.0), to={"spring": "stiff"}),
        }


def _values(n, t, x, y, x_rate, y_rate):
    return n.limit - n.a * x - n.b * y, x + 0.3 * x_rate + n.limit, n.limit + 0.4 - y + 0.05 * t


def _followed(n, ts):
    """States of one case at times; NaN after too many events."""
    t, way, mode, off, found = n.t0, np.sign(n.span), 0, np.zeros(3, bool), []
    y = np.array([n.x, n.y, n.x_rate, n.y_rate])

    def rates(t, y):
        k = n.soft if mode else n.stiff
        return np.array(
            [y[2], y[3], np.cos(2 * t) - k * y[0] - n.cube * y[0] ** 3 + mode, mode * y[0] - 3 * y[1]]
        )

    def values(t, y):
        over, under, side = _values(n, t, *y)
        return np.array([over, side, under if mode else 1.0])

    def falls(j):
        fall = lambda t, y: values(t, y)[j] - 2e-10 * off[j]
        fall.direction = 1 if off[j] else -1
        return fall

    for _ in range(3 * MOST):
        c = values(t, y)
        rises = (values(t + 1e-7 * way, y + 1e-7 * way * rates(t, y)) > c) & (abs(c) < 1e-10)
        off &= ~(rises | (c > 1e-10))
        sunk = np.flatnonzero(~off & ~rises & (c < 1e-11))
        if len(sunk):
            off[sunk[0]] = True
            if sunk[0] == 0:
                y, mode = np.array([y[0], y[1] + n.moved * y[3], -n.kept * y[2], y[3]]), 1
            elif sunk[0] == 1:
                y = y * [1, 1, 1, -n.kept]
            else:
                mode = 0
            continue
        run = piece(rates, t, y, ts[-1], [*map(falls, range(3))])
        t, y = run.t[-1], run.y[:, -1]
        found += [run.sol(at) for at in ts[len(found) :] if way * at <= way * t]
        if len(found) == len(ts):
            return np.array(found)
    return np.full((len(ts), 4), np.nan)


WAYS = ("simulate", "jit", "vmap", "rollout")
HOW = (
    {"backend": "native"}, {"backend": "xla"}, {"solver": jj.Taylor()}, {"solver": jj.RadauIIA()},
    {"solver": diffrax.Tsit5()}, {"backend": "dense"},
    {"formulation": jj.Formulation("full")},
)  # fmt: skip
FAMILIES = (
    Family(
        name="transitions", what="motions that go on after events, with modes and jumps", scene=Switched,
        truth=one_by_one(_followed), names="x y x_rate y_rate",
        draw=drawn(
            stiff=(3, 12), soft=(0.5, 3), cube=(0, 1), a=either(0.3, 1), b=(-0.5, 0.5),
            limit=one_of(0.3, (-0.1, 0.8)), kept=(0.3, 1), moved=(-0.1, 0.1),
            x=(-0.5, 0.5), y=(-0.5, 0.5), x_rate=either(0.5, 3), y_rate=(-2, 2), t0=one_of(0.0, 0.7),
            span=one_of(3.0, (1, 5), (-3, -1)),
        ),
        asks=tuple(
            Ask(
                WAYS[i % 4], (1, 2, 33)[i % 3], (1e-6, 1e-9)[i // 7 % 2],
                HOW[i % 7] | {"max_transitions": MOST},
            )
            for i in range(28)
        ),
        cases=56, slack=0.1,
    ),
)  # fmt: skip
