"""Events: several in one step, without a value beyond their boundary, at short excursions, and in stiff
motions.
"""

import jax.numpy as jnp
import numpy as np
from small_scenes import OnLine, OnPlane, Upright

import jourdain_jax as jj
from hunting.family import Ask, Family, G, drawn, either, one_of, power, stopped
from hunting.pendulums import Weighted
from hunting.reference import integrate


class Room(Weighted, Upright):
    """A particle that flies in a room of which floor, ceiling and walls stop it."""

    width: object = jj.parameter(2.0)
    height: object = jj.parameter(3.0)

    def events(self, motion):
        q = motion.q
        return {"floor": q.z, "ceiling": self.height - q.z, "back wall": q.x + 1.0, "wall": self.width - q.x}


def _earliest(candidates, span):
    """Time (cases, 1) and name of the first of the events; the span and "" where none comes."""
    names, times = list(candidates), np.concatenate(list(candidates.values()), axis=1)
    first = np.min(times, axis=1, keepdims=True)
    found = [
        names[k] if t < s else "" for k, (t,), (s,) in zip(np.argmin(times, axis=1), first, span, strict=True)
    ]
    return np.minimum(first, span), found


def _first_root(a, b, c):
    """Smallest positive root of a t^2 + b t + c; infinite where there is none."""
    with np.errstate(all="ignore"):
        root = np.sqrt(b * b - 4 * a * c)
        pair = np.stack([(-b - root) / (2 * a), (-b + root) / (2 * a)]) if a else np.stack([-c / b, -c / b])
    return np.min(np.where(np.isfinite(pair) & (pair > 1e-9), pair, np.inf), axis=0)


def _room_truth(n, ts):
    events = {
        "floor": _first_root(-G / 2, n.z_rate, n.z),
        "ceiling": _first_root(G / 2, -n.z_rate, n.height - n.z),
        "back wall": _first_root(0, n.x_rate, 1.0),
        "wall": _first_root(0, -n.x_rate, n.width),
    }
    return stopped(
        lambda t: (n.x_rate * t, n.z + n.z_rate * t - G / 2 * t**2, n.x_rate, n.z_rate - G * t),
        *_earliest(events, ts[:, -1:]),
        ts,
    )


# Its path passes the ceiling by a little, for a short time; nothing else is near.
GRAZING = drawn(
    z_rate=(3.0, 7.0), height=lambda r, n: 1.0 + n.z_rate**2 / (2 * G) - 10 ** r.uniform(-3.5, -0.5), z=1.0,
    x_rate=(0.1, 0.3), width=3.0, span=lambda r, n: 2.1 * n.z_rate / G,
)  # fmt: skip


class Spring(OnLine):
    """An undamped oscillator that meets a stop."""

    k: object = jj.parameter(4.0, positive=True)
    stop: object = jj.parameter(1.0, positive=True)

    def loads(self, motion):
        return jj.generalized_force(motion, x_rate=-self.k * motion.q.x)

    def left(self, x):
        """The value of the event, which falls through zero."""
        return self.stop - x

    def events(self, motion):
        return {"stop": self.left(motion.q.x)}


class ArcsineStop(Spring):
    """The angle of a crank that a ratio gives, which has none beyond a right angle."""

    def left(self, x):
        return 1.0 - jnp.arcsin(jnp.maximum(x / self.stop, -0.9)) / (jnp.pi / 2)


class RootStop(Spring):
    """A distance as a root."""

    def left(self, x):
        return jnp.sqrt(self.stop - x)


class LogarithmStop(Spring):
    """Falls through zero a little before it ceases to be a number."""

    def left(self, x):
        return jnp.log((self.stop + 1e-6 - x) / 1e-6)


def _stop_truth(n, ts):
    w = np.sqrt(n.k)
    size, phase = np.hypot(n.x, n.x_rate / w), np.arctan2(n.x_rate / w, n.x)  # x = size cos(w t - phase)
    with np.errstate(invalid="ignore"):
        hit = (phase - np.arccos(n.stop / size)) % (2 * np.pi) / w
    events = {"stop": np.where(np.isfinite(hit), hit, np.inf)}
    return stopped(
        lambda t: (size * np.cos(w * t - phase), -size * w * np.sin(w * t - phase)),
        *_earliest(events, ts[:, -1:]),
        ts,
    )


class StiffDrop(OnPlane):
    """x is drawn to sin(y) by a stiff spring and damper while y falls evenly onto the floor."""

    k: object = jj.parameter(1e6, positive=True)

    def loads(self, motion):
        q, u = motion.q, motion.u
        drawn = -self.k * (q.x - jnp.sin(q.y)) - self.k * u.x_rate
        return jj.generalized_force(motion, x_rate=drawn, y_rate=-1.0)

    def events(self, motion):
        return {"floor": motion.q.y}


def _stiff_truth(n, ts):
    """y in closed form; x' = -(x - sin y) + O(1/k): integrated with the next order, x'' = -k (x - sin y) - k
    x', by its slow manifold.

    On the slow manifold p = x' obeys p = s - x - p'/k, s = sin y: two Picard steps leave O(k^-3).
    """

    def rates(t, x):
        h, v = n.y - t**2 / 2, -t
        s, ds, dds = np.sin(h), np.cos(h) * v, -np.sin(h) * v**2 - np.cos(h)
        p0 = s - x
        dp1 = ds - (p0 - (ds - p0) / n.k) - (dds - (ds - p0)) / n.k  # p' of the order before
        return (s - x - dp1 / n.k,)

    t_end, event = _earliest({"floor": np.sqrt(2 * n.y)}, ts[:, -1:])
    every = np.sort(np.concatenate([np.minimum(ts, t_end), t_end], axis=1), axis=1)
    x = integrate(rates, (n.x,), every, width=0.1)[0]
    at = lambda t: np.take_along_axis(
        x, np.argmax(every[:, None, :] == np.minimum(t, t_end)[..., None], axis=2), axis=1
    )
    return stopped(lambda t: (at(t), n.y - t**2 / 2, -t), t_end, event, ts)


ASKS = (
    Ask("simulate"),
    Ask("jit", 9),
    Ask("rollout", 9, 1e-6),
    Ask("vmap", 33),
    Ask("simulate", 33, 1e-6),
    Ask("rollout", 1),
    Ask("jit rollout", 2, 1e-6),
)
RADAU = {"solver": jj.RadauIIA()}
IMPLICIT = (
    Ask("simulate", 1, 1e-6),
    Ask("simulate", 9, 1e-6, RADAU),
    Ask("rollout", 1, 1e-6),
    Ask("jit", 9, 1e-6, RADAU),
)
ROOM = {"scene": Room, "truth": _room_truth, "names": "x z x_rate z_rate", "asks": ASKS}
ROOM_DRAWN = drawn(
    z=(0.5, 2.5), x_rate=either(0.5, 8.0), z_rate=(-4.0, 4.0), width=(0.5, 3.0), height=3.0, span=3.0
)
STOP = {
    "truth": _stop_truth, "names": "x x_rate", "asks": ASKS, "cases": 42,
    "draw": drawn(k=(1, 30), stop=(0.6, 1.2), x=(-0.5, 0.4), x_rate=either(4.0, 8.0), span=4.0),
}  # fmt: skip
NO_NUMBER = STOP | {"slack": 30.0, "single": False}
FAMILIES = (
    Family(
        name="room", what="several events of a flying particle, the earliest ends it", draw=ROOM_DRAWN,
        **ROOM, cases=140,
    ),
    Family(
        name="grazing", what="a ceiling that is passed by a little for a short time", draw=GRAZING,
        **ROOM,
    ),
    Family(name="stop", what="an oscillator that meets a stop", scene=Spring, **STOP),
    Family(
        name="stop-arcsine",
        what="an event value that is no number beyond its boundary, 1 - arcsin(x)/(pi/2)", scene=ArcsineStop,
        **NO_NUMBER,
    ),
    Family(name="stop-root", what="the same, sqrt(1 - x)", scene=RootStop, **NO_NUMBER),
    Family(name="stop-logarithm", what="the same, log(1 - x)", scene=LogarithmStop, **NO_NUMBER),
    Family(
        name="stiff-drop", what="a stiff motion that ends at an event", scene=StiffDrop, truth=_stiff_truth,
        names="x y y_rate",
        draw=drawn(k=power(4.5, 7.0), x=0.0, y=(4.0, 9.0), span=one_of(2.0, 5.0)), asks=IMPLICIT, cases=48,
        fixed=("span", "x", "k"), single=False,
    ),
)  # fmt: skip
