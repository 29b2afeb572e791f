"""MuJoCo and MJX: the disc as a thin cylinder in contact with a plane, elliptic friction cone, friction
coefficient 1.

Contacts of MuJoCo are springs and regularised friction, so that a rolling disc sinks in and slips a little.
Time constants of the contact are five steps, `impratio` is 100, both kinds of integrator are measured.
Source: E. Todorov, T. Erez and Y. Tassa, IROS (2012) 5026.
"""

import functools

import disc_body
import jax
import jax.numpy as jnp
import numpy as np
from atlas_cases import elsewhere

from work_precision_cases.curve import Curve, Prepared, Solved

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


def _model(problem, step, **settings):
    """The model, and its state at the start."""
    scene = problem.scene
    made = elsewhere.rolling_disc(
        float(scene.mass), float(scene.radius), problem.minimal_start, step=step, **settings
    )
    return mujoco.MjModel.from_xml_string(made.model), made.start


def _solved(problem, position, velocity, steps) -> Solved:
    q, u = disc_body.state(
        float(problem.scene.radius), elsewhere.body_of(position, velocity), problem.truth.values
    )
    return Solved(q=q, u=u, steps=float(steps), failed="" if np.all(np.isfinite(q)) else "not finite")


def _by_mujoco(**settings):
    def prepare(problem) -> Prepared:
        if mujoco is None:
            raise ImportError(MISSING.format("mujoco", "mujoco"))

        @functools.cache
        def made(step):
            model, start = _model(problem, step, **settings)
            return model, mujoco.MjData(model), start

        def run(step):
            model, data, start = made(step)
            mujoco.mj_resetData(model, data)
            data.qpos[:], data.qvel[:] = start
            steps = round(problem.end / step)
            mujoco.mj_step(model, data, nstep=steps)
            return data.qpos.copy(), data.qvel.copy(), steps

        return Prepared(run, lambda raw: _solved(problem, *raw))

    return prepare


def _by_mjx(problem) -> Prepared:
    if mujoco is None or mjx is None:
        raise ImportError(MISSING.format("mujoco.mjx", "mujoco-mjx"))

    @functools.cache
    def made(step):
        model, start = _model(problem, step, integrator="Euler")
        model, (position, velocity) = mjx.put_model(model), map(jnp.asarray, start)
        data, steps = mjx.make_data(model).replace(qpos=position, qvel=velocity), round(problem.end / step)

        @jax.jit
        def run(data):
            end = jax.lax.fori_loop(0, steps, lambda _, d: mjx.step(model, d), data)
            return end.qpos, end.qvel

        return run, data, steps

    def run(step):
        compiled, data, steps = made(step)
        return (*map(np.asarray, compiled(data)), steps)

    return Prepared(run, lambda raw: _solved(problem, *raw))


def curves(problem, quick) -> list[Curve]:
    """Of the disc only; `quick`: one integrator, two steps."""
    if problem.name != "tilting-disc":
        return []
    ways = {"MuJoCo, implicitfast": {}, "MuJoCo, RK4": {"integrator": "RK4"}}
    steps, how = (
        (STEPS[2], STEPS[-1]) if quick else STEPS,
        {"setting_unit": "step (s)", "note": "elliptic cone, thin cylinder in contact"},
    )
    found = [Curve(name, steps, _by_mujoco(**way), ("mujoco",), **how) for name, way in ways.items()]
    mjx_curve = Curve("MJX, Euler", STEPS[:3], _by_mjx, ("mujoco", "mujoco-mjx", "jax"), **how)
    return found[:1] if quick else [*found, mjx_curve]
