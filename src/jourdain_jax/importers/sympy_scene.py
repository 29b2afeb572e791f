"""Scenes from SymPy's mechanics. SymPy's expressions for poses, loads and constraints are evaluated by JAX;
the equations of motion are derived here.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import jax.numpy as jnp
import numpy as np

from jourdain_jax.calculus.reals import Scalar, check_kind, checked_real, largest, real_type
from jourdain_jax.importers.formulas import Formulas, sympy_package
from jourdain_jax.importers.scene_class import identifiers, scene_class
from jourdain_jax.importers.sympy_kinematics import Pose, affine, poses_of, sampled, symbols_in
from jourdain_jax.importers.sympy_system import MechanicalSystem, mechanical_system
from jourdain_jax.scene.bodies import Particle, RigidBody
from jourdain_jax.scene.coordinates import check_names, coordinates, inputs, parameter, speeds
from jourdain_jax.scene.loads import Load
from jourdain_jax.scene.scene import Scene


@dataclass(frozen=True)
class _Expressions:
    """The expressions of a system, and the name in the scene of each symbol."""

    time: Any
    q: tuple[Any, ...]
    u: tuple[Any, ...]
    inputs: tuple[Any, ...]
    fields: dict[Any, str]  # constant -> name of the field
    is_rigid: dict[str, bool]  # body -> whether it is rigid
    formulas: dict[str, Formulas]  # of bodies, rates, loads, and geometric and velocity constraints

    def values(self, part: str, scene: "SympyScene", t, q, *others) -> dict[Any, list[Scalar]]:
        """Return the values of a part of the formulas. `others`: speeds and inputs, if the part depends on
        them.
        """
        leaves = {self.time: t} | {constant: getattr(scene, name) for constant, name in self.fields.items()}
        for symbols, named in zip((self.q, self.u, self.inputs), (q, *others), strict=False):
            leaves |= {symbol: named.array[k] for k, symbol in enumerate(symbols)}
        dtype = real_type()
        return {
            key: [jnp.asarray(value, dtype) for value in values]
            for key, values in self.formulas[part].values(leaves).items()
        }


class SympyScene(Scene):
    """Base of the scenes made by `from_sympy`."""

    _expressions: ClassVar[_Expressions]

    def bodies(self, t, q):
        """Return poses from SymPy's positions and rotation matrices."""
        values = {
            key: jnp.stack(several) for key, several in self._expressions.values("bodies", self, t, q).items()
        }
        found: dict[str, Particle | RigidBody] = {}
        for name, rigid in self._expressions.is_rigid.items():
            mass, position = values["mass", name][0], values["position", name]
            if rigid:
                inertia, orientation = (
                    values[what, name].reshape(3, 3) for what in ("inertia", "orientation")
                )
                found[name] = RigidBody(mass, inertia, position, orientation)
            else:
                found[name] = Particle(mass, position)
        return found

    def coordinate_rates(self, t, q, u):
        """Return the rates from SymPy's kinematic equations."""
        return jnp.stack(self._expressions.values("rates", self, t, q, u)["rates"])

    def loads(self, motion):
        """Return SymPy's loads; constant forces have a potential."""
        kinds: dict[str, dict] = {"weight": {}, "force": {}, "torque": {}, "generalized": {}}
        values = self._expressions.values("loads", self, motion.t, motion.q, motion.u, motion.inputs)
        for (kind, name), value in values.items():
            kinds[kind][name] = value[0] if kind == "generalized" else jnp.stack(value)
        weights, *others = kinds.values()
        found = []
        if weights:
            potential = -sum(force @ motion[name].position for name, force in weights.items())
            found.append(Load(forces=weights, potential=potential))
        return (*found, Load(*others)) if any(others) else tuple(found)

    def geometric_constraints(self, pose):
        """Return SymPy's configuration constraints."""
        return {
            f"configuration {k}": row
            for k, row in enumerate(self._expressions.values("geometric", self, pose.t, pose.q)["rows"], 1)
        }

    def velocity_constraints(self, motion):
        """Return SymPy's velocity constraints, without rates of the configuration constraints."""
        rows = self._expressions.values("velocity", self, motion.t, motion.q, motion.u, motion.inputs)["rows"]
        return {f"velocity {k}": row for k, row in enumerate(rows, 1)}


def from_sympy(
    system: Any, origin: Any = None, values: Mapping[Any, Any] | None = None, *, name: str = "SympyScene"
) -> type[Scene]:
    """Return a class of scenes from SymPy's mechanics. Poses, loads and constraints are imported; the
    equations of motion are derived by the engine.

        Pendulum = jj.from_sympy(kane, O, {m: 1.0, l: 0.5, g: 9.81})
        jj.simulate(Pendulum(), {"q": 0.3}, t1=5.0)

    - `system`: a `KanesMethod` that knows its bodies and loads (its equations need not be formed), a
      `System`, or a `JointsMethod`, all of `sympy.physics.mechanics`.
    - `origin`: SymPy's point of origin for positions, at rest or moving (default: the `fixed_point` of a
      `System`; otherwise required).
    - `values`: symbol, or its name, -> number, for every constant in the expressions, in its unit.
    - `name`: name of the class.

    **Returns** a class. Coordinates and speeds have SymPy's names; the speeds are SymPy's generalized speeds.
    Constants are parameters with the given `values` as defaults. Functions of time that are neither
    coordinates nor speeds are inputs. The class can be subclassed, for instance to add `events`.

    SymPy may have velocities without positions, as for a rolling disc whose contact point has no position.
    Coordinates are added for these: `C_x`, `C_y` for the path of the `origin` C, `W_angle` for a frame W with
    an angular velocity and no orientation.

    **Raises** ValueError, which names the part, for a constant without a value, a value without a constant, a
    function that JAX lacks, a system without bodies or kinematic equations, and a rate without an equation.
    Raises ImportError without `sympy`.

    **Examples**

        from sympy import symbols
        from sympy.physics.mechanics import KanesMethod, Particle, Point, ReferenceFrame, dynamicsymbols

        q, u, tension = dynamicsymbols("q u T")
        m, l, g = symbols("m l g", positive=True)
        N, O = ReferenceFrame("N"), Point("O")
        A = N.orientnew("A", "Axis", [q, N.y])
        P = O.locatenew("P", -l * A.z)
        O.set_vel(N, 0)
        bob, weight = Particle("bob", P, m), (P, -m * g * N.z)
        kane = KanesMethod(N, [q], [u], [q.diff() - u], bodies=[bob], forcelist=[weight])
        Pendulum = jj.from_sympy(kane, O, {m: 1.0, l: 0.5, g: 9.81}, name="Pendulum")
        print(jj.simulate(Pendulum(), {"q": 0.3}, t1=1.0))
    """
    check_kind(values, Mapping | None, "`values`", "a dictionary: symbol -> number")
    checked = {
        str(x): float(checked_real(value, f"value of `{x}`", (), advice="give one number"))
        for x, value in (values or {}).items()
    }
    return _scene_class(*poses_of(mechanical_system(system, origin, checked)), name)


def _scene_class(system: MechanicalSystem, poses: list[Pose], name: str) -> type[Scene]:
    """Return the class of scenes of a system with these poses."""
    bodies: dict[Any, Any] = {}
    for pose in poses:
        bodies |= {("mass", pose.name): [pose.mass], ("position", pose.name): pose.position}
        if pose.orientation is not None:
            bodies |= {
                ("inertia", pose.name): pose.inertia,
                ("orientation", pose.name): system.resolved(pose.orientation),
            }
    u_names = identifiers([str(x.func) for x in system.speeds], "speed")
    loads = {
        (kind, u_names[str(where.func)] if kind == "generalized" else where): value
        for (kind, where), value in forces_of(system, poses).items()
    }
    parts: dict[str, dict[Any, Any]] = {
        "bodies": bodies,
        "rates": {"rates": [system.rates[q.diff(system.time)] for q in system.coordinates]},
        "geometric": {"rows": [system.resolved(row) for row in system.configuration]},
        "loads": loads,
        "velocity": {"rows": velocity_rows(system)},
    }
    symbols = {
        part: symbols_in(e for expressions in lists.values() for e in expressions) - {system.time}
        for part, lists in parts.items()
    }
    used = sorted(set().union(*symbols.values()), key=str)
    constants = [x for x in used if x.is_Symbol]
    unknown = [x for x in used if not x.is_Symbol and x not in (*system.coordinates, *system.speeds)]
    for x in unknown:
        _check_input(system, x, symbols["bodies"] | symbols["rates"] | symbols["geometric"])
    _check_values(system.given, {str(constant) for constant in constants})
    fields = identifiers(dict.fromkeys(map(str, constants)), "constant", taken=dir(SympyScene))
    leaves = [*system.coordinates, *system.speeds, system.time, *used]
    expressions = _Expressions(
        system.time,
        system.coordinates,
        system.speeds,
        tuple(unknown),
        {constant: fields[str(constant)] for constant in constants},
        {pose.name: pose.orientation is not None for pose in poses},
        {part: Formulas(lists, leaves) for part, lists in parts.items()},
    )
    attributes = {
        "coordinates": coordinates(
            " ".join(identifiers([str(x.func) for x in system.coordinates], "coordinate").values())
        ),
        "speeds": speeds(" ".join(u_names.values())),
        "inputs": inputs(" ".join(identifiers([str(x.func) for x in unknown], "input").values())),
        "conventions": (
            f"Axes are those of the inertial frame {system.frame.name} of SymPy, positions are "
            f"from {system.origin.name}."
        ),
        "_expressions": expressions,
    }
    parameters = {
        fields[str(x)]: parameter(system.given[str(x)], about=f"{x} of SymPy", positive=bool(x.is_positive))
        for x in constants
    }
    return scene_class(
        SympyScene,
        name,
        f"A scene from SymPy: {', '.join(pose.name for pose in poses)}.",
        parameters,
        attributes,
    )


def forces_of(system: MechanicalSystem, poses: Sequence[Pose]) -> dict[tuple[str, Any], Any]:
    """Return the loads, in the inertial frame, by kind and place: "weight" (a constant force, which has a
    potential), "force" and "torque" on a body, "generalized" force of a speed.

    A force on a point other than a mass centre, or a torque on a frame other than a body's, becomes the
    generalized force Q_k = F . dv/du_k, with SymPy's velocity of the point or frame.
    """
    sympy = sympy_package()
    found: dict[tuple[str, Any], Any] = {}
    for where, vector in system.loads:
        value = system.resolved(vector.to_matrix(system.frame))
        is_point = isinstance(where, sympy.physics.mechanics.Point)
        body = next((pose.name for pose in poses if (pose.centre if is_point else pose.frame) == where), None)
        if body is not None:
            kind = "torque" if not is_point else "weight" if system.is_constant(value) else "force"
            parts = {(kind, body): value}
        else:
            velocity = where.vel(system.frame) if is_point else where.ang_vel_in(system.frame)
            partial = system.resolved(velocity.to_matrix(system.frame)).jacobian(sympy.Matrix(system.speeds))
            powers = zip(system.speeds, system.resolved(partial.T * value), strict=True)
            parts = {("generalized", speed): sympy.Matrix([power]) for speed, power in powers if power != 0}
        found |= {key: found[key] + part if key in found else part for key, part in parts.items()}
    return found


def velocity_rows(system: MechanicalSystem) -> list[Any]:
    """Return the velocity constraints other than rates of geometric constraints, which SymPy
    requires, too.
    """
    rows = [system.resolved(row) for row in system.velocity]
    if not rows or not system.configuration:
        return rows
    both = {"own": rows, "rates": [system.resolved(row) for row in system.rates_of_configuration()]}
    kept = np.zeros(len(rows), bool)
    samples = sampled(system, {f"{name} of rows": several for name, several in both.items()})
    formulas = Formulas(both, list(samples[0].leaves))
    for sample in samples:
        given, implied = (
            affine(lambda at, name=name: formulas.numbers(at)[name], sample.leaves, system.speeds)
            for name in both
        )  # type: ignore[misc]
        left = given - given @ np.linalg.pinv(implied) @ implied
        # relative part of a row that is independent of the rates of geometric constraints
        kept |= largest(left, 1) > 1e-9 * largest(given, 1)
    return [row for row, keep in zip(rows, kept, strict=True) if keep]


def _check_input(system: MechanicalSystem, x, of_poses: set[Any]) -> None:
    """Raise ValueError for a function of time that can be neither a coordinate nor an input, because no
    kinematic equation contains it, but its rate occurs or poses depend on it.
    """
    if isinstance(x, sympy_package().Derivative):
        speed = x.args[0] in system.speeds
        advice = (
            "loads and constraints may contain speeds, not their rates"
            if speed
            else f"make `{x.args[0]}` a coordinate or a speed"
        )
        raise ValueError(f"`{x}` occurs, but no kinematic equation determines it; {advice}")
    if x in of_poses:
        advice = (
            "make it a coordinate; to drive it as a function of time, define `prescribed(self, t)` in a"
            " subclass"
        )
        raise ValueError(
            f"`{x}` occurs in a position, an orientation or a configuration constraint, but is neither a "
            f"coordinate nor a speed; {advice}"
        )


def _check_values(given: Mapping[str, float], names: set[str]) -> None:
    """Raise ValueError for constants without a value, and for values without a constant."""
    if missing := sorted(names - given.keys()):
        listed = ", ".join(f"`{symbol}`" for symbol in missing)
        raise ValueError(
            f"no value for {listed}; give `values={{{missing[0]}: 1.0}}`, a number for each "
            "constant, by symbol or name"
        )
    check_names(given, sorted(names), "`values` names `{}`, which does not occur in the system")
