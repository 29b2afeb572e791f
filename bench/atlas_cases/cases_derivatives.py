"""Cases about derivatives: E3, E4, E20 and the derivatives through E5, E7, E18 and E19; E21 and E23 on
accelerations.
"""

from functools import partial

import jax.numpy as jnp
import numpy as np
from oracles import rattleback, skate, snakeboard

import jourdain_jax as jj
from atlas_cases.case import Case, required
from atlas_cases.cases_rows import SNAKE_START, heavy_axle
from atlas_cases.gradients import DerivativeOfMotion
from atlas_cases.instants import DerivativeOfAccelerations, Instant
from atlas_cases.references import fall_time_slope, slope
from atlas_cases.scenes import Edges, HeavyAxle, LeadingRow, OrthonormalRows

ELSEWHERE = {"rollout": "asked in E4 gradient"}


def rosenberg() -> DerivativeOfAccelerations:
    """xddot = -y ydot xdot/(1 + y^2) (B5)."""
    scene, y, b, v = jj.models.RosenbergParticle(), 0.5, 0.8, 1.1
    state = lambda y: ([0.0, y, 0.0], [v, b, v * y])
    return DerivativeOfAccelerations(scene, state, y, (1, 0, 0), -b * v * (1 - y**2) / (1 + y**2) ** 2)


def orthonormal() -> DerivativeOfAccelerations:
    """Velocity s (cos x, sin x, 0): yddot = s^2 cos^2 x."""
    x, s = 0.3, 1.3
    state = lambda x: ([x, 0.0, 0.0], [s * jnp.cos(x), s * jnp.sin(x), 0.0])
    return DerivativeOfAccelerations(OrthonormalRows(), state, x, (0, 1, 0), -(s**2) * np.sin(2 * x))


def along_an_axis() -> DerivativeOfAccelerations:
    """yddot = -z zdot ydot/(1 + z^2) at z = 0, where the row lies along x, the first coordinate."""
    b, v = 0.8, 1.1
    state = lambda z: ([0.0, 0.0, z], [v * z, v, b])
    return DerivativeOfAccelerations(LeadingRow(), state, 0.0, (0, 1, 0), -b * v)


def dependent() -> DerivativeOfAccelerations:
    """An edge stated by three equal rows, at heading 0.4."""
    v, w, pull = 0.7, 1.3, 9.81 * np.sin(0.3)
    state = lambda h: ([0.0, 0.0, h], [v * jnp.cos(h), v * jnp.sin(h), w])
    known = -pull * np.sin(0.8) - v * w * np.cos(0.4)
    return DerivativeOfAccelerations(Edges(), state, 0.4, (1, 0, 0), known)


def through_a_motion() -> DerivativeOfMotion:
    """The skate from heading 0 for 2 s: d x / d turn rate."""
    scene, ts = jj.models.Skate(), np.array([0.0, 2.0])

    def known(w):
        return skate.motion(ts, **(skate.RUN | {"u0": 0.7, "th_rate": w}))["x"][-1]

    begin = lambda w: (scene, {"x_rate": 0.7, "heading_rate": w})
    value = lambda m: m.q_end[0]
    return DerivativeOfMotion(begin, 1.3, ts, value, slope(known, 1.3), naive_value=lambda q, u: q[0])


def through_loss_of_rank() -> DerivativeOfMotion:
    """The snakeboard across parallel rows, a step ending there: the heading is linear in the speed."""
    scene, end = jj.models.Snakeboard(), snakeboard.RUN["t_end"]
    ts = np.array([0.0, end / 2, end])
    known = snakeboard.motion(ts, **snakeboard.RUN)["th"][-1]
    begin = lambda v: (scene, SNAKE_START | {"x_rate": v})
    naively = {"naive_value": lambda q, u: q[2], "steps": 1600}
    return DerivativeOfMotion(begin, 1.0, ts, lambda m: m.q_end[2], known, **naively)


def through_projected_start() -> DerivativeOfMotion:
    """A start off the row: d x / d given sideways speed, through the M-orthogonal projection, is that along
    the edge.
    """
    scene, ts, heading = jj.models.Skate(), np.array([0.0, 1.0]), 0.4

    def known(v):
        along = v * np.sin(heading)
        return skate.motion(ts, **(skate.RUN | {"u0": along, "th0": heading}))["x"][-1]

    def begin(v):
        q, u, _ = scene.named(heading=heading, heading_rate=1.3)
        return scene, jj.consistent(scene, 0.0, q, u.at[1].set(v))

    return DerivativeOfMotion(begin, 0.5, ts, lambda m: m.q_end[0], slope(known, 0.5), skip=ELSEWHERE)


def along_the_norm() -> DerivativeOfMotion:
    """A free top for 2 s: how it ends does not depend on the norm of the quaternion that it is given."""
    scene = jj.models.FreeRigidBody()
    q, u, _ = scene.named(**scene.example)

    def begin(size):
        return scene, jj.consistent(scene, 0.0, jnp.concatenate([q[:3], size * q[3:]]), u)

    skip = ELSEWHERE | {"reductions": "no rows", "naive": "no rows"}
    ts = np.array([0.0, 2.0])
    return DerivativeOfMotion(begin, 1.0, ts, lambda m: m.q_end[4], 0.0, scale=1.0, skip=skip)


def through_a_long_motion(t_end) -> DerivativeOfMotion:
    """The rattleback: d w3(T) / d w3(0), of the order 1e3 to 1e4."""
    scene, ts = jj.models.Rattleback(), np.array([0.0, t_end])

    def known(w):
        return rattleback.motion(ts, w3=w)["w3"][-1]

    begin = lambda w: (scene, scene.example | {"w3": w})
    skip = ELSEWHERE | {"reductions": "one is enough"}
    skip |= {"Kvaerno5": "minutes; asked over 2 s"} if t_end > 2 else {}
    how = {"rtol": 1e-11, "atol": 1e-11, "skip": skip}
    return DerivativeOfMotion(begin, -5.0, ts, lambda m: m.u_end[4], slope(known, -5.0, 1e-5), **how)


def through_an_event() -> DerivativeOfMotion:
    """A disc at rest falls to its stop at 1.5 rad: d t* / d lean."""
    scene = jj.models.TiltingDisc()
    begin, ts = lambda lean: (scene, {"lean": lean}), np.array([0.0, 2.0])
    return DerivativeOfMotion(begin, 0.3, ts, lambda m: m.t_end, fall_time_slope(0.3), skip=ELSEWHERE)


def axle_accelerations() -> Instant:
    """Four rows of rank three at one state (B1): what single precision must also see."""
    scene, th, v, w = HeavyAxle(), 0.5, 0.7, 1.1
    push = 9.81 * np.sin(0.2) * (2 * 1.2 + 0.5) / (3 * 1.2 + 0.5) * np.cos(th)
    c, s = np.cos(th), np.sin(th)
    q = np.array([0.0, 0.0, th, 0.0, 0.0])
    u = np.array([v * c, v * s, w, (v - 0.4 * w) / 0.3, (v + 0.4 * w) / 0.3])
    known = np.array([push * c - v * w * s, push * s + v * w * c, 0.0, push / 0.3, push / 0.3])
    return Instant(scene, q, u, known)


OTHERS = 1e-6, 5e-2, "derivatives agree to 1e-6 relative with those of the closed form"
ROUND_OFF = 1e-10, 1e-4, "round-off"
CASES = (
    Case("E3", "derivative of accelerations: one row", rosenberg, *ROUND_OFF, quick=True),
    Case("E3 equal", "derivative of accelerations: two orthonormal rows", orthonormal, *ROUND_OFF),
    Case("E4", "derivative of accelerations: a row along an axis", along_an_axis, *ROUND_OFF, quick=True),
    Case("E4 gradient", "derivative through a motion that starts there", through_a_motion, *OTHERS),
    required("E5 gradient", "derivative through the loss of rank", through_loss_of_rank, *OTHERS),
    required("E7 gradient", "derivative of accelerations: dependent rows", dependent, *ROUND_OFF),
    required(
        "E13 gradient",
        "derivative along the norm of a quaternion",
        along_the_norm,
        1e-10,
        1e-4,
        "zero, to round-off",
    ),
    required("E18 gradient", "derivative through the projected start", through_projected_start, *OTHERS),
    *(
        Case(
            f"E19 gradient {t:g} s",
            f"derivative through {t:g} s of a rattleback",
            partial(through_a_long_motion, t),
            *OTHERS,
        )
        for t in (2.0, 10.0)
    ),
    Case("E20", "derivative of the time of an event", through_an_event, *OTHERS),
    required(
        "E21 light",
        "mass ratio 1e8: an axle with light wheels",
        partial(heavy_axle, wheel_mass=1e-8, axle_mass=1.0),
        1e-10,
        1e-3,
        "as E7",
    ),
    required(
        "E21",
        "mass ratio 1e8: an axle with heavy wheels",
        partial(heavy_axle, wheel_mass=1.0, axle_mass=1e-8),
        1e-10,
        1e-3,
        "as E7",
    ),
    Case(
        "E23",
        "dependent rows in both precisions: rank by round-off",
        axle_accelerations,
        1e-12,
        1e-5,
        "round-off",
        quick=True,
    ),
)
