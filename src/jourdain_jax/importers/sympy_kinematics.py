"""Poses of SymPy's bodies, and the coordinates that they need besides those of SymPy.

SymPy lets velocities be stated apart from positions: a rolling disc whose contact point rests, a wheel that turns at a speed without having an angle. Here
velocities are the rates of poses. Where both disagree, coordinates are added whose rates make up the difference,

    r = r(q) + d,   ddot = v(q, u) - dr/dt,

one for each axis of the inertial frame along which there is one while the rows are met, shared by the bodies that it moves
alike; and an angle for a frame that has an angular velocity about an axis of another frame, but no orientation.
"""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float

from jourdain_jax.importers.formulas import Formulas, sympy_package
from jourdain_jax.importers.sympy_system import MechanicalSystem

STATES = 3  # random ones, at which expressions are compared
_TRIES = 40
_STEP = 1e-6  # of differences
_SAME = 1e-6  # of two velocities, relative


@dataclass(frozen=True)
class Pose:
    """Where a body is: expressions in all coordinates, the time and constants."""

    name: str
    mass: Any
    inertia: Any | None  # 3x3, about the mass centre, body axes; None for a particle
    position: Any  # 3x1, inertial frame, from the origin
    orientation: Any | None  # 3x3, body to inertial frame
    centre: Any  # the point of SymPy
    frame: Any | None  # the frame of SymPy


class RandomStates:
    """Numbers for all symbols of a system, `STATES` times: those that are no constants are random."""

    def __init__(self, constants: Mapping[str, float]):
        """The values of the `constants` by name; those that are not given are random, too."""
        self._constants = constants
        self._known: list[dict[Any, float]] = [{} for _ in range(_TRIES)]
        self._generator = np.random.default_rng(0)

    def _leaves(self, symbols: Iterable[Any]) -> list[dict[Any, float]]:
        """As many assignments as are tried, with a number for each of the symbols."""
        for symbol in sorted(set(symbols) - self._known[0].keys(), key=str):
            given = self._constants.get(str(symbol))
            for known in self._known:
                drawn = float(self._generator.uniform(0.1, 0.9)) * float(self._generator.choice([-1.0, 1.0]))
                known[symbol] = drawn if given is None else given
        return self._known

    def numbers(self, lists: dict[str, list], what: str) -> list[dict[str, np.ndarray]]:
        """The values of expressions at the first states where all are finite. ValueError, with `what` they belong to, where there are too few."""
        symbols = symbols_in(expression for expressions in lists.values() for expression in expressions)
        return self.finite(symbols, Formulas(lists, list(symbols)).numbers, what)

    def finite(self, symbols: Iterable[Any], numbers: Callable[[dict], dict[str, np.ndarray]], what: str) -> list[dict[str, np.ndarray]]:
        """What `numbers` gives at the first states where all of it is finite. ValueError, with `what` it belongs to, where there are too few."""
        found = []
        for leaves in self._leaves(symbols):
            values = numbers(leaves)
            if all(np.isfinite(x).all() for x in values.values()):
                found.append(values)
            if len(found) == STATES:
                return found
        raise ValueError(
            f"{what} has no finite value at {_TRIES - STATES + 1} of {_TRIES} random states; check its expressions and the values of its constants"
        )


class AffineRows:
    """Rows `A u + b` as numbers at random states."""

    def __init__(self, system: MechanicalSystem, rows: Iterable[Any]):
        """The `rows` as expressions."""
        sympy = sympy_package()
        expressions = [system.resolved(sympy.sympify(row)) for row in rows]
        self.speeds, self.symbols = system.speeds, symbols_in(expressions) | set(system.speeds)
        columns = [*([row.diff(speed) for row in expressions] for speed in self.speeds), [row.subs(dict.fromkeys(self.speeds, 0)) for row in expressions]]
        self._formulas = Formulas({str(k): column for k, column in enumerate(columns)}, list(self.symbols))

    def coefficients(self, leaves: dict[Any, float]) -> Float[np.ndarray, "rows columns"]:
        """`[A b]`: the values at rest, and what each speed adds."""
        return np.stack(list(self._formulas.numbers(leaves).values()), axis=1)

    def met(self, leaves: dict[Any, float]) -> dict[Any, float]:
        """The nearest speeds at which the rows vanish, with all else; NaN where there are no numbers."""
        both, u = self.coefficients(leaves), np.array([leaves[speed] for speed in self.speeds])
        if not both.size:
            return leaves
        u = u - np.linalg.pinv(both[:, :-1]) @ (both[:, :-1] @ u + both[:, -1]) if np.isfinite(both).all() else u * np.nan
        return leaves | dict(zip(self.speeds, map(float, u), strict=True))


def symbols_in(expressions: Iterable[Any]) -> set[Any]:
    """Functions of time, rates of these, and symbols in some expressions."""
    sympy = sympy_package()
    time = sympy.physics.mechanics.dynamicsymbols._t
    found: set[Any] = set()
    for expression in map(sympy.sympify, expressions):
        functions = expression.atoms(sympy.core.function.AppliedUndef, sympy.Derivative)
        found |= functions | expression.free_symbols
    return {x for x in found if x.args == (time,) or x.is_Symbol or isinstance(x, sympy.Derivative)}


def poses_of(system: MechanicalSystem, states: RandomStates) -> tuple[MechanicalSystem, list[Pose]]:
    """The bodies, and the system with the coordinates that were added."""
    system, poses = _oriented(system, states)
    for pose in poses:
        _check_angular_velocity(system, states, pose)
    return _moved(system, states, poses)


def _weighs(body) -> bool:
    """Whether a body has mass or inertia; SymPy's joints of several axes put bodies without any in between."""
    return body.mass != 0 or (is_rigid(body) and body.central_inertia != 0)


def is_rigid(body) -> bool:
    """Whether SymPy's body is a rigid one; its `Body` may be a particle."""
    mechanics = sympy_package().physics.mechanics
    return isinstance(body, mechanics.RigidBody) and getattr(body, "is_rigidbody", True)


def centre_of(body):
    """The point of SymPy that is the mass centre of a body."""
    return body.masscenter if hasattr(body, "masscenter") else body.point


def _oriented(system: MechanicalSystem, states: RandomStates) -> tuple[MechanicalSystem, list[Pose]]:
    """Poses with orientations, and positions as SymPy has them (zero where it has none)."""
    sympy = sympy_package()
    poses: list[Pose] = []
    angles: dict[Any, tuple] = {}  # frame -> its orientation
    for body in filter(_weighs, system.bodies):
        name = str(getattr(body, "name", body))  # a `Particle` of SymPy 1.12 has its name as its text
        if name in (pose.name for pose in poses):
            raise ValueError(f"two bodies are called `{name}`; give each a name of its own")
        centre = centre_of(body)
        orientation = inertia = frame = None
        if is_rigid(body):
            frame = body.frame
            try:
                orientation = system.frame.dcm(frame)
            except ValueError:
                if frame not in angles:
                    system, angles[frame] = _by_an_angle(system, frame)
                orientation = angles[frame][0]
            inertia = _in_own_frame(body, angles.get(frame))
            inertia = _constant(system, states, inertia, f"the inertia of body `{name}` in its own frame `{frame}`")
        try:
            position = centre.pos_from(system.origin).to_matrix(system.frame)
        except ValueError:
            position = sympy.zeros(3, 1)
        position = system.resolved(position)
        if system.is_constant(position) and (orientation is None or system.is_constant(orientation)):
            continue  # it does not move
        mass = system.resolved(sympy.sympify(body.mass))
        if not system.is_constant(mass):
            raise ValueError(f"the mass of body `{name}` is `{mass}`, which changes in time; expected constants")
        poses.append(Pose(name, mass, inertia, position, orientation, centre, frame))
    if not poses:
        raise ValueError("the system of SymPy has no body with a mass that moves; give it at least one")
    return system, poses


def _in_own_frame(body, angle: tuple | None):
    """The central inertia along the axes of the body."""
    ways = [(body.frame, None)] if angle is None else [(body.frame, None), angle[1:]]
    for frame, turn in ways:
        try:
            matrix = body.central_inertia.to_matrix(frame)
        except ValueError:  # SymPy knows no orientation between the frames
            continue
        return matrix if turn is None else turn.T * matrix * turn
    stated = f"the inertia of body `{getattr(body, 'name', body)}` is stated in a frame that has no orientation in its own frame `{body.frame}`"
    raise ValueError(f"{stated}; orient that frame, or state the inertia in `{body.frame}`")


def _by_an_angle(system: MechanicalSystem, frame) -> tuple[MechanicalSystem, tuple]:
    """An angle for a frame without orientation: its orientation, the frame that it turns in, and its turn there."""
    sympy = sympy_package()
    for parent, velocity in frame._ang_vel_dict.items():
        try:
            base = system.frame.dcm(parent)
        except ValueError:
            continue
        rates = system.resolved(velocity.to_matrix(parent))
        along = [axis for axis in range(3) if rates[axis] != 0]
        if len(along) != 1:
            continue
        angle = sympy.physics.mechanics.dynamicsymbols(f"{frame.name}_angle")
        turn = (sympy.rot_ccw_axis1, sympy.rot_ccw_axis2, sympy.rot_ccw_axis3)[along[0]](angle)
        return system.with_coordinates({angle: rates[along[0]]}), (base * turn, parent, turn)
    raise ValueError(
        f"frame `{frame.name}` has no orientation in `{system.frame.name}`, nor an angular velocity about one axis of a frame that has; "
        "orient it by coordinates, such as `orient_axis(parent, parent.y, angle)`"
    )


def _constant(system: MechanicalSystem, states: RandomStates, matrix, what: str):
    """The matrix without coordinates, on which its value does not depend. ValueError where it does."""
    sympy = sympy_package()
    matrix = system.resolved(matrix)
    if system.is_constant(matrix):
        return matrix
    still = matrix.xreplace(dict.fromkeys(matrix.atoms(sympy.core.function.AppliedUndef), sympy.S.Zero)).xreplace({system.time: sympy.S.Zero})
    for found in states.numbers({"moving": list(matrix), "still": list(still)}, what):
        if np.max(np.abs(found["moving"] - found["still"])) > _SAME * np.max(np.abs(found["still"])):
            raise ValueError(f"{what} changes in time, so that it is no rigid body; state it in the frame of the body")
    return still


def _check_angular_velocity(system: MechanicalSystem, states: RandomStates, pose: Pose) -> None:
    """A ValueError where the stated angular velocity is not the rate of the orientation."""
    if pose.frame is None or pose.orientation is None:
        return
    stated = list(system.resolved(pose.frame.ang_vel_in(system.frame).to_matrix(system.frame)))
    name = f"the orientation of body `{pose.name}`"
    for values in _along_the_motion(system, states, {"R": list(pose.orientation)}, {"omega": stated}, name):
        R, Rdot = values["R"].reshape(3, 3), values["R rate"].reshape(3, 3)
        S = Rdot @ R.T
        omega = np.array([S[2, 1], S[0, 2], S[1, 0]])
        if np.max(np.abs(omega - values["omega"])) > _SAME * (1.0 + np.max(np.abs(omega))):
            raise ValueError(
                f"frame `{pose.frame.name}` has another angular velocity than its orientation changes by; "
                "check the kinematic equations, or state the angular velocity by `orient_axis` and its like alone"
            )


def _along_the_motion(system: MechanicalSystem, states: RandomStates, positions: dict, speeds: dict, what: str, rows: AffineRows | None = None):
    """Values of expressions at random states that meet the `rows`, and there, as "r rate", the rates of those in `positions`, by differences."""
    rates = [system.rates[q.diff(system.time)] for q in system.coordinates]
    lists = positions | speeds | {"rates": rates}
    symbols = symbols_in(e for expressions in lists.values() for e in expressions) | set(system.coordinates)
    formulas = Formulas(lists, list(symbols))

    def numbers(leaves):
        leaves = leaves if rows is None else rows.met(leaves)
        here = formulas.numbers(leaves)
        forward, back = (
            formulas.numbers(
                leaves
                | {q: leaves[q] + step * rate for q, rate in zip(system.coordinates, here["rates"], strict=True)}
                | {system.time: leaves.get(system.time, 0.0) + step}
            )
            for step in (_STEP, -_STEP)
        )
        return here | {f"{name} rate": (forward[name] - back[name]) / (2 * _STEP) for name in positions}

    return states.finite(symbols if rows is None else symbols | rows.symbols, numbers, what)


def _moved(system: MechanicalSystem, states: RandomStates, poses: list[Pose]) -> tuple[MechanicalSystem, list[Pose]]:
    """Positions whose rates are the stated velocities, by further coordinates where they are not yet."""
    sympy = sympy_package()
    stated = [system.resolved(pose.centre.vel(system.frame).to_matrix(system.frame)) for pose in poses]
    rates_of_rows = tuple(sympy.sympify(row).diff(system.time) for row in system.configuration)
    rows = AffineRows(system, (*system.velocity, *rates_of_rows))
    missing = []  # of each body: stated velocity less rate of the position, at all states
    for pose, velocity in zip(poses, stated, strict=True):
        lists = {"r": list(pose.position)}, {"v": list(velocity)}
        values = _along_the_motion(system, states, *lists, f"the position or velocity of body `{pose.name}`", rows)
        difference = np.array([found["v"] - found["r rate"] for found in values])
        missing.append(np.where(np.abs(difference) > _SAME * (1.0 + max(np.max(np.abs(found["v"])) for found in values)), difference, 0.0))
    if not any(np.any(difference) for difference in missing):
        return system, poses
    groups: list[list[int]] = []
    for k, difference in enumerate(missing):
        group = next((group for group in groups if np.allclose(missing[group[0]], difference, atol=_SAME)), None)
        groups.append([k]) if group is None else group.append(k)
    taken = {str(x.func) for x in (*system.coordinates, *system.speeds)}
    added: dict[Any, Any] = {}
    new = list(poses)
    for group in groups:
        along = np.any(missing[group[0]] != 0, axis=0)
        if not along.any():
            continue
        simplest = min(group, key=lambda k: sympy.count_ops(poses[k].position) + sympy.count_ops(stated[k]))
        whole = len(group) == len(poses)
        label = system.origin.name if whole else poses[group[0]].centre.name
        difference = stated[simplest] - system.resolved(poses[simplest].position.diff(system.time))
        shift = sympy.zeros(3, 1)
        for axis in np.flatnonzero(along):
            name = f"{label}_{'xyz'[axis]}"
            name = f"path_{name}" if name in taken else name
            shift[int(axis)] = sympy.physics.mechanics.dynamicsymbols(name)
            added[shift[int(axis)]] = difference[int(axis)]
        for k in group:
            new[k] = replace(poses[k], position=poses[k].position + shift)
    return system.with_coordinates(added), new
