"""Events: several in one step, without a value beyond their boundary, at short excursions, and in stiff motions."""

import jax.numpy as jnp
import numpy as np

import jourdain_jax as jj
from hunting.family import Ask, Family, Truth

G = 9.81


class Room(jj.Scene):
    """A particle that flies in a room of which floor, ceiling and walls stop it."""

    coordinates = jj.coordinates("x z")
    g: object = jj.parameter(G, unit="m/s^2")
    width: object = jj.parameter(2.0, unit="m")
    height: object = jj.parameter(3.0, unit="m")

    def bodies(self, t, q):
        return {"ball": jj.Particle(1.0, jnp.stack([q.x, 0.0 * q.x, q.z]))}

    def loads(self, motion):
        return (jj.gravity(motion, self.g),)

    def events(self, motion):
        q = motion.q
        return {"floor": q.z, "ceiling": self.height - q.z, "back wall": q.x + 1.0, "wall": self.width - q.x}


def _earliest(candidates: dict[str, np.ndarray], span) -> tuple[np.ndarray, list[str]]:
    """Times and names of the first of the events; the span and "" where none comes."""
    names, times = list(candidates), np.stack(list(candidates.values()))
    first = np.argmin(times, axis=0)
    found = times[first, np.arange(len(span))]
    return np.minimum(found, span), [names[k] if t < s else "" for k, t, s in zip(first, found, span, strict=True)]


def _first_root(a, b, c):
    """Smallest positive root of a t^2 + b t + c; infinite where there is none."""
    with np.errstate(all="ignore"):
        root = np.sqrt(b * b - 4 * a * c)
        pair = np.stack([(-b - root) / (2 * a), (-b + root) / (2 * a)]) if np.all(a != 0) else np.stack([-c / b, -c / b])
    return np.min(np.where(np.isfinite(pair) & (pair > 1e-9), pair, np.inf), axis=0)


def _stopped(values_at, t_end, event, ts) -> Truth:
    """Values at the saved times up to the end, NaN after it."""
    reached = ts <= t_end[:, None] * (1 + 1e-12)
    return Truth(np.where(reached[..., None], values_at(ts), np.nan), t_end, values_at(t_end[:, None])[:, 0], event)


def _room_truth(n, ts):
    half = np.full_like(n["z"], G / 2)
    t_end, event = _earliest(
        {
            "floor": _first_root(-half, n["vz"], n["z"]),
            "ceiling": _first_root(half, -n["vz"], n["height"] - n["z"]),
            "back wall": _first_root(0 * half, n["vx"], 1.0 + 0 * half),
            "wall": _first_root(0 * half, -n["vx"], n["width"]),
        },
        ts[:, -1],
    )

    def values_at(t):
        x, z = n["vx"][:, None] * t, n["z"][:, None] + n["vz"][:, None] * t - G / 2 * t**2
        return np.stack([x, z, n["vx"][:, None] + 0 * t, n["vz"][:, None] - G * t], axis=-1)

    return _stopped(values_at, t_end, event, ts)


def _room_drawn(r):
    return {
        "z": r.uniform(0.5, 2.5),
        "vx": r.choice([-1.0, 1.0]) * r.uniform(0.5, 8.0),
        "vz": r.uniform(-4.0, 4.0),
        "width": r.uniform(0.5, 3.0),
        "height": 3.0,
        "span": 3.0,
    }


def _grazing_drawn(r):
    """Its path passes the ceiling by a little, for a short time; nothing else is near."""
    vz, over = r.uniform(3.0, 7.0), 10 ** r.uniform(-3.5, -0.5)
    return {"z": 1.0, "vx": r.uniform(0.1, 0.3), "vz": vz, "width": 3.0, "height": 1.0 + vz**2 / (2 * G) - over, "span": 1.1 * vz / G + vz / G}


class Spring(jj.Scene):
    """An undamped oscillator with a stop whose value is no number beyond its boundary."""

    coordinates = jj.coordinates("x")
    k: object = jj.parameter(4.0, unit="N/m", positive=True)
    stop: object = jj.parameter(1.0, unit="m", positive=True)

    def bodies(self, t, q):
        return {"ball": jj.Particle(1.0, jnp.stack([q.x, 0.0 * q.x, 0.0 * q.x]))}

    def loads(self, motion):
        return (jj.generalized_force(motion, x_rate=-self.k * motion.q.x),)

    def events(self, motion):
        return {"stop": self.stop - motion.q.x}


class ArcsineStop(Spring):
    """The angle of a crank that a ratio gives, which has none beyond a right angle."""

    def events(self, motion):
        return {"stop": 1.0 - jnp.arcsin(jnp.maximum(motion.q.x / self.stop, -0.9)) / (jnp.pi / 2)}


class RootStop(Spring):
    """A distance as a root."""

    def events(self, motion):
        return {"stop": jnp.sqrt(self.stop - motion.q.x)}


class LogarithmStop(Spring):
    """Falls through zero a little before it ceases to be a number."""

    def events(self, motion):
        return {"stop": jnp.log((self.stop + 1e-6 - motion.q.x) / 1e-6)}


def _stop_truth(n, ts):
    w, x0, v0 = np.sqrt(n["k"]), n["x"], n["v"]
    size, phase = np.hypot(x0, v0 / w), np.arctan2(v0 / w, x0)  # x = size cos(w t - phase)
    with np.errstate(invalid="ignore"):
        hit = (phase - np.arccos(n["stop"] / size)) % (2 * np.pi) / w
    t_end, event = _earliest({"stop": np.where(np.isfinite(hit), hit, np.inf)}, ts[:, -1])

    def values_at(t):
        turn = w[:, None] * t - phase[:, None]
        return np.stack([size[:, None] * np.cos(turn), -(size * w)[:, None] * np.sin(turn)], axis=-1)

    return _stopped(values_at, t_end, event, ts)


def _stop(name, what, scene, slack=1.0, **more):
    drawn = lambda r: {"k": r.uniform(1, 30), "stop": r.uniform(0.6, 1.2), "x": r.uniform(-0.5, 0.4), "v": r.choice([-1, 1]) * r.uniform(4.0, 8.0), "span": 4.0}  # noqa: E731
    return Family(
        name=name, what=what, scene=scene, draw=drawn, truth=_stop_truth, start=lambda n: {"x": n["x"], "x_rate": n["v"]},
        names=("x", "x_rate"), parameters=lambda n: {"k": n["k"], "stop": n["stop"]}, asks=ASKS, cases=42, slack=slack, **more,
    )  # fmt: skip


class StiffDrop(jj.Scene):
    """x is drawn to sin(y) by a stiff spring and damper while y falls evenly onto the floor; where `late`, by a stiffness of its own."""

    coordinates = jj.coordinates("x y")
    k: object = jj.parameter(1e6, unit="N/m", positive=True)

    def bodies(self, t, q):
        return {"block": jj.Particle(1.0, jnp.stack([q.x, q.y, 0.0 * q.x]))}

    def loads(self, motion):
        q, u = motion.q, motion.u
        return (jj.generalized_force(motion, x_rate=-self.k * (q.x - jnp.sin(q.y)) - self.k * u.x_rate, y_rate=-1.0 + 0.0 * q.y),)

    def events(self, motion):
        return {"floor": motion.q.y}


def _stiff_truth(n, ts):
    """y in closed form; x' = -(x - sin y) + O(1/k): integrated with the next order, x'' = -k (x - sin y) - k x', by its slow manifold.

    On the slow manifold p = x' obeys p = s - x - p'/k, s = sin y: two Picard steps leave O(k^-3).
    """
    from hunting.reference import integrate

    fall = lambda t: (n["y"] - t**2 / 2, -t)  # noqa: E731

    def rates(t, y):
        h, v = fall(t)
        s, ds, dds = np.sin(h), np.cos(h) * v, -np.sin(h) * v**2 - np.cos(h)
        x, e = y[:, 0], 1 / n["k"]
        p0 = s - x
        p1 = s - x - e * (ds - p0)  # p' of the order before
        dp1 = ds - p1 - e * (dds - (ds - p0))
        return (s - x - e * dp1)[:, None]

    t_end = np.minimum(np.sqrt(2 * n["y"]), ts[:, -1])
    event = ["floor" if t < s else "" for t, s in zip(t_end, ts[:, -1], strict=True)]
    every = np.sort(np.concatenate([np.minimum(ts, t_end[:, None]), t_end[:, None]], axis=1), axis=1)
    x = integrate(rates, n["x"][:, None], every, width=0.1)[..., 0]
    clipped = np.minimum(ts, t_end[:, None])
    index = np.argmax(every[:, None, :] == clipped[..., None], axis=2)
    at = np.take_along_axis(x, index, axis=1)
    h, v = n["y"][:, None] - clipped**2 / 2, -clipped
    values = np.where((ts <= t_end[:, None])[..., None], np.stack([at, h, v], axis=-1), np.nan)
    end = np.stack([x[:, -1], n["y"] - t_end**2 / 2, -t_end], axis=-1)
    return Truth(values, t_end, end, event)


ASKS = (Ask("simulate"), Ask("jit", 9), Ask("rollout", 9, 1e-6), Ask("vmap", 33), Ask("simulate", 33, 1e-6), Ask("rollout", 1), Ask("jit rollout", 2, 1e-6))
IMPLICIT = (
    Ask("simulate", 1, 1e-6),
    Ask("simulate", 9, 1e-6, {"solver": jj.RadauIIA()}),
    Ask("rollout", 1, 1e-6),
    Ask("jit", 9, 1e-6, {"solver": jj.RadauIIA()}),
)
ROOM = {
    "scene": Room, "truth": _room_truth, "names": ("x", "z", "x_rate", "z_rate"), "asks": ASKS,
    "start": lambda n: {"x": 0.0 * n["z"], "z": n["z"], "x_rate": n["vx"], "z_rate": n["vz"]},
    "parameters": lambda n: {"width": n["width"], "height": n["height"]},
}  # fmt: skip
FAMILIES = (
    Family(name="room", what="several events of a flying particle, the earliest ends it", draw=_room_drawn, **ROOM, cases=140),
    Family(name="grazing", what="a ceiling that is passed by a little for a short time", draw=_grazing_drawn, **ROOM),
    _stop("stop", "an oscillator that meets a stop", Spring),
    _stop("stop-arcsine", "an event value that is no number beyond its boundary, 1 - arcsin(x)/(pi/2)", ArcsineStop, slack=30.0, single=False),
    _stop("stop-root", "the same, sqrt(1 - x)", RootStop, slack=30.0, single=False),
    _stop("stop-logarithm", "the same, log(1 - x)", LogarithmStop, slack=30.0, single=False),
    Family(
        name="stiff-drop", what="a stiff motion that ends at an event", scene=StiffDrop, truth=_stiff_truth, names=("x", "y", "y_rate"),
        draw=lambda r: {"k": 10 ** r.uniform(4.5, 7.0), "x": 0.0, "y": r.uniform(4.0, 9.0), "span": r.choice([2.0, 5.0])},
        start=lambda n: {"x": n["x"], "y": n["y"]}, parameters=lambda n: {"k": n["k"]}, asks=IMPLICIT, cases=48, fixed=("span", "x", "k"), single=False,
    ),
)  # fmt: skip
