"""Slider-cranks, whose rows lose rank where rod and crank are of one length, and four-bar linkages that do not, or hardly."""

import jax.numpy as jnp
import numpy as np

import jourdain_jax as jj
from hunting.family import Family, Truth
from hunting.linkages import ASKS, FEW, FourBarInAngles, FourBarWithPins, _along, _rod, starting
from hunting.reference import integrate


class SliderCrank(jj.Scene):
    """A crank r, a rod l, and a slider on the x axis; weight along -y."""

    r: object = jj.parameter(1.0, unit="m", positive=True)
    l: object = jj.parameter(1.0, unit="m", positive=True)
    m1: object = jj.parameter(1.0, unit="kg", positive=True)
    m2: object = jj.parameter(1.0, unit="kg", positive=True)
    m3: object = jj.parameter(1.0, unit="kg", positive=True)
    g: object = jj.parameter(9.81, unit="m/s^2")
    coordinates = jj.coordinates("a b x")

    def bodies(self, t, q):
        joint = _along(self.r, q.a)
        return {
            "crank": _rod(self.m1, self.r, 0.5 * joint, q.a),
            "rod": _rod(self.m2, self.l, joint + _along(0.5 * self.l, q.b), q.b),
            "slider": jj.Particle(self.m3, jnp.stack([q.x, 0.0 * q.x, 0.0 * q.x])),
        }

    def geometric_constraints(self, pose):
        end = pose["rod"].place(jnp.stack([0.5 * self.l, 0.0 * self.l, 0.0 * self.l]))
        return {"slide": jj.pin(end, pose["slider"].position, axes="xy")}

    def loads(self, motion):
        return (jj.gravity(motion, self.g, (0.0, -1.0, 0.0)),)


def _angles(n, s, still, space=np):
    """b, x and their slopes; `still`: the slider stays at the origin and the rod turns with the crank."""
    if still:
        return (s + np.pi, 0.0 * s), (1.0 + 0.0 * s, 0.0 * s)
    r, l = n["r"], n["l"]
    if n["equal"]:
        return (-s, 2 * r * space.cos(s)), (-1.0 + 0.0 * s, -2 * r * space.sin(s))
    b = -space.arcsin(r / l * space.sin(s))
    slope = -r * space.cos(s) / (l * space.cos(b))
    return (b, r * space.cos(s) + l * space.cos(b)), (slope, -r * space.sin(s) - l * space.sin(b) * slope)


def _push(n, s, w, still):
    """-(I' w^2/2 + V')/I, with I' by central differences of order 8 of analytic functions: round-off 1e-13."""

    def inertia(s):
        (b, _), (db, dx) = _angles(n, s, still)
        coupler = n["r"] ** 2 + (n["l"] * db) ** 2 / 3 + n["r"] * n["l"] * db * np.cos(s - b)
        return n["m1"] * n["r"] ** 2 / 3 + n["m2"] * coupler + n["m3"] * dx**2

    def potential(s):
        (b, _), _ = _angles(n, s, still)
        return n["g"] * (n["m1"] * n["r"] / 2 * np.sin(s) + n["m2"] * (n["r"] * np.sin(s) + n["l"] / 2 * np.sin(b)))

    step = lambda f: np.imag(f(s + 1e-30j)) / 1e-30  # noqa: E731
    return -(step(inertia) * w**2 / 2 + step(potential)) / inertia(s)


def _slider(name, what, equal, still=False):
    def draw(r):
        length, turn = float(r.choice([0.5, 1.0, r.uniform(0.4, 1.6)])), float(r.choice([-1.0, 1.0]))
        ratio = 1.0 if equal else 1.0 + 10 ** r.uniform(-3.0, 0.3)
        drawn = {"r": length, "l": length * ratio, **{f"m{k}": r.uniform(0.3, 3.0) for k in (1, 2, 3)}}
        drawn |= {"g": float(r.choice([0.0, 9.81])), "s": turn * r.uniform(0.0, 1.3), "s_rate": turn * r.uniform(2.0, 12.0), "span": r.uniform(0.5, 2.0)}
        return drawn

    def truth(n, ts):
        n = n | {"equal": equal}

        def rates(_, y):
            return np.stack([y[:, 1], _push(n, y[:, 0], y[:, 1], still)], axis=1)

        y = integrate(rates, np.stack([n["s"], n["s_rate"]], axis=1), ts, width=0.02)
        cases = {name: value if name == "equal" else value[:, None] for name, value in n.items()}
        (b, x), (db, dx) = _angles(cases, y[..., 0], still)
        w = y[..., 1]
        return Truth(np.stack([y[..., 0], b, x, w, db * w, dx * w], axis=-1))

    def start(n):
        (b, x), (db, dx) = _angles({**n, "equal": equal}, jnp.asarray(n["s"]), still, jnp)
        w = n["s_rate"]
        return {"a": n["s"], "b": b, "x": x, "a_rate": w, "b_rate": db * w, "x_rate": dx * w}

    return Family(
        name=name,
        what=what,
        scene=SliderCrank,
        draw=draw,
        start=start,
        truth=truth,
        names=("a", "b", "x", "a_rate", "b_rate", "x_rate"),
        parameters=lambda n: {k: n[k] for k in ("r", "l", "m1", "m2", "m3", "g")},
        asks=ASKS,
        slack=10.0,
        fixed=("span", "r", "l"),
    )


def _ratios(n, a, b, c):
    """b' and c' over a': n r1 a' e^{ia} + r2 b' e^{ib} = r3 c' e^{ic}."""
    return n["r1"] * np.sin(c - a) / (n["r2"] * np.sin(b - c)), n["r1"] * np.sin(a - b) / (n["r3"] * np.sin(c - b))


def _closed(n, a, space=np):
    """Coupler and rocker angles of the assembly with the rocker ahead."""
    x, y = n["r1"] * space.cos(a) - n["d"], n["r1"] * space.sin(a)
    apart = space.hypot(x, y)
    c = space.arctan2(y, x) - space.arccos((n["r3"] ** 2 + apart**2 - n["r2"] ** 2) / (2 * n["r3"] * apart))
    return space.arctan2(n["r3"] * space.sin(c) - y, n["r3"] * space.cos(c) - x), c


def _four_bar_truth(n, ts):
    """Crank angle, its rate, and the other angles carried along."""
    b0, c0 = _closed(n, n["s"])

    def energy_terms(a, b, c):
        db, dc = _ratios(n, a, b, c)
        inertia = n["m1"] * n["r1"] ** 2 / 3 + n["m3"] * (n["r3"] * dc) ** 2 / 3
        inertia = inertia + n["m2"] * (n["r1"] ** 2 + (n["r2"] * db) ** 2 / 3 + n["r1"] * n["r2"] * db * np.cos(a - b))
        height = n["m1"] * n["r1"] / 2 * np.sin(a) + n["m2"] * (n["r1"] * np.sin(a) + n["r2"] / 2 * np.sin(b)) + n["m3"] * n["r3"] / 2 * np.sin(c)
        return inertia, n["g"] * height

    def rates(_, y):
        a, b, c, w = y.T
        db, dc = _ratios(n, a, b, c)
        step = [np.imag(v) / 1e-30 for v in energy_terms(a + 1e-30j, b + 1e-30j * db, c + 1e-30j * dc)]
        return np.stack([w, db * w, dc * w, -(step[0] * w**2 / 2 + step[1]) / energy_terms(a, b, c)[0]], axis=1)

    y = integrate(rates, np.stack([n["s"], b0, c0, n["s_rate"]], axis=1), ts, width=0.02)
    a, b, c, w = np.moveaxis(y, -1, 0)
    db, dc = _ratios({name: value[:, None] for name, value in n.items()}, a, b, c)
    return Truth(np.stack([a, b, c, w, db * w, dc * w], axis=-1))


def _four_bar_branch(n, s):
    b, c = _closed(n, s, np)
    db, dc = n["r1"] * np.sin(c - s) / (n["r2"] * np.sin(b - c)), n["r1"] * np.sin(s - b) / (n["r3"] * np.sin(c - b))
    return (s, b, c), (1.0 + 0.0 * s, db, dc)


def _crank_rocker(r):
    """Grashof: the crank turns fully; how nearly the linkage lays flat is drawn from 1e-4 on."""
    short, margin = r.uniform(0.3, 0.8), 10 ** r.uniform(-3.0, -0.5)
    middle = short * r.uniform(1.3, 2.5), short * r.uniform(1.3, 2.5)
    long = max(sum(middle) - short - margin, *middle)  # short + long < sum of the others, by the margin
    order = r.permutation(3)
    drawn = {"r1": short} | {name: (*middle, long)[k] for name, k in zip(("r2", "r3", "d"), order, strict=True)}
    drawn |= {f"m{k}": r.uniform(0.3, 3.0) for k in (1, 2, 3)}
    drawn |= {
        "g": float(r.choice([0.0, 9.81])),
        "s": r.uniform(-3.0, 3.0),
        "s_rate": float(r.choice([-1.0, 1.0])) * r.uniform(4.0, 12.0),
        "span": r.uniform(0.3, 1.2),
    }
    return drawn


def _four_bar(name, what, pins):
    from hunting.linkages import _parameters

    def start(n):
        return starting(_four_bar_branch, pins)(n)

    return Family(
        name=name,
        what=what,
        scene=FourBarWithPins if pins else FourBarInAngles,
        draw=_crank_rocker,
        start=start,
        truth=_four_bar_truth,
        names=("a", "b", "c", "a_rate", "b_rate", "c_rate"),
        parameters=_parameters,
        asks=FEW if pins else ASKS,
        slack=10.0,
        single=not pins,
    )


FAMILIES = (
    _slider("slider-crank-equal", "slider-crank with r = l through right angles", True),
    _slider("slider-crank-still", "slider-crank with r = l, the slider at rest", True, still=True),
    _slider("slider-crank", "slider-crank with l/r - 1 from 1e-3 on", False),
    _four_bar("four-bar", "crank-rocker linkages, down to 1e-3 m from laying flat, in angles", False),
    _four_bar("four-bar-pins", "the same with pins", True),
)
