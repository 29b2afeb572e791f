"""Thin disc rolling and tilting on a level plane (B6). Appell 1899; Korteweg 1899; Cushman & Duistermaat
2006.

theta is the angle between the disc's axis and the vertical, pi/2 upright. Frame: e1 = (cos psi, sin psi, 0)
along the line of nodes, e3 = (sin theta sin psi, -sin theta cos psi, cos theta) the axis, e2 = e3 x e1 from
the contact to the centre.
w1 = thetadot, w2 = psidot sin theta, w3 = phidot + psidot cos theta; phi is the spin about e3. The contact
point moves with -a phidot e1, the centre with a (w1 e3 - w3 e1). A: moment about a diameter, C: about the
axis (uniform: m a^2/4, m a^2/2).

The yaw-lean-spin form rot_z(yaw) rot_x(lean) rot_y(spin), disc axis y, is the same with yaw = psi, lean =
theta - pi/2,
spin = -phi (the axle y is -e3); x, y is the contact point in both.
"""

import mpmath
import numpy as np

from .reference import LONG, integrate

# Rates of yaw, lean and spin as in the yaw-lean-spin form; smooth, |d final / d initial| up to 66.
RUN = {
    "mass": 1.0,
    "radius": 0.5,
    "gravity": 9.81,
    "yaw": 0.0,
    "lean": 0.3,
    "spin": 0.0,
    "yaw_rate": 0.5,
    "lean_rate": 0.2,
    "spin_rate": -3.0,
    "t_end": 10.0,
}
NEAR_FALL = {"mass": 1.0, "radius": 0.3, "gravity": 9.81, "theta0": 0.3}  # start at rest but for w2 = eps


def uniform_inertia(mass: float, radius: float) -> tuple[float, float]:
    """(A, C) of the uniform disc."""
    return mass * radius**2 / 4, mass * radius**2 / 2


def motion(t, *, mass, radius, gravity, theta, psi=0.0, phi=0.0, w1, w2, w3) -> dict[str, np.ndarray]:
    """theta, psi, phi, w1, w2, w3, contact x, y (from zero), centre cx, cy, cz, integrated at about 1e-16 per
    step.

    Leaves theta in (0, pi) alone: no flat disc.
    """
    a_moment, c_moment = uniform_inertia(mass, radius)
    ring = mass * radius**2

    def rhs(_, state):
        th, ps, _, a, b, c, _, _ = state
        sine, cosine = np.sin(th), np.cos(th)
        cot = cosine / sine
        yaw_rate = b / sine
        spin_rate = c - yaw_rate * cosine
        return [
            a,
            yaw_rate,
            spin_rate,
            (a_moment * b**2 * cot - (c_moment + ring) * b * c - mass * gravity * radius * cosine)
            / (a_moment + ring),
            a * (c_moment * c - a_moment * b * cot) / a_moment,
            ring * a * b / (c_moment + ring),
            -radius * spin_rate * np.cos(ps),
            -radius * spin_rate * np.sin(ps),
        ]

    states = integrate(rhs, [theta, psi, phi, w1, w2, w3, 0.0, 0.0], t)
    result = dict(zip(("theta", "psi", "phi", "w1", "w2", "w3", "x", "y"), states.T, strict=True))
    th, ps = result["theta"], result["psi"]
    result["cx"] = result["x"] - radius * np.cos(th) * np.sin(ps)
    result["cy"] = result["y"] + radius * np.cos(th) * np.cos(ps)
    result["cz"] = radius * np.sin(th)
    return result


def motion_yaw_lean_spin(
    t, *, mass, radius, gravity, yaw, lean, spin, yaw_rate, lean_rate, spin_rate, **_
) -> dict[str, np.ndarray]:
    """The motion from and in yaw, lean, spin (the last are keys beside those of `motion`)."""
    theta = LONG(np.pi) / 2 + LONG(lean)  # pi/2 of double precision: cos(theta) = -sin(lean) to 6e-17
    result = motion(
        t,
        mass=mass,
        radius=radius,
        gravity=gravity,
        theta=theta,
        psi=yaw,
        phi=-spin,
        w1=lean_rate,
        w2=yaw_rate * np.cos(LONG(lean)),
        w3=-(spin_rate + yaw_rate * np.sin(LONG(lean))),
    )
    return {**result, "yaw": result["psi"], "lean": result["theta"] - np.pi / 2, "spin": -result["phi"]}


def _legendre(nu, x) -> tuple[float, float]:
    """P_nu(x) and dP_nu/dx for nu(nu + 1) real; both are real."""
    z = (1 - mpmath.mpf(float(x))) / 2
    value = mpmath.hyp2f1(-nu, nu + 1, 1, z)
    slope = nu * (nu + 1) / 2 * mpmath.hyp2f1(1 - nu, nu + 2, 2, z)
    return float(mpmath.re(value)), float(mpmath.re(slope))


def legendre_constants(theta, w2, w3, *, mass, radius) -> tuple[np.ndarray, np.ndarray]:
    """(c1, c2) of w3 = c1 P_nu(cos theta) + c2 P_nu(-cos theta), w2 = ((C + m a^2)/(m a^2)) dw3/dtheta: two
    integrals.

    nu (nu + 1) = -C m a^2 / (A (C + m a^2)). Arrays of one shape in, two arrays of that shape out.
    """
    a_moment, c_moment = uniform_inertia(mass, radius)
    ring = mass * radius**2
    nu = (-1 + mpmath.sqrt(1 - 4 * mpmath.mpf(c_moment * ring) / (a_moment * (c_moment + ring)))) / 2
    ratio = (c_moment + ring) / ring
    constants = []
    for th, b, c in np.broadcast(theta, w2, w3):
        x, sine = np.cos(th), np.sin(th)
        (p, dp), (q, dq) = _legendre(nu, x), _legendre(nu, -x)
        matrix = np.array([[p, q], [-ratio * sine * dp, ratio * sine * dq]])
        constants.append(np.linalg.solve(matrix, [c, b]))
    first, second = np.array(constants).T.reshape(2, *np.shape(theta))
    return first, second


def steady_circle(theta: float, yaw_rate: float, *, mass, radius, gravity) -> dict[str, float]:
    """spin_rate (phidot) of steady rolling."""
    a_moment, c_moment = uniform_inertia(mass, radius)
    w2 = yaw_rate * np.sin(theta)
    load = mass * gravity * radius * np.cos(theta)
    w3 = (a_moment * w2**2 / np.tan(theta) - load) / ((c_moment + mass * radius**2) * w2)
    return {"spin_rate": w3 - yaw_rate * np.cos(theta)}


def spinning_threshold(*, mass, radius, gravity) -> float:
    """Smallest stable yaw rate of upright spinning on the spot; uniform: sqrt(4g/5a)."""
    a_moment, _ = uniform_inertia(mass, radius)
    return float(np.sqrt(mass * gravity * radius / (a_moment + mass * radius**2)))
