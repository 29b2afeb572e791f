"""Reduced equations of motion of six models as an expert would write them, in the models' own coordinates and
privileged speeds.

Each function is `(parameters, t, q, v, xp=jnp) -> (qdot, vdot)`: scalars by name in `parameters`, one scalar
(or one array over lanes) per coordinate in the tuple `q` and per privileged speed in `v`; all rates of the
minimal state come back as two tuples. `xp` has `sin`, `cos` and `zeros_like`. Expressions of parameters alone
stand first; `operations(name)` counts the rest, each common subexpression once.

Sources: the docstrings of the models; Wang and Pao (2003), sections V and VI; Neimark and Fufaev (1972), ch.
III.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp

from .count import count_operations


def two_wheel_axle(parameters, t, q, v, xp=jnp):
    """Two wheels on a rigid axle, (61) and (64): `phi'' = 0`,
    `psi1'' = M g sin(alpha) cos(phi) / (a (M + m'))`.
    """
    a, M = parameters["radius"], parameters["mass"]
    l_over_a = parameters["length"] / a
    push = M * parameters["gravity"] * xp.sin(parameters["slope"]) / (a * (M + parameters["rim_mass"]))
    phi, (psi1_rate, phi_rate) = q[6], v
    s, c = xp.sin(phi), xp.cos(phi)
    psi2_rate = psi1_rate - l_over_a * phi_rate  # the rigid axle (61)
    first, second = a * psi1_rate, a * psi2_rate  # speeds of the wheels along the heading
    qdot = (first * c, first * s, psi1_rate, second * c, second * s, psi2_rate, phi_rate)
    return qdot, (push * c, xp.zeros_like(phi_rate))


def skate(parameters, t, q, v, xp=jnp):
    """The skate in all three speeds, regular at every heading: acceleration G cos(heading) along the blade, w
    v across it.
    """
    G = parameters["gravity"] * xp.sin(parameters["slope"])
    x_rate, y_rate, w = v
    s, c = xp.sin(q[2]), xp.cos(q[2])
    along = G * c
    return (x_rate, y_rate, w), (along * c - w * y_rate, along * s + w * x_rate, xp.zeros_like(w))


def chaplygin_sleigh(parameters, t, q, v, xp=jnp):
    """The sleigh in x_rate, y_rate: the blade pushes across the heading only, `x'' = -s k v w`,
    `y'' = c k v w`.

    v is the forward speed, w the turn rate, k = I/(I + m a^2). With the mass centre's speed across the
    heading `b = c ydot - s xdot = a w`, `s v = ydot - c b` and `c v = xdot + s b`.
    """
    m, I, a = parameters["mass"], parameters["inertia"], parameters["offset"]
    per_a = 1 / a
    k_over_a = I / (I + m * a * a) * per_a
    x_rate, y_rate = v
    s, c = xp.sin(q[2]), xp.cos(q[2])
    b = c * y_rate - s * x_rate
    kw = k_over_a * b
    return (x_rate, y_rate, per_a * b), (kw * (c * b - y_rate), kw * (x_rate + s * b))


def vertical_disc(parameters, t, q, v, xp=jnp):
    """The upright disc: both rates are constant."""
    heading_rate, roll_rate = v
    forward = parameters["radius"] * roll_rate
    qdot = (forward * xp.cos(q[2]), forward * xp.sin(q[2]), heading_rate, roll_rate)
    return qdot, (xp.zeros_like(heading_rate), xp.zeros_like(roll_rate))


def tilting_disc(parameters, t, q, v, xp=jnp):
    """The uniform rolling disc in the rates of yaw, lean and spin; s, c = sin, cos of the lean.

        cos(lean) yaw'' = -2 lean' spin'
        lean''          = yaw' c (yaw' s + 6/5 spin') + 4g/(5a) s
        spin''          = -5/3 lean' yaw' c - yaw'' s

    These are Euler's equations about the centre with the force at the contact eliminated, axial moment m
    a^2/2, diametral m a^2/4.
    """
    a = parameters["radius"]
    fall = 0.8 * parameters["gravity"] / a
    yaw_rate, lean_rate, spin_rate = v
    s, c = xp.sin(q[3]), xp.cos(q[3])
    forward, upright = a * spin_rate, yaw_rate * c
    yaw_acceleration = -2 * (lean_rate * spin_rate) / c
    lean_acceleration = upright * (yaw_rate * s + 1.2 * spin_rate) + fall * s
    spin_acceleration = (-5 / 3) * (lean_rate * upright) - yaw_acceleration * s
    qdot = (forward * xp.cos(q[2]), forward * xp.sin(q[2]), yaw_rate, lean_rate, spin_rate)
    return qdot, (yaw_acceleration, lean_acceleration, spin_acceleration)


def ball_on_turntable(parameters, t, q, v, xp=jnp):
    """The ball on a tilted turntable: `R'' = n z x R' + push x`, and the attitude `e' = (0, omega/2) e` with
    omega in space axes.

    No slip gives omega = `((Om x - y')/r, (x' + Om y)/r, spin)` in the axes of the table.
    """
    kappa, Om, tilt, r = (parameters[name] for name in ("inertia_ratio", "turn_rate", "tilt", "radius"))
    push = parameters["gravity"] * xp.sin(tilt) / (1 + kappa)
    n = Om * kappa / (1 + kappa)
    per_2r = 0.5 / r
    cos_2r, sin_2r, cos_2, sin_2 = (
        xp.cos(tilt) * per_2r,
        xp.sin(tilt) * per_2r,
        xp.cos(tilt) / 2,
        xp.sin(tilt) / 2,
    )
    x, y, e0, e1, e2, e3 = q
    x_rate, y_rate, spin = v
    along = Om * x - y_rate
    w1 = along * cos_2r + spin * sin_2  # omega/2; `down` is minus its third component
    w2 = (x_rate + Om * y) * per_2r
    down = along * sin_2r - spin * cos_2
    attitude_rate = (
        down * e3 - w1 * e1 - w2 * e2,
        w1 * e0 + w2 * e3 + down * e2,
        w2 * e0 - down * e1 - w1 * e3,
        w1 * e2 - w2 * e1 - down * e0,
    )
    return (x_rate, y_rate, *attitude_rate), (push - n * y_rate, n * x_rate, xp.zeros_like(spin))


class HandDerived(NamedTuple):
    """Equations by hand and the names of what they take."""

    rates: Callable
    parameters: tuple[str, ...]
    coordinates: tuple[str, ...]
    speeds: tuple[str, ...]  # the integrated ones


def _entry(rates: Callable, parameters: str, coordinates: str, speeds: str) -> HandDerived:
    return HandDerived(rates, tuple(parameters.split()), tuple(coordinates.split()), tuple(speeds.split()))


HAND_DERIVED = {
    "two-wheel-axle-coordinates": _entry(
        two_wheel_axle,
        "radius length mass rim_mass slope gravity",
        "x1 y1 psi1 x2 y2 psi2 phi",
        "psi1_rate phi_rate",
    ),
    "skate": _entry(skate, "slope gravity", "x y heading", "x_rate y_rate heading_rate"),
    "chaplygin-sleigh": _entry(chaplygin_sleigh, "mass inertia offset", "x y heading", "x_rate y_rate"),
    "vertical-disc": _entry(vertical_disc, "radius", "x y heading roll", "heading_rate roll_rate"),
    "tilting-disc": _entry(
        tilting_disc, "radius gravity", "x y yaw lean spin", "yaw_rate lean_rate spin_rate"
    ),
    "ball-on-turntable": _entry(
        ball_on_turntable,
        "radius inertia_ratio turn_rate tilt gravity",
        "x y attitude_w attitude_x attitude_y attitude_z",
        "x_rate y_rate spin",
    ),
}


def operations(name: str) -> int:
    """Number of operations of the equations called `name`, after common subexpressions, without those of
    parameters alone.
    """
    known = HAND_DERIVED[name]
    return count_operations(known.rates, known.parameters, len(known.coordinates), len(known.speeds)).total()
