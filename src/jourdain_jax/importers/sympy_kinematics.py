"""Poses of SymPy's bodies, and the additional coordinates that they need.

SymPy allows velocities that are unrelated to positions: a rolling disc with a contact point at rest, or a
wheel with a rate of rotation but no angle. Here velocities are the rates of poses. If SymPy's velocity
differs from the rate of the position, coordinates d are added whose rates are the difference,

    r = r(q) + d,   ddot = v(q, u) - dr/dt,

one for each inertial axis along which they differ at states that satisfy the constraints. Bodies with the
same difference share them. A frame that has an angular velocity about an axis of another frame, but no
orientation, gets an angle.

Values of SymPy expressions at random states reveal constants, rates of coordinates, and repeated constraints.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float

from jourdain_jax.calculus.reals import all_finite, largest
from jourdain_jax.importers.formulas import Formulas, sympy_package
from jourdain_jax.importers.sympy_system import MechanicalSystem

_STATES, _TRIES = 3, 40  # numerics: number of random states that are compared, and limit of tried states
_STEP = 1e-6  # numerics: of finite differences


@dataclass(frozen=True)
class Sample:
    """One state, with values and rates of expressions, by the name of their list."""

    leaves: dict[Any, float]
    values: dict[str, Float[np.ndarray, "_"]]
    rates: dict[str, Float[np.ndarray, "_"]]


def symbols_in(expressions: Iterable[Any]) -> set[Any]:
    """Return functions of time, their rates, and symbols in the expressions."""
    sympy = sympy_package()
    time = sympy.physics.mechanics.dynamicsymbols._t
    found: set[Any] = set()
    for expression in map(sympy.sympify, expressions):
        found |= (
            expression.atoms(sympy.core.function.AppliedUndef, sympy.Derivative) | expression.free_symbols
        )
    return {x for x in found if x.args == (time,) or x.is_Symbol or isinstance(x, sympy.Derivative)}


def sampled(
    system: MechanicalSystem, lists: Mapping[str, Iterable[Any]], rows: Iterable[Any] = ()
) -> list[Sample]:
    """Return the first random states at which all expressions are finite. Random speeds are projected onto
    the constraints `rows`, which are affine in the speeds.

    Constants keep the numbers given for them. Raises ValueError, with the name of a list, if there are too
    few such states.
    """
    named: dict[Any, list] = {name: list(expressions) for name, expressions in lists.items()}
    named[""] = [system.rates[q.diff(system.time)] for q in system.coordinates]
    kept = [system.resolved(row) for row in rows]
    expressions = [*kept, *(e for several in named.values() for e in several)]
    symbols = sorted(symbols_in(expressions) | {*system.coordinates, *system.speeds, system.time}, key=str)
    formulas, held = Formulas(named, symbols), Formulas({"rows": kept}, symbols)
    generator = np.random.default_rng(0)
    found: list[Sample] = []
    worst = ""
    for _ in range(_TRIES):
        drawn = generator.uniform(0.1, 0.9, len(symbols)) * generator.choice([-1.0, 1.0], len(symbols))
        leaves = {
            x: system.given.get(str(x), float(number)) for x, number in zip(symbols, drawn, strict=True)
        }
        if kept:
            leaves |= _meeting(
                affine(lambda at: held.numbers(at)["rows"], leaves, system.speeds), leaves, system.speeds
            )
        values = formulas.numbers(leaves)
        ahead, behind = (
            formulas.numbers(
                leaves
                | {q: leaves[q] + step * rate for q, rate in zip(system.coordinates, values[""], strict=True)}
                | {system.time: leaves[system.time] + step}
            )
            for step in (_STEP, -_STEP)
        )
        rates = {name: (ahead[name] - behind[name]) / (2 * _STEP) for name in values}
        infinite = [name for name in values if not all_finite([values[name], rates[name]])]
        if infinite:
            worst = infinite[0] or "rate of a coordinate"
            continue
        found.append(Sample(leaves, values, rates))
        if len(found) == _STATES:
            return found
    raise ValueError(
        f"the {worst} has no finite value at {_TRIES - _STATES + 1} of {_TRIES} random states; check its "
        "expressions and the values of its constants"
    )


def affine(
    values: Callable[[dict], np.ndarray], leaves: dict[Any, float], speeds: Sequence[Any]
) -> Float[np.ndarray, "rows columns"]:
    """Return `[A b]` of the affine function A u + b, computed by `values(leaves)` at rest and at a unit of
    each speed.
    """
    rest = leaves | dict.fromkeys(speeds, 0.0)
    b = values(rest)
    return np.stack([*(values(rest | {speed: 1.0}) - b for speed in speeds), b], axis=1)


def _meeting(
    both: Float[np.ndarray, "rows columns"], leaves: dict[Any, float], speeds: Sequence[Any]
) -> dict[Any, float]:
    """Return the nearest speeds that satisfy the constraints `both`; NaN if these are NaN."""
    u = np.array([leaves[speed] for speed in speeds])
    u = (
        u - np.linalg.pinv(both[:, :-1]) @ (both[:, :-1] @ u + both[:, -1])
        if all_finite(both)
        else u * np.nan
    )
    return dict(zip(speeds, map(float, u), strict=True))


_SAME = 1e-6  # numerics: relative tolerance of equal velocities


@dataclass(frozen=True)
class Pose:
    """The pose of a body: expressions in all coordinates, the time and constants."""

    name: str
    mass: Any
    inertia: Any | None  # 3x3, about the mass centre, body axes; None for a particle
    position: Any  # 3x1, inertial frame, from the origin
    orientation: Any | None  # 3x3, body to inertial frame
    centre: Any  # the point of SymPy
    frame: Any | None  # the frame of SymPy


def poses_of(system: MechanicalSystem) -> tuple[MechanicalSystem, list[Pose]]:
    """Return the system with any added coordinates, and the poses of its bodies."""
    poses: list[Pose] = []
    angles: dict[Any, tuple] = {}  # frame -> orientation, base frame, rotation relative to it
    for body in system.bodies:
        system, pose = _pose(system, body, angles)
        if pose is None:
            continue
        if pose.name in (known.name for known in poses):
            raise ValueError(f"two bodies are called `{pose.name}`; give each its own name")
        _check_angular_velocity(system, pose)
        poses.append(pose)
    if not poses:
        raise ValueError("the system of SymPy has no body with a mass that moves; give it at least one")
    return _moved(system, poses)


def _pose(system: MechanicalSystem, body, angles: dict[Any, tuple]) -> tuple[MechanicalSystem, Pose | None]:
    """Return the pose of a body at SymPy's position (zero if SymPy has none), or None if the body does not
    move or has no mass.
    """
    sympy = sympy_package()
    name = str(getattr(body, "name", body))  # `str` of a `Particle` of SymPy 1.12 is its name
    # a `Body` of SymPy may be a particle
    rigid = isinstance(body, sympy.physics.mechanics.RigidBody) and getattr(body, "is_rigidbody", True)
    # SymPy inserts such bodies into joints with several axes
    if body.mass == 0 and not (rigid and body.central_inertia != 0):
        return system, None
    orientation = inertia = frame = None
    if rigid:
        frame = body.frame
        try:
            orientation = system.frame.dcm(frame)
        except ValueError:
            if frame not in angles:
                system, angles[frame] = _by_an_angle(system, frame)
            orientation = angles[frame][0]
        what = f"inertia of body `{name}` in its own frame `{frame}`"
        inertia = _constant(system, _in_own_frame(body, name, angles.get(frame)), what)
    centre = body.masscenter if hasattr(body, "masscenter") else body.point
    try:
        position = system.resolved(centre.pos_from(system.origin).to_matrix(system.frame))
    except ValueError:
        position = sympy.zeros(3, 1)
    if system.is_constant(position) and (orientation is None or system.is_constant(orientation)):
        return system, None
    mass = system.resolved(body.mass)
    if not system.is_constant(mass):
        raise ValueError(f"the mass of body `{name}` is `{mass}`, which changes in time; expected a constant")
    return system, Pose(name, mass, inertia, position, orientation, centre, frame)


def _in_own_frame(body, name: str, angle: tuple | None):
    """Return the inertia about the mass centre, along the axes of the body."""
    ways = [(body.frame, None)] if angle is None else [(body.frame, None), angle[1:]]
    for frame, turn in ways:
        try:
            matrix = body.central_inertia.to_matrix(frame)
        except ValueError:  # the frames have no known relative orientation
            continue
        return matrix if turn is None else turn.T * matrix * turn
    stated = (
        f"the inertia of body `{name}` is stated in a frame without orientation in its own frame "
        f"`{body.frame}`"
    )
    raise ValueError(f"{stated}; orient that frame, or state the inertia in `{body.frame}`")


def _by_an_angle(system: MechanicalSystem, frame) -> tuple[MechanicalSystem, tuple]:
    """Return the system with an added angle for a frame without orientation, and that frame's orientation,
    base frame and rotation relative to the base.
    """
    sympy = sympy_package()
    for parent, velocity in frame._ang_vel_dict.items():
        try:
            base = system.frame.dcm(parent)
        except ValueError:
            continue
        rates = system.resolved(velocity.to_matrix(parent))
        along = [axis for axis in range(3) if rates[axis] != 0]
        if len(along) == 1:
            angle = sympy.physics.mechanics.dynamicsymbols(f"{frame.name}_angle")
            turn = (sympy.rot_ccw_axis1, sympy.rot_ccw_axis2, sympy.rot_ccw_axis3)[along[0]](angle)
            return system.with_coordinates({angle: rates[along[0]]}), (base * turn, parent, turn)
    raise ValueError(
        f"frame `{frame.name}` has no orientation in `{system.frame.name}`, and does not turn about a single "
        "axis of an oriented frame; orient it by coordinates, such as `orient_axis(parent, parent.y, angle)`"
    )


def _constant(system: MechanicalSystem, matrix, what: str):
    """Return the matrix without coordinates. Raises ValueError if its value depends on them."""
    sympy = sympy_package()
    matrix = system.resolved(matrix)
    if system.is_constant(matrix):
        return matrix
    still = matrix.xreplace(
        dict.fromkeys([*matrix.atoms(sympy.core.function.AppliedUndef), system.time], sympy.S.Zero)
    )
    for sample in sampled(system, {what: matrix, f"{what}, at zero": still}):
        moving, zero = (sample.values[name] for name in (what, f"{what}, at zero"))
        if largest(moving - zero) > _SAME * largest(zero):
            raise ValueError(
                f"the {what} changes in time, so the body is not rigid; state it in the frame of the body"
            )
    return still


def _check_angular_velocity(system: MechanicalSystem, pose: Pose) -> None:
    """Raise ValueError if SymPy's angular velocity is not the rate of the orientation."""
    if pose.frame is None:
        return
    name, stated = f"orientation of body `{pose.name}`", f"angular velocity of body `{pose.name}`"
    lists = {
        name: pose.orientation,
        stated: system.resolved(pose.frame.ang_vel_in(system.frame).to_matrix(system.frame)),
    }
    for sample in sampled(system, lists):
        S = sample.rates[name].reshape(3, 3) @ sample.values[name].reshape(3, 3).T
        omega = np.array([S[2, 1], S[0, 2], S[1, 0]])
        if largest(omega - sample.values[stated]) > _SAME * (1.0 + largest(omega)):
            raise ValueError(
                f"frame `{pose.frame.name}` has an angular velocity that disagrees with its orientation; "
                "check the kinematic equations, or let `orient_axis` and similar methods define the angular "
                "velocity"
            )


def _moved(system: MechanicalSystem, poses: list[Pose]) -> tuple[MechanicalSystem, list[Pose]]:
    """Return poses whose positions have SymPy's velocities as rates, and the system with any coordinates that
    this requires.
    """
    sympy = sympy_package()
    stated = [system.resolved(pose.centre.vel(system.frame).to_matrix(system.frame)) for pose in poses]
    places, speeds = (
        [f"{what} of body `{pose.name}`" for pose in poses] for what in ("position", "velocity")
    )
    lists = dict(zip(places, [pose.position for pose in poses], strict=True)) | dict(
        zip(speeds, stated, strict=True)
    )
    samples = sampled(system, lists, (*system.velocity, *system.rates_of_configuration()))
    missing = []  # by body: stated velocity minus rate of the position, at all samples
    for place, speed in zip(places, speeds, strict=True):
        velocities = np.array([sample.values[speed] for sample in samples])
        difference = velocities - np.array([sample.rates[place] for sample in samples])
        missing.append(np.where(np.abs(difference) > _SAME * (1.0 + largest(velocities)), difference, 0.0))
    leaders = [
        next(j for j in range(k + 1) if np.allclose(missing[j], missing[k], atol=_SAME))
        for k in range(len(poses))
    ]
    taken = {str(x.func) for x in (*system.coordinates, *system.speeds)}
    added: dict[Any, Any] = {}
    new = list(poses)
    for leader in sorted(set(leaders)):
        group = [k for k, first in enumerate(leaders) if first == leader]
        label = system.origin.name if len(group) == len(poses) else poses[leader].centre.name
        simplest = min(group, key=lambda k: sympy.count_ops(poses[k].position) + sympy.count_ops(stated[k]))
        shift = sympy.zeros(3, 1)
        for axis in np.flatnonzero(np.any(missing[leader], axis=0)).tolist():
            name = f"{label}_{'xyz'[axis]}"
            shift[axis] = sympy.physics.mechanics.dynamicsymbols(f"path_{name}" if name in taken else name)
            added[shift[axis]] = stated[simplest][axis] - poses[simplest].position[axis].diff(system.time)
        for k in group:
            new[k] = replace(poses[k], position=poses[k].position + shift)
    return system.with_coordinates(added), new
