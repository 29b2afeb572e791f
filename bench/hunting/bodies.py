"""Rigid bodies with quaternions, wheeled robots that turn through full headings, rolling discs, and bodies
that are carried along.
"""

import jax.numpy as jnp
import numpy as np

import jourdain_jax as jj
from hunting.family import FEW, Family, G, drawn, either, one_of
from hunting.pendulums import Weighted
from hunting.reference import integrate
from jourdain_jax.models import ChaplyginSleigh, TiltingDisc, VerticalDisc


class Top(jj.Scene):
    """A heavy body on a ball joint: three moments about the joint, mass centre ahead along its z axis."""

    coordinates = jj.coordinates(jj.quaternion("attitude"))
    i1: object = jj.parameter(1.0, positive=True)
    i2: object = jj.parameter(1.2, positive=True)
    i3: object = jj.parameter(0.6, positive=True)
    weight: object = jj.parameter(1.0)  # N m

    def bodies(self, t, q):
        frame = jj.quaternion_to_matrix(q.attitude)
        moments = jnp.stack([self.i1 - 0.01, self.i2 - 0.01, self.i3])
        return {"top": jj.RigidBody(1.0, moments, 0.1 * frame[:, 2], frame)}

    def loads(self, motion):
        return jj.gravity(motion, self.weight / 0.1)


def _top_truth(n, ts):
    """Euler's equations with the torque of the weight, -weight e3 x (R' k)."""

    def rates(_, a, x, y, z, u, v, w):
        turning = (
            (-x * u - y * v - z * w) / 2,
            (a * u + y * w - z * v) / 2,
            (a * v + z * u - x * w) / 2,
            (a * w + x * v - y * u) / 2,
        )
        up = 2 * (x * z - a * y), 2 * (y * z + a * x)  # R' k
        first, second = n.weight * up[1] - (n.i3 - n.i2) * v * w, -n.weight * up[0] - (n.i1 - n.i3) * w * u
        return *turning, first / n.i1, second / n.i2, -(n.i2 - n.i1) * u * v / n.i3

    return integrate(rates, (np.cos(n.tilt / 2), np.sin(n.tilt / 2), 0.0, 0.0, n.wx, n.wy, n.wz), ts)


OMEGA = {"wx": "attitude_omega_x", "wy": "attitude_omega_y", "wz": "attitude_omega_z"}
ATTITUDE = "attitude_w attitude_x attitude_y attitude_z"


def _top_start(n):
    turned = {"attitude_w": jnp.cos(n.tilt / 2), "attitude_x": jnp.sin(n.tilt / 2)}
    return turned | {speed: getattr(n, name) for name, speed in OMEGA.items()}


def _top(name, what, weight):
    def draw(r):
        a, b, c = np.sort(r.uniform(0.4, 1.2, 3))
        moments = r.permutation([a, b, min(c, 0.95 * (a + b))])
        spins = {"wx": r.uniform(-2, 2), "wy": r.uniform(-2, 2), "wz": r.uniform(-6, 6)}
        rest = {"tilt": r.uniform(0, 3.1), "weight": weight * r.uniform(0.5, 4), "span": r.uniform(1, 5)}
        return dict(zip(("i1", "i2", "i3"), map(float, moments), strict=True)) | spins | rest

    return Family(
        name, what, Top, draw, _top_truth, f"{ATTITUDE} {' '.join(OMEGA.values())}", _top_start, slack=3.0
    )


class Robot(Weighted):
    """A differential drive: a body and two wheels (uniform discs) on one axle; mass centre of the body ahead
    of the axle by `ahead`.
    """

    coordinates = jj.coordinates("x y heading left right")
    inputs = jj.inputs("tau_left tau_right")
    mass: object = jj.parameter(3.0, positive=True)
    inertia: object = jj.parameter(0.2, positive=True)
    ahead: object = jj.parameter(0.05)
    wheel: object = jj.parameter(0.5, positive=True)
    radius: object = jj.parameter(0.1, positive=True)
    half: object = jj.parameter(0.2, positive=True)

    def bodies(self, t, q):
        frame, r = jj.rot_z(q.heading), jnp.asarray(self.radius)
        axle = jnp.stack([q.x, q.y, r])
        side = self.half * frame[:, 1]
        wheel = lambda place, spin: jj.RigidBody.thin_disc(
            self.wheel, r, axis="y", position=place, orientation=frame @ jj.rot_y(spin)
        )
        body = jj.RigidBody(self.mass, self.inertia * jnp.ones(3), axle + self.ahead * frame[:, 0], frame)
        return {"body": body, "left": wheel(axle + side, q.left), "right": wheel(axle - side, q.right)}

    def contacts(self, pose):
        return {side: jj.disc_contact(pose[side], self.radius, axis="y") for side in ("left", "right")}

    def loads(self, motion):
        push = {"left_rate": motion.inputs.tau_left, "right_rate": motion.inputs.tau_right}
        return super().loads(motion), jj.generalized_force(motion, **push)


class RobotAhead(Robot):
    """A robot whose headings are expected near zero."""

    domain = {"heading": (-0.4, 0.4)}


def _robot_truth(n, ts):
    """M v' = m a w^2 + (tl + tr)/R, I w' = -m a v w + (tr - tl) b/R, with the wheels' inertia reduced to v
    and w.
    """
    M = n.mass + 2 * n.wheel + n.wheel  # 2 J/R^2 = m_w
    inertia = n.inertia + n.mass * n.ahead**2 + 3 * n.wheel * n.half**2 + n.wheel * n.radius**2 / 2
    moved, R, b = n.mass * n.ahead, n.radius, n.half

    def rates(_, x, y, th, left, right, v, w):
        dv = (moved * w * w + (n.tau_left + n.tau_right) / R) / M
        dw = (-moved * v * w + (n.tau_right - n.tau_left) * b / R) / inertia
        return v * np.cos(th), v * np.sin(th), w, (v - b * w) / R, (v + b * w) / R, dv, dw

    *q, v, w = integrate(rates, (0.0, 0.0, n.heading, 0.0, 0.0, n.v, n.heading_rate), ts)
    return *q, w, (v - b * w) / R, (v + b * w) / R


def _robot_start(n):
    rates = {"x_rate": n.v * jnp.cos(n.heading), "y_rate": n.v * jnp.sin(n.heading)}
    turned = n.half * n.heading_rate
    return rates | {"left_rate": (n.v - turned) / n.radius, "right_rate": (n.v + turned) / n.radius}


ROBOT = {
    "draw": drawn(
        mass=(1, 5), inertia=(0.05, 0.4), ahead=one_of(0.0, (-0.1, 0.1)), wheel=(0.1, 1), radius=(0.05, 0.2),
        half=(0.1, 0.3), heading=(-0.3, 0.3),
        v=(-1, 1), heading_rate=either(0.5, 4), tau_left=(-0.02, 0.02), tau_right=(-0.02, 0.02), span=(1, 6),
    ),
    "truth": _robot_truth, "names": "x y heading left right heading_rate left_rate right_rate",
    "start": _robot_start, "slack": 3.0,
    "inputs": lambda n: {"tau_left": n.tau_left, "tau_right": n.tau_right},
    "shared": ("span", "tau_left", "tau_right"),
}  # fmt: skip


class SleighAhead(ChaplyginSleigh):
    """Headings near zero are expected."""

    domain = {"heading": (-0.3, 0.3)}


def _sleigh_truth(n, ts):
    """v' = a w^2, w' = -a v w/k^2, k^2 = I/m + a^2; x, y of the mass centre, heading and its rate."""
    a, k2 = n.offset, n.inertia / n.mass + n.offset**2

    def rates(_, x, y, th, v, w):
        c, s = np.cos(th), np.sin(th)
        return v * c - a * w * s, v * s + a * w * c, w, a * w * w, -a * v * w / k2

    x, y, heading, _, w = integrate(rates, (0.0, 0.0, 0.0, n.x_rate, n.heading_rate), ts)
    return x, y, heading, w


SLEIGH = {
    "draw": drawn(
        mass=(0.5, 2), inertia=(0.2, 1), offset=(-0.3, 0.3), x_rate=(-1, 1), heading_rate=either(0.5, 4),
        span=(1, 6),
    ),
    "start": lambda n: {"y_rate": n.offset * n.heading_rate}, "truth": _sleigh_truth,
    "names": "x y heading heading_rate",
}  # fmt: skip


def _disc_truth(n, ts):
    """Uniform disc in yaw, lean, spin: Appell's equations for w1 = lean', w2 = yaw' cos lean, w3 = spin' +
    yaw' sin lean (tests/oracles/rolling_disc.py).
    """
    m, a = n.mass, n.radius
    A, C, ring = m * a * a / 4, m * a * a / 2, m * a * a

    def rates(_, x, y, yaw, lean, spin, w1, w2, w3):
        turn, tan = w2 / np.cos(lean), np.tan(lean)
        rolling = w3 - turn * np.sin(lean)
        # as in the oracle with theta = lean + pi/2, cot(theta) = -tan(lean), w3 there = -w3 here
        dw1 = (-A * w2**2 * tan + (C + ring) * w2 * w3 + m * G * a * np.sin(lean)) / (A + ring)
        dw2 = w1 * (-C * w3 + A * w2 * tan) / A
        forward = a * rolling
        angles = forward * np.cos(yaw), forward * np.sin(yaw), turn, w1, rolling
        return *angles, dw1, dw2, -ring * w1 * w2 / (C + ring)

    speeds = n.lean_rate, n.yaw_rate * np.cos(n.lean), n.spin_rate + n.yaw_rate * np.sin(n.lean)
    return integrate(rates, (0.0, 0.0, 0.0, n.lean, 0.0, *speeds), ts, width=0.03)[:5]


class CarriedPendulum(Weighted):
    """A pendulum on a cart whose pose is a function of time."""

    coordinates = jj.coordinates("angle")
    size: object = jj.parameter(0.3)
    rate: object = jj.parameter(2.0)
    length: object = jj.parameter(1.0, positive=True)

    def cart(self, t):
        return self.size * jnp.sin(self.rate * t)

    def bob(self, place, q):
        """The body, with the cart at a place."""
        bob = [place + self.length * jnp.sin(q.angle), 0.0, -self.length * jnp.cos(q.angle)]
        return {"bob": jj.Particle(1.0, bob)}

    def bodies(self, t, q):
        return self.bob(self.cart(t), q)


class Wagon(CarriedPendulum):
    """A pendulum on a cart whose place is prescribed."""

    coordinates = jj.coordinates("cart angle")

    def bodies(self, t, q):
        return self.bob(q.cart, q)

    def prescribed(self, t):
        return {"cart": self.cart(t)}


class SampledCarriedPendulum(CarriedPendulum):
    """Samples of the sine, linear in between: their second derivative is zero almost everywhere."""

    def cart(self, t):
        ts = jnp.linspace(0.0, 10.0, 401)
        return self.size * jnp.interp(t, ts, jnp.sin(self.rate * ts))


class SampledWagon(Wagon):
    """A prescribed place by such samples."""

    cart = SampledCarriedPendulum.cart


def _wagon_truth(n, ts):
    """l angle'' = -g sin(angle) - cart'' cos(angle)."""
    push = lambda t: n.size * n.rate**2 * np.sin(n.rate * t)
    rates = lambda t, angle, w: (w, (-G * np.sin(angle) + push(t) * np.cos(angle)) / n.length)
    return integrate(rates, (n.angle, n.angle_rate), ts)


WAGON = {
    "draw": drawn(
        size=(0.1, 0.5), rate=(1, 4), length=(0.5, 1.5), angle=(-0.5, 0.5), angle_rate=0.0, span=(1, 5),
    ),
    "truth": _wagon_truth, "names": "angle angle_rate", "cases": 28, "asks": FEW,
}  # fmt: skip
SAMPLED = WAGON | {"slack": 100.0, "single": False}


def _circles(n, ts):
    w, circle = n.heading_rate, n.radius * n.roll_rate / n.heading_rate
    return circle * np.sin(w * ts), circle * (1 - np.cos(w * ts)), w * ts, n.roll_rate * ts


FAMILIES = (
    _top("free-body", "a free rigid body with a quaternion", 0.0),
    _top("top", "a heavy unsymmetric top with a quaternion", 1.0),
    Family(name="robot", what="differential-drive robots through full headings", scene=Robot, **ROBOT),
    Family(
        name="robot-ahead", what="the same with a narrow domain of the heading", scene=RobotAhead, **ROBOT,
    ),
    Family(name="sleigh", what="Chaplygin's sleigh", scene=ChaplyginSleigh, **SLEIGH),
    Family(
        name="sleigh-ahead", what="the same with a narrow domain of the heading", scene=SleighAhead, **SLEIGH,
    ),
    Family(
        name="disc", what="rolling discs", scene=TiltingDisc, truth=_disc_truth, names="x y yaw lean spin",
        slack=3.0,
        draw=drawn(
            mass=(0.3, 3), radius=(0.2, 0.8), lean=(-0.4, 0.4), lean_rate=(-0.3, 0.3), yaw_rate=(-1, 1),
            spin_rate=either(6, 12), span=(0.5, 3),
        ),
    ),
    Family(
        name="upright-disc", what="an upright disc on circles, saved seldom and often", scene=VerticalDisc,
        names="x y heading roll", truth=_circles,
        draw=drawn(radius=(0.3, 1), heading_rate=either(0.5, 6), roll_rate=(-5, 5), span=(1, 8)),
    ),
    Family(name="wagon", what="a pendulum on a cart whose place is prescribed", scene=Wagon, **WAGON),
    Family(name="carried-pendulum", what="the same as a pose of time", scene=CarriedPendulum, **WAGON),
    Family(name="wagon-sampled", what="the same, prescribed by `jnp.interp`", scene=SampledWagon, **SAMPLED),
    Family(name="carried-sampled", what="a pose by `jnp.interp`", scene=SampledCarriedPendulum, **SAMPLED),
)  # fmt: skip
