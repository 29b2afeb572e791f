"""Check each body, load, potential and constraint that a scene defines. A failed check names the wrong one.

inertia        m >= 0,  I = I' >= 0,  I_3 <= I_1 + I_2,  R'R = 1      per body
               e.e = 1                                                per gravity
potentials     Z' (Q_i + N' dV_i/dq) = 0                              per load i with a potential V_i
derivatives    d/ds of each quantity along one direction in (parameters, t, q, u): autodiff agrees with
               central differences, and there is no kink
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jourdain_jax.analysis.derivative_checks import along, central_difference
from jourdain_jax.analysis.verification import Check, check
from jourdain_jax.calculus.reals import Scalar, largest, tiny_of
from jourdain_jax.equations.kinematics import (
    coordinate_rates,
    motion_at,
    of_bodies,
    partial_velocities,
    pose_at,
)
from jourdain_jax.equations.rows import position_rows, velocity_rows
from jourdain_jax.equations.virtual_power import resultants
from jourdain_jax.program.eager import eval_numpy
from jourdain_jax.scene.bodies import RigidBody
from jourdain_jax.scene.loads import Gravity, Load
from jourdain_jax.scene.motion_state import Motion
from jourdain_jax.scene.scene import Scene
from jourdain_jax.scene.user_methods import loads_of, potential_of


def statement_checks(
    scene: Scene, t, q, u, inputs, Z: Float[Array, "speeds columns"], seed: int
) -> list[Check]:
    """Return the checks of inertia, potentials and derivatives. `Z` spans the admissible speeds."""
    inertia, potentials = _evaluate(scene, t, q, u, inputs, Z)
    return [
        check("inertia", inertia, q.dtype),
        check("potentials", potentials, q.dtype),
        _derivatives(scene, t, q, u, inputs, seed),
    ]


@eval_numpy
def _evaluate(scene: Scene, t, q, u, inputs, Z) -> tuple[dict, dict]:
    motion = motion_at(scene, t, q, u, inputs)
    return _inertia(motion) | _gravity(scene, motion), _potentials(scene, motion, Z)


def _inertia(motion: Motion) -> dict[str, Scalar]:
    values = {}
    for name, moving in motion.bodies.items():
        body = moving.body
        values[f"body `{name}`: its mass is negative"] = jnp.maximum(-body.mass, 0.0) / jnp.maximum(
            jnp.abs(body.mass), tiny_of(body.mass)
        )
        if not isinstance(body, RigidBody):
            continue
        size = largest(body.inertia) + tiny_of(body.inertia)
        moments = jnp.linalg.eigvalsh((body.inertia + body.inertia.T) / 2)
        values[f"body `{name}`: its inertia is not symmetric"] = largest(body.inertia - body.inertia.T) / size
        values[f"body `{name}`: a principal moment of inertia is negative"] = (
            jnp.maximum(-moments[0], 0.0) / size
        )
        excess = jnp.where(moments[0] >= 0, jnp.maximum(moments[2] - moments[0] - moments[1], 0.0), 0.0)
        values[f"body `{name}`: a principal moment of inertia exceeds the sum of the other two"] = (
            excess / size
        )
        values[f"body `{name}`: its orientation is not a rotation matrix"] = largest(
            body.orientation.T @ body.orientation - jnp.eye(3)
        )
    return values


def _gravity(scene: Scene, motion: Motion) -> dict[str, Scalar]:
    directions = {
        _name(i, load): load.direction
        for i, load in enumerate(loads_of(scene, motion))
        if isinstance(load, Gravity)
    }
    return {
        f"{name}: its direction is not a unit vector": jnp.abs(jnp.linalg.norm(e) - 1)
        for name, e in directions.items()
    }


def _potentials(scene: Scene, motion: Motion, Z) -> dict[str, Scalar]:
    t, q, u, inputs = motion.t, motion.q.array, motion.u.array, motion.inputs.array
    loads = loads_of(scene, motion)
    stated = [i for i, load in enumerate(loads) if load.potential is not None]
    if not stated:
        return {}

    def V(q):
        at = loads_of(scene, motion_at(scene, t, q, u, inputs))
        return jnp.stack([at[i].potential for i in stated])

    dV = jax.jacfwd(V)(q) @ jax.jacfwd(lambda u: coordinate_rates(scene, t, q, u))(u)
    partial, turned = partial_velocities(scene, t, q, u), of_bodies(motion, "orientation")
    values = {}
    for i, slope in zip(stated, dV, strict=True):
        total = resultants(scene, motion, loads=(loads[i],))
        # Q = beta' F + gamma' L + Q_direct
        Q = (
            jnp.einsum("bik,bi->k", partial.linear, total.force)
            + jnp.einsum("bik,bji,bj->k", partial.angular, turned, total.torque)
            + total.direct
        )
        size = largest(Q) + largest(slope) + tiny_of(q)
        values[f"{_name(i, loads[i])}: its potential does not give its force"] = (
            largest(Z.T @ (Q + slope)) / size
        )
    return values


def _name(i: int, load: Load) -> str:
    on = dict.fromkeys([*load.forces, *load.torques, *load.generalized])
    return f"load {i + 1}" + (f" (on {', '.join(f'`{name}`' for name in on)})" if on else "")


def _pieces(scene: Scene, t, q, u, inputs) -> dict[str, Array]:
    """Return all quantities that the scene defines at (t, q, u), by subject."""
    # `pose_at`, because poses in a motion are differentiated already, which may bypass a custom derivative
    # rule
    motion, pose = motion_at(scene, t, q, u, inputs), pose_at(scene, t, q)
    pieces = {"the coordinate rates": coordinate_rates(scene, t, q, u)}
    for name, placed in pose.bodies.items():
        body = placed.body
        pieces |= {f"body `{name}`: its mass": body.mass, f"body `{name}`: its position": body.position}
        if isinstance(body, RigidBody):
            pieces |= {
                f"body `{name}`: its inertia": body.inertia,
                f"body `{name}`: its orientation": body.orientation,
            }
    for i, load in enumerate(loads_of(scene, motion)):
        for kind, part in (("force", load.forces), ("torque", load.torques), ("force", load.generalized)):
            pieces |= {f"{_name(i, load)}: its {kind} on `{name}`": value for name, value in part.items()}
        if load.potential is not None:
            pieces[f"{_name(i, load)}: its potential"] = load.potential
    potential = potential_of(scene, pose)
    if potential is not None:
        pieces["the scene's `potential`"] = jnp.asarray(potential)
    pieces |= {f"constraint `{name}`": value for name, value in velocity_rows(scene, motion).items()}
    return pieces | {
        f"position of constraint `{name}`": value for name, value in position_rows(scene, pose).items()
    }


def _derivatives(scene: Scene, t, q, u, inputs, seed: int) -> Check:
    generator = np.random.default_rng(seed)
    # in SI units; for smaller quantities, round-off dominates the differences
    floor = 1e-2 if q.dtype == jnp.float32 else 1e-4
    moving, fixed = eqx.partition(scene, eqx.is_inexact_array)
    draw = lambda x: jnp.asarray(generator.normal(size=x.shape), x.dtype)
    direction = (
        jax.tree.map(lambda x: draw(x) * jnp.where(x == 0, 1.0, x), moving),
        jnp.ones_like(t),
        draw(q),
        draw(u),
    )
    point = (moving, t, q, u)
    value, change, around, h = along(_at, (fixed, inputs), point, direction, u)
    values = {}
    for name in value:
        f = np.asarray(value[name])
        slope = np.asarray(change[name])
        ends = [np.asarray(x[name]) for x in around]
        # 2 s(h) - s(2h) with s(h) = (f(h) - 2 f(0) + f(-h))/h: of third order if f is smooth; at a kink, the
        # jump of the slope
        kink = (2 * (ends[1] + ends[2]) - 4 * f) / h - (ends[0] + ends[3] - 2 * f) / (2 * h)
        size = largest(f) + largest(slope) + floor
        # weight 1e-3: the jump at a kink is of order one, and its estimate is less accurate than the
        # difference
        error = np.maximum(np.abs(slope - central_difference(ends, h)), 1e-3 * np.abs(kink))
        values[f"{name}: its derivative"] = np.max(error, initial=0.0) / size
    return check("derivatives", values, q.dtype)


def _at(arguments, point) -> dict[str, Array]:
    (fixed, inputs), (parameters, t, q, u) = arguments, point
    return _pieces(eqx.combine(parameters, fixed), t, q, u, inputs)
