"""Cases put to another engine, MuJoCo, as its documentation advises: joints where it has them, `connect` for
loops, elliptic friction cones for rolling.

Free joints have the coordinates of our scenes: position, quaternion, velocity in space, angular velocity in
the body. Steps of the fourth order (RK4) where there is no contact, `implicitfast` where there is. Source: E.
Todorov, T. Erez and Y. Tassa, IROS (2012) 5026.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from disc_body import Body, start
from scipy.spatial.transform import Rotation

try:
    import mujoco
except ImportError:
    mujoco = None

MISSING = "`mujoco` is not installed"
_HEAD = '<mujoco><option timestep="{step}" integrator="{integrator}" gravity="0 0 {gravity}" {more}/>'
_FREE = (
    '<worldbody>{ground}<body><freejoint/><inertial pos="0 0 0" mass="{mass}"'
    ' diaginertia="{inertia}"/>{shape}</body></worldbody></mujoco>'
)
_ROLLING = (
    '<default><geom condim="3" friction="1 0 0" solref="{reference} 1" solimp="0.999 0.9999 1e-4"/></default>'
)
_GROUND = '<geom type="plane" size="0 0 1"/>'


@dataclass(frozen=True)
class Elsewhere:
    """A model, its state at the start, and how to read our q and u; `push(t)`: applied to the first freedom,
    N or N m.
    """

    model: str
    step: float  # s
    start: tuple  # qpos, qvel
    read: Callable = lambda data: (data.qpos.copy(), data.qvel.copy())
    push: Callable | None = None

    def run(self, ts, t0=0.0):
        """q and u at the times, each reached by steps of equal length; NaN where the engine reports a bad
        state.
        """
        model = mujoco.MjModel.from_xml_string(self.model)
        data, found = mujoco.MjData(model), []
        data.qpos[:], data.qvel[:] = self.start
        data.time = t0
        mujoco.mj_forward(model, data)
        for before, t in zip((t0, *ts[:-1]), ts, strict=True):
            steps = max(round((t - before) / self.step), 1) if t > before else 0
            model.opt.timestep = (t - before) / max(steps, 1) or self.step
            if self.push is None:
                mujoco.mj_step(model, data, nstep=steps)
            else:
                for k in range(steps):
                    data.qfrc_applied[0] = self.push(before + k * model.opt.timestep)
                    mujoco.mj_step(model, data)
            mujoco.mj_forward(model, data)
            bad = (getattr(mujoco.mjtWarning, f"mjWARN_BADQ{kind}") for kind in ("POS", "VEL", "ACC"))
            lost = np.nan if any(data.warning[kind].number for kind in bad) else 0.0
            found.append([part + lost for part in self.read(data)])
        return tuple(np.array(part) for part in zip(*found, strict=True))


def free_body(mass, inertia, q, u) -> Elsewhere:
    """A body on which nothing acts."""
    body = _FREE.format(ground="", mass=mass, inertia=_numbers(inertia), shape="")
    return Elsewhere(_head(1e-3, 0) + body, 1e-3, (q, u))


def _head(step, gravity, more="", integrator="RK4"):
    return _HEAD.format(step=step, integrator=integrator, gravity=gravity, more=more)


def rolling(mass, inertia, shape, q, u, *, step=1e-4, integrator="implicitfast") -> Elsewhere:
    """A body that rolls on a plane; friction coefficient 1, time constant of the contact five steps, as short
    as it may be.
    """
    head = _head(step, -9.81, 'cone="elliptic" impratio="100" tolerance="1e-12" iterations="100"', integrator)
    body = _FREE.format(ground=_GROUND, mass=mass, inertia=_numbers(inertia), shape=shape)
    return Elsewhere(head + _ROLLING.format(reference=5 * step) + body, step, (q, u))


def rolling_disc(mass, radius, minimal, **settings) -> Elsewhere:
    """A thin cylinder about body y, from a start as in `disc_body`."""
    body = start(radius, minimal)
    shape = f'<geom type="cylinder" size="{radius} 1e-4" euler="90 0 0"/>'
    q = [*body.centre, *Rotation.from_matrix(body.rotation).as_quat(scalar_first=True)]
    u = [*body.velocity, *(body.rotation.T @ body.angular_velocity)]
    return rolling(mass, mass * radius**2 * np.array([0.25, 0.5, 0.25]), shape, q, u, **settings)


def body_of(position, velocity) -> Body:
    """The body of a free joint."""
    position, velocity = np.asarray(position, float), np.asarray(velocity, float)
    rotation = Rotation.from_quat(position[3:], scalar_first=True).as_matrix()
    return Body(position[:3], rotation, velocity[:3], rotation @ velocity[3:])


def ball_shape(radius, middle):
    """A ball about `middle`."""
    return f'<geom type="sphere" size="{radius}" pos="{_numbers(middle)}"/>'


def four_bar(lengths, masses, gravity, start, read) -> Elsewhere:
    """Crank, coupler on it, and rocker on the ground, hinged about -y (angles from x towards z); `connect`
    closes the loop. `start`: a, b, c and rates.
    """
    (r1, r2, r3, d), (m1, m2, m3) = lengths, masses
    (a, b, c), (da, db, dc) = start
    head = _head(1e-4, -gravity, 'tolerance="1e-12" iterations="100"')
    hinge, site = '<joint type="hinge" axis="0 -1 0"/>', '<site name="{}" pos="{} 0 0"/>'
    coupler = f'<body pos="{r1} 0 0">{hinge}{_rod(m2, r2)}{site.format("end", r2)}</body>'
    rocker = f'<body pos="{d} 0 0">{hinge}{_rod(m3, r3)}{site.format("pin", r3)}</body>'
    bodies = f"<worldbody><body>{hinge}{_rod(m1, r1)}{coupler}</body>{rocker}</worldbody>"
    text = (
        f'{head}{bodies}<equality><connect site1="end" site2="pin" solref="5e-4 1" solimp="0.999 0.9999'
        ' 1e-4"/></equality></mujoco>'
    )
    return Elsewhere(text, 1e-4, ([a, b - a, c], [da, db - da, dc]), read)


def angles(data):
    """a, b, c of crank, coupler and rocker, and their rates."""
    (a, b, c), (da, db, dc) = data.qpos, data.qvel
    return np.array([a, a + b, c]), np.array([da, da + db, dc])


def ends_of_cranks(data):
    """x and z of the ends of two cranks of 1 m that stand 1 m apart, and their rates."""
    (a, _, c), (da, _, dc) = data.qpos, data.qvel
    q = np.array([np.cos(a), np.sin(a), 1 + np.cos(c), np.sin(c)])
    return q, np.array([-np.sin(a) * da, np.cos(a) * da, -np.sin(c) * dc, np.cos(c) * dc])


def pendulum(length, mass, speed) -> Elsewhere:
    """A particle on a hinge, in x and z."""
    head = _head(1e-4, -9.81)
    bob = f'<inertial pos="0 0 {-length}" mass="{mass}" diaginertia="1e-12 1e-12 1e-12"/>'
    text = f'{head}<worldbody><body><joint type="hinge" axis="0 -1 0"/>{bob}</body></worldbody></mujoco>'

    def read(data):
        (a,), (w,) = data.qpos, data.qvel
        s, c = length * np.sin(a), length * np.cos(a)
        return np.array([s, -c]), np.array([c * w, s * w])

    return Elsewhere(text, 1e-4, ([0.0], [speed / length]), read)


def oscillator(stiffness, x, v, step, push=None) -> Elsewhere:
    """A block of 1 kg on a spring."""
    slide = f'<joint type="slide" axis="1 0 0" stiffness="{stiffness}"/>'
    block = f'<body>{slide}<inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/></body>'
    text = f"{_head(step, 0)}<worldbody>{block}</worldbody></mujoco>"
    return Elsewhere(text, step, ([x], [v]), push=push)


def _rod(mass, length):
    turned = mass * length**2 / 12
    return f'<inertial pos="{length / 2} 0 0" mass="{mass}" diaginertia="{turned * 1e-3} {turned} {turned}"/>'


def _numbers(values):
    return " ".join(f"{float(v)!r}" for v in values)
