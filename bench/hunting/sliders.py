"""Slider-cranks, whose rows lose rank where rod and crank are of one length, and four-bar linkages that do
not, or hardly.
"""

import numpy as np

import jourdain_jax as jj
from hunting.family import Family, drawn, either
from hunting.linkages import (
    ANGLES,
    FOUR_BAR,
    MASSES,
    PINS,
    InPlane,
    ahead,
    coupled,
    on_axis,
    on_branch,
    potential,
    rod,
    starting,
    twice_kinetic,
)
from hunting.reference import along, integrate


class SliderCrank(InPlane):
    """A crank r1, a rod r2, and a slider on the x axis."""

    r1: object = jj.parameter(1.0, positive=True)
    r2: object = jj.parameter(1.0, positive=True)
    coordinates = jj.coordinates("a b x")

    def bodies(self, t, q):
        joint = ahead(self.r1, q.a)
        return {
            "crank": rod(self.m1, self.r1, 0.5 * joint, q.a),
            "rod": rod(self.m2, self.r2, joint + ahead(0.5 * self.r2, q.b), q.b),
            "slider": jj.Particle(self.m3, on_axis(q.x)),
        }

    def geometric_constraints(self, pose):
        return {
            "slide": jj.pin(pose["rod"].place(on_axis(0.5 * self.r2)), pose["slider"].position, axes="xy")
        }


def _still(n, s, space=np):
    """The slider stays at the origin and the rod turns with the crank."""
    return (s, s + np.pi, 0.0 * s), (1.0, 1.0, 0.0)


def _equal(n, s, space=np):
    return (s, -s, 2 * n.r1 * space.cos(s)), (1.0, -1.0, -2 * n.r1 * space.sin(s))


def _longer(n, s, space=np):
    r, l = n.r1, n.r2
    b = -space.arcsin(r / l * space.sin(s))
    slope = -r * space.cos(s) / (l * space.cos(b))
    return (s, b, r * space.cos(s) + l * space.cos(b)), (
        1.0,
        slope,
        -r * space.sin(s) - l * space.sin(b) * slope,
    )


def _slider_kinetic(n, q, dq):
    return n.m1 * (n.r1 * dq[0]) ** 2 / 3 + n.m2 * coupled(n, q, dq) + n.m3 * dq[2] ** 2


def _slider_potential(n, q):
    a, b = np.sin(q[0]), np.sin(q[1])
    return n.g * (n.m1 * n.r1 / 2 * a + n.m2 * (n.r1 * a + n.r2 / 2 * b))


def _slider(name, what, branch):
    def draw(r):
        length, turn = float(r.choice([0.5, 1.0, r.uniform(0.4, 1.6)])), float(r.choice([-1.0, 1.0]))
        found = {
            "r1": length,
            "r2": length * (1.0 + 10 ** r.uniform(-3.0, 0.3) if branch is _longer else 1.0),
        }
        found |= drawn(**MASSES, s=(0.0, 1.3), s_rate=(2.0, 12.0), span=(0.5, 2.0))(r)
        return found | {"s": turn * found["s"], "s_rate": turn * found["s_rate"]}

    truth, start = on_branch(branch, _slider_kinetic, _slider_potential), starting(branch, "abx")
    return Family(
        name,
        what,
        SliderCrank,
        draw,
        truth,
        "a b x a_rate b_rate x_rate",
        start,
        slack=10.0,
        fixed=("span", "r1", "r2"),
    )


def _slopes(n, a, b, c, sin=np.sin):
    """a', b' and c' over a': r1 a' e^{ia} + r2 b' e^{ib} = r3 c' e^{ic}."""
    return 1.0, n.r1 * sin(c - a) / (n.r2 * sin(b - c)), n.r1 * sin(a - b) / (n.r3 * sin(c - b))


def _closed(n, a, space=np):
    """Coupler and rocker angles of the assembly with the rocker ahead, and the slopes."""
    x, y = n.r1 * space.cos(a) - n.d, n.r1 * space.sin(a)
    apart = space.hypot(x, y)
    c = space.arctan2(y, x) - space.arccos((n.r3**2 + apart**2 - n.r2**2) / (2 * n.r3 * apart))
    b = space.arctan2(n.r3 * space.sin(c) - y, n.r3 * space.cos(c) - x)
    return (a, b, c), _slopes(n, a, b, c, space.sin)


def _four_bar_truth(n, ts):
    """Crank angle, its rate, and the other angles carried along."""

    def rates(_, a, b, c, w):
        q, dq = (a, b, c), _slopes(n, a, b, c)
        inertia = along(lambda *q: twice_kinetic(n, q, _slopes(n, *q)), q, dq)
        push = inertia * w**2 / 2 + along(lambda *q: potential(n, q), q, dq)
        return w, dq[1] * w, dq[2] * w, -push / twice_kinetic(n, q, dq)

    a, b, c, w = integrate(rates, (*_closed(n, n.s)[0], n.s_rate), ts, width=0.02)
    return a, b, c, *(slope * w for slope in _slopes(n, a, b, c))


def _crank_rocker(r):
    """Grashof: the crank turns fully; how nearly the linkage lays flat is drawn from 1e-4 on."""
    short, margin = r.uniform(0.3, 0.8), 10 ** r.uniform(-3.0, -0.5)
    middle = short * r.uniform(1.3, 2.5), short * r.uniform(1.3, 2.5)
    long = max(sum(middle) - short - margin, *middle)  # short + long < sum of the others, by the margin
    lengths = {name: (*middle, long)[k] for name, k in zip(("r2", "r3", "d"), r.permutation(3), strict=True)}
    return (
        {"r1": short} | lengths | drawn(**MASSES, s=(-3.0, 3.0), s_rate=either(4.0, 12.0), span=(0.3, 1.2))(r)
    )


FAMILIES = (
    _slider("slider-crank-equal", "slider-crank with r = l through right angles", _equal),
    _slider("slider-crank-still", "slider-crank with r = l, the slider at rest", _still),
    _slider("slider-crank", "slider-crank with l/r - 1 from 1e-3 on", _longer),
    *(
        Family(
            name=name,
            what=what,
            draw=_crank_rocker,
            start=starting(_closed, pins=how is PINS),
            truth=_four_bar_truth,
            **FOUR_BAR,
            **how,
        )
        for name, what, how in (
            ("four-bar", "crank-rocker linkages, down to 1e-3 m from laying flat, in angles", ANGLES),
            ("four-bar-pins", "the same with pins", PINS),
        )
    ),
)
