"""Rigid bodies with quaternions, wheeled robots that turn through full headings, rolling discs, and bodies that are carried along."""

import jax.numpy as jnp
import numpy as np

import jourdain_jax as jj
from hunting.family import Ask, Family, Truth
from hunting.reference import integrate
from jourdain_jax.models import ChaplyginSleigh, TiltingDisc, VerticalDisc

G = 9.81


class Top(jj.Scene):
    """A heavy body on a ball joint: three moments about the joint, mass centre ahead along its z axis."""

    coordinates = jj.coordinates(jj.quaternion("attitude"))
    i1: object = jj.parameter(1.0, unit="kg m^2", positive=True)
    i2: object = jj.parameter(1.2, unit="kg m^2", positive=True)
    i3: object = jj.parameter(0.6, unit="kg m^2", positive=True)
    weight: object = jj.parameter(1.0, unit="N m")

    def bodies(self, t, q):
        frame = jj.quaternion_to_matrix(q.attitude)
        arm = 0.1 * frame[:, 2]
        return {"top": jj.RigidBody(1.0, jnp.stack([self.i1 - 0.01, self.i2 - 0.01, self.i3]), arm, frame)}

    def loads(self, motion):
        return (jj.gravity(motion, self.weight / 0.1),)


QUATERNION = ("attitude_w", "attitude_x", "attitude_y", "attitude_z")
OMEGA = ("attitude_omega_x", "attitude_omega_y", "attitude_omega_z")


def attitude_rates(p, w):
    """Quaternion rates of body angular velocities w (cases, 3)."""
    a, x, y, z = p.T
    u, v, s = w.T
    return 0.5 * np.stack([-x * u - y * v - z * s, a * u + y * s - z * v, a * v + z * u - x * s, a * s + x * v - y * u], axis=1)


def _top_truth(n, ts):
    """Euler's equations with the torque of the weight, -weight e3 x (R' k)."""
    moments = np.stack([n["i1"], n["i2"], n["i3"]], axis=1)

    def rates(_, y):
        p, w = y[:, :4], y[:, 4:]
        a, x, ny, z = p.T
        up = np.stack([2 * (x * z - a * ny), 2 * (ny * z + a * x), 1 - 2 * (x * x + ny * ny)], axis=1)  # R' k
        torque = -n["weight"][:, None] * np.cross(np.array([0.0, 0.0, 1.0]), up)
        return np.concatenate([attitude_rates(p, w), (torque - np.cross(w, moments * w)) / moments], axis=1)

    start = np.concatenate(
        [np.stack([np.cos(n["tilt"] / 2), np.sin(n["tilt"] / 2), 0 * n["tilt"], 0 * n["tilt"]], axis=1), np.stack([n["wx"], n["wy"], n["wz"]], axis=1)], axis=1
    )
    return Truth(integrate(rates, start, ts, width=0.05))


def _top_start(n):
    half, o = n["tilt"] / 2, 0.0 * n["tilt"]
    return {"attitude_w": jnp.cos(half), "attitude_x": jnp.sin(half), "attitude_y": o, "attitude_z": o} | {
        name: n[k] for name, k in zip(OMEGA, ("wx", "wy", "wz"), strict=True)
    }


def _top(name, what, weight):
    def draw(r):
        a, b, c = np.sort(r.uniform(0.4, 1.2, 3))
        c = min(c, 0.95 * (a + b))
        moments = r.permutation([a, b, c])
        spins = {"wx": r.uniform(-2, 2), "wy": r.uniform(-2, 2), "wz": r.uniform(-6, 6)}
        return (
            dict(zip(("i1", "i2", "i3"), map(float, moments), strict=True))
            | spins
            | {"tilt": r.uniform(0, 3.1), "weight": weight * r.uniform(0.5, 4), "span": r.uniform(1, 5)}
        )

    return Family(
        name=name, what=what, scene=Top, draw=draw, start=_top_start, truth=_top_truth, names=(*QUATERNION, *OMEGA),
        parameters=lambda n: {k: n[k] for k in ("i1", "i2", "i3", "weight")}, slack=3.0,
    )  # fmt: skip


class Robot(jj.Scene):
    """A differential drive: a body and two wheels (uniform discs) on one axle; mass centre of the body ahead of the axle by `ahead`."""

    coordinates = jj.coordinates("x y heading left right")
    inputs = jj.inputs("tau_left tau_right")
    mass: object = jj.parameter(3.0, unit="kg", positive=True)
    inertia: object = jj.parameter(0.2, unit="kg m^2", positive=True)
    ahead: object = jj.parameter(0.05, unit="m")
    wheel: object = jj.parameter(0.5, unit="kg", positive=True)
    radius: object = jj.parameter(0.1, unit="m", positive=True)
    half: object = jj.parameter(0.2, unit="m", positive=True)

    def bodies(self, t, q):
        frame, r = jj.rot_z(q.heading), jnp.asarray(self.radius)
        axle = jnp.stack([q.x, q.y, r + 0.0 * q.x])
        side = self.half * frame[:, 1]
        wheel = lambda place, spin: jj.RigidBody.thin_disc(self.wheel, r, axis="y", position=place, orientation=frame @ jj.rot_y(spin))  # noqa: E731
        body = jj.RigidBody(self.mass, self.inertia * jnp.ones(3), axle + self.ahead * frame[:, 0], frame)
        return {"body": body, "left": wheel(axle + side, q.left), "right": wheel(axle - side, q.right)}

    def contacts(self, pose):
        return {side: jj.disc_contact(pose[side], self.radius, axis="y") for side in ("left", "right")}

    def loads(self, motion):
        push = {"left_rate": motion.inputs.tau_left, "right_rate": motion.inputs.tau_right}
        return (jj.gravity(motion, G), jj.generalized_force(motion, **push))


class RobotAhead(Robot):
    """A robot whose headings are expected near zero."""

    domain = {"heading": (-0.4, 0.4)}


def _robot_truth(n, ts):
    """M v' = m a w^2 + (tl + tr)/R,  I w' = -m a v w + (tr - tl) b/R, with the wheels' inertia reduced to v and w."""
    M = n["m"] + 2 * n["wheel"] + n["wheel"]  # 2 J/R^2 = m_w
    inertia = n["inertia"] + n["m"] * n["ahead"] ** 2 + 3 * n["wheel"] * n["b"] ** 2 + n["wheel"] * n["R"] ** 2 / 2

    def rates(_, y):
        _, _, th, _, _, v, w = y.T
        moved = n["m"] * n["ahead"]
        dv = (moved * w * w + (n["tl"] + n["tr"]) / n["R"]) / M
        dw = (-moved * v * w + (n["tr"] - n["tl"]) * n["b"] / n["R"]) / inertia
        return np.stack([v * np.cos(th), v * np.sin(th), w, (v - n["b"] * w) / n["R"], (v + n["b"] * w) / n["R"], dv, dw], axis=1)

    o = 0.0 * n["v"]
    y = integrate(rates, np.stack([o, o, n["th"], o, o, n["v"], n["w"]], axis=1), ts, width=0.05)
    v, w = y[..., 5], y[..., 6]
    R, b = n["R"][:, None], n["b"][:, None]
    return Truth(np.concatenate([y[..., :5], np.stack([w, (v - b * w) / R, (v + b * w) / R], axis=-1)], axis=-1))


def _robot_start(n):
    v, w, o = n["v"], n["w"], 0.0 * n["v"]
    rates = {"x_rate": v * jnp.cos(n["th"]), "y_rate": v * jnp.sin(n["th"]), "heading_rate": w}
    return {"x": o, "y": o, "heading": n["th"], "left": o, "right": o, "left_rate": (v - n["b"] * w) / n["R"], "right_rate": (v + n["b"] * w) / n["R"]} | rates


def _robot(name, what, scene):
    def draw(r):
        drawn = {
            "m": r.uniform(1, 5),
            "inertia": r.uniform(0.05, 0.4),
            "ahead": r.choice([0.0, r.uniform(-0.1, 0.1)]),
            "wheel": r.uniform(0.1, 1),
            "R": r.uniform(0.05, 0.2),
        }
        drawn |= {"b": r.uniform(0.1, 0.3), "th": r.uniform(-0.3, 0.3), "v": r.uniform(-1, 1), "w": r.choice([-1, 1]) * r.uniform(0.5, 4)}
        return drawn | {"tl": r.uniform(-0.02, 0.02), "tr": r.uniform(-0.02, 0.02), "span": r.uniform(1, 6)}

    return Family(
        name=name, what=what, scene=scene, draw=draw, start=_robot_start, truth=_robot_truth,
        names=("x", "y", "heading", "left", "right", "heading_rate", "left_rate", "right_rate"),
        parameters=lambda n: {"mass": n["m"], "inertia": n["inertia"], "ahead": n["ahead"], "wheel": n["wheel"], "radius": n["R"], "half": n["b"]},
        inputs=lambda n: {"tau_left": n["tl"], "tau_right": n["tr"]}, shared=("span", "tl", "tr"), slack=3.0,
    )  # fmt: skip


class SleighAhead(ChaplyginSleigh):
    """Headings near zero are expected."""

    domain = {"heading": (-0.3, 0.3)}


def sleigh_states(n, ts):
    """v' = a w^2, w' = -a v w/k^2, k^2 = I/m + a^2; x, y of the mass centre, heading and its rate."""
    k2 = n["inertia"] / n["m"] + n["a"] ** 2

    def rates(_, y):
        _, _, th, v, w = y.T
        c, s = np.cos(th), np.sin(th)
        return np.stack([v * c - n["a"] * w * s, v * s + n["a"] * w * c, w, n["a"] * w * w, -n["a"] * v * w / k2], axis=1)

    o = 0.0 * n["v"]
    return integrate(rates, np.stack([o, o, o, n["v"], n["w"]], axis=1), ts)[..., [0, 1, 2, 4]]


def _disc_truth(n, ts):
    """Uniform disc in yaw, lean, spin: Appell's equations for w1 = lean', w2 = yaw' cos lean, w3 = spin' + yaw' sin lean (tests/oracles/rolling_disc.py)."""
    m, a = n["m"], n["R"]
    A, C, ring = m * a * a / 4, m * a * a / 2, m * a * a

    def rates(_, y):
        yaw, lean, _, w1, w2, w3, _, _ = y.T
        turn = w2 / np.cos(lean)
        spin = w3 - turn * np.sin(lean)
        tan = np.tan(lean)
        # as in the oracle with theta = lean + pi/2, cot(theta) = -tan(lean), w3 there = -w3 here
        dw1 = (-A * w2**2 * tan + (C + ring) * w2 * w3 + m * G * a * np.sin(lean)) / (A + ring)
        dw2 = w1 * (-C * w3 + A * w2 * tan) / A
        dw3 = -ring * w1 * w2 / (C + ring)
        return np.stack([turn, w1, spin, dw1, dw2, dw3, a * spin * np.cos(yaw), a * spin * np.sin(yaw)], axis=1)

    o = 0.0 * m
    start = np.stack([o, n["lean"], o, n["lean_rate"], n["yaw_rate"] * np.cos(n["lean"]), n["spin_rate"] + n["yaw_rate"] * np.sin(n["lean"]), o, o], axis=1)
    y = integrate(rates, start, ts, width=0.03)
    return Truth(y[..., [6, 7, 0, 1, 2]])


class Wagon(jj.Scene):
    """A pendulum on a cart whose place is prescribed; `how` says by which function."""

    coordinates = jj.coordinates("cart angle")
    size: object = jj.parameter(0.3, unit="m")
    rate: object = jj.parameter(2.0, unit="rad/s")
    length: object = jj.parameter(1.0, unit="m", positive=True)

    def bodies(self, t, q):
        bob = jnp.stack([q.cart + self.length * jnp.sin(q.angle), 0.0 * q.cart, -self.length * jnp.cos(q.angle)])
        return {"bob": jj.Particle(1.0, bob)}

    def prescribed(self, t):
        return {"cart": self.size * jnp.sin(self.rate * t)}

    def loads(self, motion):
        return (jj.gravity(motion, G),)


class SampledWagon(Wagon):
    """Samples of the sine, linear in between: their second derivative is zero almost everywhere."""

    def prescribed(self, t):
        ts = jnp.linspace(0.0, 10.0, 401)
        return {"cart": self.size * jnp.interp(t, ts, jnp.sin(self.rate * ts))}


class CarriedPendulum(jj.Scene):
    """A pendulum on a cart whose pose is a function of time."""

    coordinates = jj.coordinates("angle")
    size: object = jj.parameter(0.3, unit="m")
    rate: object = jj.parameter(2.0, unit="rad/s")
    length: object = jj.parameter(1.0, unit="m", positive=True)

    def cart(self, t):
        return self.size * jnp.sin(self.rate * t)

    def bodies(self, t, q):
        bob = jnp.stack([self.cart(t) + self.length * jnp.sin(q.angle), 0.0 * q.angle, -self.length * jnp.cos(q.angle)])
        return {"bob": jj.Particle(1.0, bob)}

    def loads(self, motion):
        return (jj.gravity(motion, G),)


class SampledCarriedPendulum(CarriedPendulum):
    """Samples of the sine, linear in between."""

    def cart(self, t):
        ts = jnp.linspace(0.0, 10.0, 401)
        return self.size * jnp.interp(t, ts, jnp.sin(self.rate * ts))


def _wagon_truth(n, ts):
    """l angle'' = -g sin(angle) - cart'' cos(angle)."""

    def rates(t, y):
        push = n["size"] * n["rate"] ** 2 * np.sin(n["rate"] * t)
        return np.stack([y[:, 1], (-G * np.sin(y[:, 0]) + push * np.cos(y[:, 0])) / n["l"]], axis=1)

    return Truth(integrate(rates, np.stack([n["angle"], n["w"]], axis=1), ts, width=0.05))


def _wagon(name, what, scene, cases, slack=1.0, **more):
    return Family(
        name=name, what=what, scene=scene, truth=_wagon_truth, names=("angle", "angle_rate"), cases=cases, slack=slack,
        draw=lambda r: {"size": r.uniform(0.1, 0.5), "rate": r.uniform(1, 4), "l": r.uniform(0.5, 1.5), "angle": r.uniform(-0.5, 0.5), "w": 0.0,
                        "span": r.uniform(1, 5)},
        start=lambda n: {"angle": n["angle"], "angle_rate": n["w"]}, parameters=lambda n: {"size": n["size"], "rate": n["rate"], "length": n["l"]}, **more,
    )  # fmt: skip


def _circles(n, ts):
    w, circle = n["w"][:, None], (n["R"] * n["p"] / n["w"])[:, None]
    return Truth(np.stack([circle * np.sin(w * ts), circle * (1 - np.cos(w * ts)), w * ts, n["p"][:, None] * ts], axis=-1))


FEW = (Ask("simulate"), Ask("jit", 33), Ask("rollout", 33, 1e-6), Ask("vmap"))
SLEIGH = {
    "draw": lambda r: {"m": r.uniform(0.5, 2), "inertia": r.uniform(0.2, 1), "a": r.uniform(-0.3, 0.3), "v": r.uniform(-1, 1),
                       "w": r.choice([-1, 1]) * r.uniform(0.5, 4), "span": r.uniform(1, 6)},
    "start": lambda n: {"x": 0.0 * n["a"], "y": 0.0 * n["a"], "heading": 0.0 * n["a"], "x_rate": n["v"], "y_rate": n["a"] * n["w"], "heading_rate": n["w"]},
    "truth": lambda n, ts: Truth(sleigh_states(n, ts)), "names": ("x", "y", "heading", "heading_rate"),
    "parameters": lambda n: {"mass": n["m"], "inertia": n["inertia"], "offset": n["a"]},
}  # fmt: skip
FAMILIES = (
    _top("free-body", "a free rigid body with a quaternion", 0.0),
    _top("top", "a heavy unsymmetric top with a quaternion", 1.0),
    _robot("robot", "differential-drive robots through full headings", Robot),
    _robot("robot-ahead", "the same with a narrow domain of the heading", RobotAhead),
    Family(name="sleigh", what="Chaplygin's sleigh", scene=ChaplyginSleigh, **SLEIGH),
    Family(name="sleigh-ahead", what="the same with a narrow domain of the heading", scene=SleighAhead, **SLEIGH),
    Family(
        name="disc", what="rolling discs", scene=TiltingDisc, truth=_disc_truth, names=("x", "y", "yaw", "lean", "spin"),
        draw=lambda r: {"m": r.uniform(0.3, 3), "R": r.uniform(0.2, 0.8), "lean": r.uniform(-0.4, 0.4), "lean_rate": r.uniform(-0.3, 0.3),
                        "yaw_rate": r.uniform(-1, 1), "spin_rate": r.choice([-1, 1]) * r.uniform(6, 12), "span": r.uniform(0.5, 3)},
        start=lambda n: {k: n[k] for k in ("lean", "lean_rate", "yaw_rate", "spin_rate")}, parameters=lambda n: {"mass": n["m"], "radius": n["R"]}, slack=3.0,
    ),
    Family(
        name="upright-disc", what="an upright disc on circles, saved seldom and often", scene=VerticalDisc, names=("x", "y", "heading", "roll"),
        draw=lambda r: {"R": r.uniform(0.3, 1), "w": r.choice([-1, 1]) * r.uniform(0.5, 6), "p": r.uniform(-5, 5), "span": r.uniform(1, 8)},
        start=lambda n: {"heading_rate": n["w"], "roll_rate": n["p"]}, parameters=lambda n: {"radius": n["R"]},
        truth=_circles,
    ),
    _wagon("wagon", "a pendulum on a cart whose place is prescribed", Wagon, 28, asks=FEW),
    _wagon("carried-pendulum", "the same as a pose of time", CarriedPendulum, 28, asks=FEW),
    _wagon("wagon-sampled", "the same, prescribed by `jnp.interp`", SampledWagon, 28, slack=100.0, asks=FEW, single=False),
    _wagon("carried-sampled", "a pose by `jnp.interp`", SampledCarriedPendulum, 28, slack=100.0, asks=FEW, single=False),
)  # fmt: skip
