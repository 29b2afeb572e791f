"""MuJoCo and MJX: the disc as a thin cylinder in contact with a plane, elliptic friction cone, friction coefficient 1.

Contacts of MuJoCo are springs and regularised friction, so that a rolling disc sinks in and slips a little. Settings tried: time constants of the
contact down to five steps, `impratio` 100, the noslip pass, both kinds of integrator. Source: E. Todorov, T. Erez and Y. Tassa, IROS (2012) 5026.
"""

import functools

import numpy as np

from work_precision_cases import disc_body
from work_precision_cases.curve import Curve, Prepared, Solved
from work_precision_cases.problem import Problem

try:
    import mujoco
except ImportError:
    mujoco = None
try:
    from mujoco import mjx
except ImportError:
    mjx = None

MISSING = "{} cannot be imported, so it is not measured; `pip install {}`"
STEPS = (1e-3, 3.125e-4, 1e-4, 5e-5, 2e-5)  # s
STEPS_MJX = (1e-3, 3.125e-4, 1e-4)
HALF_THICKNESS = 1e-4  # m
_MODEL = """
<mujoco>
  <option timestep="{step}" integrator="{integrator}" cone="elliptic" impratio="{impratio}" noslip_iterations="{noslip}" noslip_tolerance="1e-14"
          solver="Newton" tolerance="1e-12" iterations="100" gravity="0 0 {gravity}"/>
  <default><geom condim="3" friction="1 0 0" solref="{reference}" solimp="0.999 0.9999 1e-4"/></default>
  <worldbody>
    <geom type="plane" size="0 0 1"/>
    <body><freejoint/>
      <inertial pos="0 0 0" mass="{mass}" diaginertia="{diametral} {axial} {diametral}"/>
      <geom type="cylinder" size="{radius} {half}" euler="90 0 0"/>
    </body>
  </worldbody>
</mujoco>
"""


def _model(problem: Problem, step: float, integrator: str, impratio: float, noslip: int, steps_per_constant: float):
    scene = problem.scene
    m, a = float(scene.mass), float(scene.radius)
    text = _MODEL.format(
        step=step, integrator=integrator, impratio=impratio, noslip=noslip, gravity=-float(scene.gravity), reference=f"{steps_per_constant * step} 1",
        mass=m, diametral=m * a**2 / 4, axial=m * a**2 / 2, radius=a, half=HALF_THICKNESS,
    )  # fmt: skip
    return mujoco.MjModel.from_xml_string(text)


def _start(problem: Problem):
    body = disc_body.start(problem)
    quaternion = np.zeros(4)
    mujoco.mju_mat2Quat(quaternion, body.rotation.ravel())
    return np.concatenate([body.centre, quaternion]), np.concatenate([body.velocity, body.rotation.T @ body.angular_velocity])


def _solved(problem: Problem, position, velocity, steps: int) -> Solved:
    rotation = np.zeros(9)
    mujoco.mju_quat2Mat(rotation, np.asarray(position[3:], float))
    rotation = rotation.reshape(3, 3)
    body = disc_body.Body(np.asarray(position[:3]), rotation, np.asarray(velocity[:3]), rotation @ np.asarray(velocity[3:]))
    q, u = disc_body.state(problem, body)
    return Solved(q=q, u=u, steps=float(steps), failed="" if np.all(np.isfinite(q)) else "not finite")


def _by_mujoco(integrator: str, **settings):
    def prepare(problem: Problem) -> Prepared:
        if mujoco is None:
            raise ImportError(MISSING.format("mujoco", "mujoco"))
        position, velocity = _start(problem)

        @functools.cache
        def made(step):
            model = _model(problem, step, integrator, **settings)
            return model, mujoco.MjData(model)

        def run(step: float):
            model, data = made(step)
            mujoco.mj_resetData(model, data)
            data.qpos[:], data.qvel[:] = position, velocity
            steps = round(problem.end / step)
            mujoco.mj_step(model, data, nstep=steps)
            return data.qpos.copy(), data.qvel.copy(), steps

        return Prepared(run, lambda raw: _solved(problem, *raw))

    return prepare


def _by_mjx(problem: Problem) -> Prepared:
    if mujoco is None or mjx is None:
        raise ImportError(MISSING.format("mujoco.mjx", "mujoco-mjx"))
    import jax
    import jax.numpy as jnp

    position, velocity = _start(problem)

    @functools.cache
    def made(step):
        # MJX has no noslip pass
        model = mjx.put_model(_model(problem, step, "Euler", impratio=100, noslip=0, steps_per_constant=5))
        data = mjx.make_data(model).replace(qpos=jnp.asarray(position), qvel=jnp.asarray(velocity))
        steps = round(problem.end / step)

        @jax.jit
        def run(data):
            end = jax.lax.fori_loop(0, steps, lambda _, d: mjx.step(model, d), data)
            return end.qpos, end.qvel

        return run, data, steps

    def run(step: float):
        compiled, data, steps = made(step)
        return (*map(np.asarray, compiled(data)), steps)

    return Prepared(run, lambda raw: _solved(problem, *raw))


def curves(problem: Problem, quick: bool) -> list[Curve]:
    """Of the disc only; `quick`: one integrator, two steps."""
    if problem.name != "tilting-disc":
        return []
    ways = {
        "MuJoCo, implicitfast": {"integrator": "implicitfast", "impratio": 100, "noslip": 0, "steps_per_constant": 5},
        "MuJoCo, implicitfast, noslip": {"integrator": "implicitfast", "impratio": 1, "noslip": 20, "steps_per_constant": 5},
        "MuJoCo, implicitfast, softer contact": {"integrator": "implicitfast", "impratio": 100, "noslip": 0, "steps_per_constant": 20},
        "MuJoCo, RK4": {"integrator": "RK4", "impratio": 100, "noslip": 0, "steps_per_constant": 5},
    }
    if quick:
        ways = {"MuJoCo, implicitfast": ways["MuJoCo, implicitfast"]}
    steps = (STEPS[2], STEPS[-1]) if quick else STEPS
    found = [Curve(name, "peer", steps, "step (s)", _by_mujoco(**way), ("mujoco",), "elliptic cone, thin cylinder in contact") for name, way in ways.items()]
    if quick:
        return found
    found.append(Curve("MJX, Euler", "peer", STEPS_MJX, "step (s)", _by_mjx, ("mujoco", "mujoco-mjx", "jax"), "elliptic cone, thin cylinder in contact"))
    return found
