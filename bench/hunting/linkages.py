"""Linkages of one freedom, through positions where their rows lose rank, and near them.

Where two branches of configurations cross, the smooth motion stays on its own branch: the momentum with which it arrives is tangent to that branch alone. On
a branch with angles a(s), b(s), c(s) of crank, coupler and rocker, with T = I(s) s'^2/2:  I s'' + I'(s) s'^2/2 + V'(s) = 0.
"""

import jax.numpy as jnp
import numpy as np

import jourdain_jax as jj
from hunting.family import Ask, Family, Truth
from hunting.reference import along, integrate


def _rod(mass, length, position, angle):
    o = 0.0 * angle
    return jj.RigidBody(mass, mass * length**2 / 12 * jnp.array([1e-3, 1.0, 1.0]), jnp.stack([position[0], position[1], o]), jj.rot_z(angle))


def _along(length, angle):
    return length * jnp.stack([jnp.cos(angle), jnp.sin(angle), 0.0 * angle])


class _FourBar(jj.Scene):
    """Crank r1 at the origin, coupler r2, rocker r3 at (d, 0); uniform rods; weight along -y."""

    r1: object = jj.parameter(1.0, unit="m", positive=True)
    r2: object = jj.parameter(2.0, unit="m", positive=True)
    r3: object = jj.parameter(1.0, unit="m", positive=True)
    d: object = jj.parameter(2.0, unit="m", positive=True)
    m1: object = jj.parameter(1.0, unit="kg", positive=True)
    m2: object = jj.parameter(1.0, unit="kg", positive=True)
    m3: object = jj.parameter(1.0, unit="kg", positive=True)
    g: object = jj.parameter(9.81, unit="m/s^2")

    def loads(self, motion):
        return (jj.gravity(motion, self.g, (0.0, -1.0, 0.0)),)


class FourBarInAngles(_FourBar):
    """Three angles, the loop closed by a pin."""

    coordinates = jj.coordinates("a b c")

    def bodies(self, t, q):
        joint, ground = _along(self.r1, q.a), jnp.stack([self.d, 0.0 * q.a, 0.0 * q.a])
        return {
            "crank": _rod(self.m1, self.r1, 0.5 * joint, q.a),
            "coupler": _rod(self.m2, self.r2, joint + _along(0.5 * self.r2, q.b), q.b),
            "rocker": _rod(self.m3, self.r3, ground + _along(0.5 * self.r3, q.c), q.c),
        }

    def geometric_constraints(self, pose):
        ends = [pose[name].place(jnp.stack([0.5 * r, 0.0 * r, 0.0 * r])) for name, r in (("coupler", self.r2), ("rocker", self.r3))]
        return {"loop": jj.pin(*ends, axes="xy")}


class FourBarWithPins(_FourBar):
    """Nine Cartesian coordinates and four pins."""

    coordinates = jj.coordinates("x1 y1 a x2 y2 b x3 y3 c")

    def bodies(self, t, q):
        return {
            "crank": _rod(self.m1, self.r1, (q.x1, q.y1), q.a),
            "coupler": _rod(self.m2, self.r2, (q.x2, q.y2), q.b),
            "rocker": _rod(self.m3, self.r3, (q.x3, q.y3), q.c),
        }

    def geometric_constraints(self, pose):
        half = {name: 0.5 * jnp.asarray(r) for name, r in (("crank", self.r1), ("coupler", self.r2), ("rocker", self.r3))}
        first, last = ({k: pose[k].place(jnp.stack([s * h, 0.0 * h, 0.0 * h])) for k, h in half.items()} for s in (-1.0, 1.0))
        ground = jnp.stack([jnp.asarray(self.d), 0.0 * pose.t, 0.0 * pose.t])
        return {
            "base": jj.pin(first["crank"], jnp.zeros(3), axes="xy"),
            "elbow": jj.pin(last["crank"], first["coupler"], axes="xy"),
            "wrist": jj.pin(last["coupler"], last["rocker"], axes="xy"),
            "ground": jj.pin(first["rocker"], ground, axes="xy"),
        }


# Angles and their slopes along a branch, as analytic functions of s. ------------------------------------------------


def parallelogram(n, s):
    return (s, 0.0 * s, s), (1.0 + 0.0 * s, 0.0 * s, 1.0 + 0.0 * s)


def antiparallelogram(n, s):
    r, d = n["r1"], n["d"]
    b = -2 * np.arctan(r * np.sin(s) / (d - r * np.cos(s)))
    db = 2 * (r * r - r * d * np.cos(s)) / (r * r + d * d - 2 * r * d * np.cos(s))
    return (s, b, b - s), (1.0 + 0.0 * s, db, db - 1.0)


def kite(n, s):
    """Crank as long as the ground, rocker as the coupler."""
    k = n["d"] / n["r3"]
    phi = np.arcsin(k * np.sin(s / 2))
    slope = 0.5 * k * np.cos(s / 2) / np.sqrt(1 - (k * np.sin(s / 2)) ** 2)
    return (s, s / 2 - phi, s / 2 + phi), (1.0 + 0.0 * s, 0.5 - slope, 0.5 + slope)


def folded_kite(n, s):
    """The crank rests on the ground, coupler and rocker turn as one."""
    return (0.0 * s, s, s), (0.0 * s, 1.0 + 0.0 * s, 1.0 + 0.0 * s)


def _twice_kinetic(n, q, dq):
    (a, b, _), (da, db, dc) = q, dq
    r1, r2, r3 = n["r1"], n["r2"], n["r3"]
    coupler = (r1 * da) ** 2 + (r2 * db) ** 2 / 3 + r1 * r2 * da * db * np.cos(a - b)
    return n["m1"] * (r1 * da) ** 2 / 3 + n["m2"] * coupler + n["m3"] * (r3 * dc) ** 2 / 3


def _potential(n, q):
    a, b, c = q
    r1, r2, r3 = n["r1"], n["r2"], n["r3"]
    return n["g"] * (n["m1"] * r1 / 2 * np.sin(a) + n["m2"] * (r1 * np.sin(a) + r2 / 2 * np.sin(b)) + n["m3"] * r3 / 2 * np.sin(c))


def on_branch(branch):
    """The truth of motions on a branch."""

    def truth(n, ts):
        one = np.ones_like(n["s"])

        def rates(_, y):
            s, w = y.T
            inertia = lambda s: _twice_kinetic(n, *branch(n, s))  # noqa: E731
            push = along(inertia, (s,), (one,)) * w**2 / 2 + along(lambda s: _potential(n, branch(n, s)[0]), (s,), (one,))
            return np.stack([w, -push / inertia(s)], axis=1)

        y = integrate(rates, np.stack([n["s"], n["s_rate"]], axis=1), ts, width=0.02)
        cases = {name: value[:, None] for name, value in n.items()}
        q, dq = branch(cases, y[..., 0])
        return Truth(np.stack([*q, *(slope * y[..., 1] for slope in dq)], axis=-1))

    return truth


def starting(branch, pins: bool):
    """Start values of a branch."""

    def start(n):
        m = {name: jnp.asarray(value) for name, value in n.items()}
        (a, b, c), slopes = _jax_branch(branch, m)
        rates = [slope * m["s_rate"] for slope in slopes]
        found = {"a": a, "b": b, "c": c, "a_rate": rates[0], "b_rate": rates[1], "c_rate": rates[2]}
        if not pins:
            return found
        o = 0.0 * a
        joints = {"1": (o, o, o, o, m["r1"], a, rates[0]), "3": (m["d"] + o, o, o, o, m["r3"], c, rates[2])}
        r1, da = m["r1"], rates[0]
        joints["2"] = (r1 * jnp.cos(a), r1 * jnp.sin(a), -r1 * jnp.sin(a) * da, r1 * jnp.cos(a) * da, m["r2"], b, rates[1])
        for k, (x, y, vx, vy, r, angle, rate) in joints.items():
            found |= {f"x{k}": x + r / 2 * jnp.cos(angle), f"y{k}": y + r / 2 * jnp.sin(angle)}
            found |= {f"x{k}_rate": vx - r / 2 * jnp.sin(angle) * rate, f"y{k}_rate": vy + r / 2 * jnp.cos(angle) * rate}
        return found

    return start


def _jax_branch(branch, m):
    """The formulas of a branch on JAX's numbers."""
    import types

    space = types.FunctionType(branch.__code__, {**branch.__globals__, "np": jnp})
    return space(m, m["s"])


def _drawn(kind: str):
    def draw(r):
        short, long = (r.uniform(0.5, 1.5), r.uniform(1.3, 2.5)) if r.uniform() < 0.5 else (float(r.choice([0.5, 1.0])), float(r.choice([1.5, 2.0, 3.0])))
        lengths = {"parallel": (short, short * long, short, short * long), "kite": (short, short * long, short * long, short)}[kind]
        turn = float(r.choice([-1.0, 1.0]))
        return {
            **dict(zip(("r1", "r2", "r3", "d"), lengths, strict=True)),
            **{f"m{k}": r.uniform(0.3, 3.0) for k in (1, 2, 3)},
            "g": float(r.choice([0.0, 9.81])),
            "s": r.uniform(0.3, np.pi - 0.3) * turn,
            "s_rate": turn * r.uniform(2.0, 12.0) * r.choice([-1.0, 1.0, 1.0]),
            "span": r.uniform(0.5, 2.5),
        }

    return draw


def _parameters(n):
    return {name: n[name] for name in ("r1", "r2", "r3", "d", "m1", "m2", "m3", "g")}


ASKS = (Ask("simulate"), Ask("jit", 33), Ask("rollout", 33, 1e-6), Ask("vmap"), Ask("simulate", 33, 1e-6), Ask("rollout"), Ask("jit rollout", 1, 1e-6))
FEW = ASKS[:4]  # nine coordinates take long to build


def _linkage(name, what, branch, kind, pins=False, cases=70):
    return Family(
        name=name,
        what=what,
        scene=FourBarWithPins if pins else FourBarInAngles,
        draw=_drawn(kind),
        start=starting(branch, pins),
        truth=on_branch(branch),
        names=("a", "b", "c", "a_rate", "b_rate", "c_rate"),
        parameters=_parameters,
        asks=FEW if pins else ASKS,
        cases=cases,
        slack=10.0,
        fixed=("span", "r1", "r2", "r3", "d"),
        single=not pins,
    )


FAMILIES = (
    _linkage("parallelogram", "parallelogram linkage laid flat, in angles", parallelogram, "parallel", cases=140),
    _linkage("parallelogram-pins", "parallelogram linkage laid flat, nine coordinates with pins", parallelogram, "parallel", pins=True, cases=105),
    _linkage("antiparallelogram", "antiparallelogram linkage laid flat, in angles", antiparallelogram, "parallel"),
    _linkage("antiparallelogram-pins", "antiparallelogram linkage laid flat, with pins", antiparallelogram, "parallel", pins=True),
    _linkage("kite", "kite linkage through its fold, in angles", kite, "kite"),
    _linkage("folded-kite", "kite linkage folded onto its ground", folded_kite, "kite"),
    _linkage("folded-kite-pins", "the same with pins", folded_kite, "kite", pins=True, cases=35),
)
