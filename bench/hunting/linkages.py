"""Linkages of one freedom, through positions where their rows lose rank, and near them.

Where two branches of configurations cross, the smooth motion stays on its own branch: the momentum with which
it arrives is tangent to that branch alone. On a branch with coordinates q(s), with T = I(s) s'^2/2: I s'' +
I'(s) s'^2/2 + V'(s) = 0.
"""

import jax.numpy as jnp
import numpy as np

import jourdain_jax as jj
from hunting.family import FEW, SOME, Family, drawn, one_of
from hunting.reference import along, integrate


def rod(mass, length, position, angle):
    """A uniform rod in the plane of x and y."""
    moments = mass * length**2 / 12 * jnp.array([1e-3, 1.0, 1.0])
    return jj.RigidBody(mass, moments, [*position[:2], 0.0], jj.rot_z(angle))


def ahead(length, angle):
    """A vector of this length."""
    return length * jnp.stack([jnp.cos(angle), jnp.sin(angle), 0.0])


def on_axis(x):
    """A point on the x axis."""
    return jnp.stack([x, 0.0, 0.0])


class InPlane(jj.Scene):
    """Three bodies under weight along -y."""

    m1: object = jj.parameter(1.0, positive=True)
    m2: object = jj.parameter(1.0, positive=True)
    m3: object = jj.parameter(1.0, positive=True)
    g: object = jj.parameter(9.81)

    def loads(self, motion):
        return jj.gravity(motion, self.g, (0.0, -1.0, 0.0))


class FourBarInAngles(InPlane):
    """Crank r1 at the origin, coupler r2, rocker r3 at (d, 0), uniform rods: three angles, the loop closed by
    a pin.
    """

    r1: object = jj.parameter(1.0, positive=True)
    r2: object = jj.parameter(2.0, positive=True)
    r3: object = jj.parameter(1.0, positive=True)
    d: object = jj.parameter(2.0, positive=True)
    coordinates = jj.coordinates("a b c")

    def bodies(self, t, q):
        joint = ahead(self.r1, q.a)
        return {
            "crank": rod(self.m1, self.r1, 0.5 * joint, q.a),
            "coupler": rod(self.m2, self.r2, joint + ahead(0.5 * self.r2, q.b), q.b),
            "rocker": rod(self.m3, self.r3, on_axis(self.d) + ahead(0.5 * self.r3, q.c), q.c),
        }

    def geometric_constraints(self, pose):
        coupler = pose["coupler"].place(on_axis(0.5 * self.r2))
        return {"loop": jj.pin(coupler, pose["rocker"].place(on_axis(0.5 * self.r3)), axes="xy")}


class FourBarWithPins(FourBarInAngles):
    """Nine Cartesian coordinates and four pins."""

    coordinates = jj.coordinates("x1 y1 a x2 y2 b x3 y3 c")

    def bodies(self, t, q):
        return {
            "crank": rod(self.m1, self.r1, (q.x1, q.y1), q.a),
            "coupler": rod(self.m2, self.r2, (q.x2, q.y2), q.b),
            "rocker": rod(self.m3, self.r3, (q.x3, q.y3), q.c),
        }

    def geometric_constraints(self, pose):
        lengths = {"crank": self.r1, "coupler": self.r2, "rocker": self.r3}
        first, last = ({k: pose[k].place(on_axis(s * r)) for k, r in lengths.items()} for s in (-0.5, 0.5))
        return {
            "base": jj.pin(first["crank"], jnp.zeros(3), axes="xy"),
            "elbow": jj.pin(last["crank"], first["coupler"], axes="xy"),
            "wrist": jj.pin(last["coupler"], last["rocker"], axes="xy"),
            "ground": jj.pin(first["rocker"], on_axis(self.d), axes="xy"),
        }


# Coordinates and their slopes along a branch, as analytic functions of s; `space`: whose functions. ---------


def parallelogram(n, s, space=np):
    return (s, 0.0 * s, s), (1.0, 0.0, 1.0)


def antiparallelogram(n, s, space=np):
    r, d, c = n.r1, n.d, space.cos(s)
    b = -2 * space.arctan(r * space.sin(s) / (d - r * c))
    db = 2 * (r * r - r * d * c) / (r * r + d * d - 2 * r * d * c)
    return (s, b, b - s), (1.0, db, db - 1.0)


def kite(n, s, space=np):
    """Crank as long as the ground, rocker as the coupler."""
    sine = n.d / n.r3 * space.sin(s / 2)
    phi, slope = space.arcsin(sine), 0.5 * n.d / n.r3 * space.cos(s / 2) / space.sqrt(1 - sine**2)
    return (s, s / 2 - phi, s / 2 + phi), (1.0, 0.5 - slope, 0.5 + slope)


def folded_kite(n, s, space=np):
    """The crank rests on the ground, coupler and rocker turn as one."""
    return (0.0 * s, s, s), (0.0, 1.0, 1.0)


def coupled(n, q, dq):
    """Twice the kinetic energy over the mass of a rod r2 that hangs on the end of another, r1."""
    (a, b, _), (da, db, _) = q, dq
    return (n.r1 * da) ** 2 + (n.r2 * db) ** 2 / 3 + n.r1 * n.r2 * da * db * np.cos(a - b)


def twice_kinetic(n, q, dq):
    """Of a four-bar linkage."""
    return n.m1 * (n.r1 * dq[0]) ** 2 / 3 + n.m2 * coupled(n, q, dq) + n.m3 * (n.r3 * dq[2]) ** 2 / 3


def potential(n, q):
    """Of a four-bar linkage."""
    a, b, c = map(np.sin, q)
    return n.g * (n.m1 * n.r1 / 2 * a + n.m2 * (n.r1 * a + n.r2 / 2 * b) + n.m3 * n.r3 / 2 * c)


def on_branch(branch, twice_kinetic=twice_kinetic, potential=potential):
    """The truth of motions on a branch."""

    def truth(n, ts):
        def rates(_, s, w):
            inertia = lambda s: twice_kinetic(n, *branch(n, s))
            push = along(inertia, (s,), (1.0,)) * w**2 / 2 + along(
                lambda s: potential(n, branch(n, s)[0]), (s,), (1.0,)
            )
            return w, -push / inertia(s)

        s, w = integrate(rates, (n.s, n.s_rate), ts, width=0.02)
        q, dq = branch(n, s)
        return *q, *(slope * w for slope in dq)

    return truth


def starting(branch, names="abc", pins=False):
    """Start values of a branch."""

    def start(n):
        q, dq = branch(n, jnp.asarray(n.s), jnp)
        rates = [slope * n.s_rate for slope in dq]
        found = dict(zip((*names, *(f"{name}_rate" for name in names)), (*q, *rates), strict=True))
        if not pins:
            return found
        c, s = n.r1 * jnp.cos(q[0]), n.r1 * jnp.sin(q[0])
        joints = (
            (0.0, 0.0, 0.0, 0.0, n.r1),
            (c, s, -s * rates[0], c * rates[0], n.r2),
            (n.d, 0.0, 0.0, 0.0, n.r3),
        )
        for k, ((x, y, vx, vy, r), angle, rate) in enumerate(zip(joints, q, rates, strict=True), start=1):
            c, s = r / 2 * jnp.cos(angle), r / 2 * jnp.sin(angle)
            found |= {f"x{k}": x + c, f"y{k}": y + s}
            found |= {f"x{k}_rate": vx - s * rate, f"y{k}_rate": vy + c * rate}
        return found

    return start


MASSES = {f"m{k}": (0.3, 3.0) for k in (1, 2, 3)} | {"g": one_of(0.0, 9.81)}


def lengths_drawn(kite):
    """Lengths, masses and a start of a parallelogram or a kite."""

    def draw(r):
        if r.uniform() < 0.5:
            short, long = r.uniform(0.5, 1.5), r.uniform(1.3, 2.5)
        else:
            short, long = float(r.choice([0.5, 1.0])), float(r.choice([1.5, 2.0, 3.0]))
        long *= short
        lengths = (short, long, long, short) if kite else (short, long, short, long)
        turn = float(r.choice([-1.0, 1.0]))
        found = dict(zip(("r1", "r2", "r3", "d"), lengths, strict=True)) | drawn(
            **MASSES, s=(0.3, np.pi - 0.3), s_rate=(2.0, 12.0)
        )(r)
        found |= {"s": turn * found["s"], "s_rate": turn * found["s_rate"] * r.choice([-1.0, 1.0, 1.0])}
        return found | {"span": r.uniform(0.5, 2.5)}

    return draw


FOUR_BAR = {"names": "a b c a_rate b_rate c_rate", "slack": 10.0}
PINS = {"scene": FourBarWithPins, "asks": FEW, "single": False}  # nine coordinates take long to build
ANGLES = {"scene": FourBarInAngles, "asks": SOME}


def _linkage(name, what, branch, cases=70):
    pins = name.endswith("pins")
    how = {"draw": lengths_drawn("kite" in name), "start": starting(branch, pins=pins), "cases": cases}
    how |= {"truth": on_branch(branch), "fixed": ("span", "r1", "r2", "r3", "d")}
    return Family(name=name, what=what, **FOUR_BAR | (PINS if pins else ANGLES) | how)


FLAT = "parallelogram linkage laid flat"
FAMILIES = (
    _linkage("parallelogram", f"{FLAT}, in angles", parallelogram, 140),
    _linkage("parallelogram-pins", f"{FLAT}, nine coordinates with pins", parallelogram, 105),
    _linkage("antiparallelogram", f"anti{FLAT}, in angles", antiparallelogram),
    _linkage("antiparallelogram-pins", f"anti{FLAT}, with pins", antiparallelogram),
    _linkage("kite", "kite linkage through its fold, in angles", kite),
    _linkage("folded-kite", "kite linkage folded onto its ground", folded_kite),
    _linkage("folded-kite-pins", "the same with pins", folded_kite, 35),
)
