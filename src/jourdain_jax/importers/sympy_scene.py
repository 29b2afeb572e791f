"""Scenes from SymPy's mechanics: poses, loads and rows are SymPy's expressions, evaluated on JAX; the equations of motion are those of this engine."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Float

from jourdain_jax.calculus.reals import checked_real, described
from jourdain_jax.importers.formulas import Formulas, sympy_package
from jourdain_jax.importers.identifiers import class_name, identifiers
from jourdain_jax.importers.scene_class import scene_class
from jourdain_jax.importers.sympy_forces import Forces, forces_of, velocity_rows
from jourdain_jax.importers.sympy_kinematics import Pose, RandomStates, poses_of, symbols_in
from jourdain_jax.importers.sympy_system import MechanicalSystem, mechanical_system
from jourdain_jax.scene.bodies import Particle, RigidBody
from jourdain_jax.scene.coordinates import coordinates, inputs, speeds
from jourdain_jax.scene.loads import Load
from jourdain_jax.scene.names import nearest
from jourdain_jax.scene.parameters import parameter
from jourdain_jax.scene.scene import Scene


@dataclass(frozen=True)
class _Expressions:
    """A system's expressions, and which name of the scene stands for which of their symbols."""

    time: Any
    q: tuple[Any, ...]
    u: tuple[Any, ...]
    inputs: tuple[Any, ...]
    fields: dict[Any, str]  # constant -> name of the field
    is_rigid: dict[str, bool]  # body -> whether it is a rigid one
    bodies: Formulas
    rates: Formulas
    loads: Formulas  # by body, or name of a speed, and kind: "disc force"
    geometric: Formulas
    velocity: Formulas


class SympyScene(Scene):
    """Base of the scenes that `from_sympy` makes."""

    _expressions: ClassVar[_Expressions]

    def bodies(self, t, q):
        """Poses by SymPy's positions and rotation matrices."""
        known = self._expressions
        values = known.bodies.values(self._leaves(t, q))
        found: dict[str, Particle | RigidBody] = {}
        for name, rigid in known.is_rigid.items():
            mass, position = _vector(values[f"{name} mass"])[0], _vector(values[f"{name} position"])
            if rigid:
                inertia, orientation = (_vector(values[f"{name} {what}"]).reshape(3, 3) for what in ("inertia", "orientation"))
                found[name] = RigidBody(mass, inertia, position, orientation)
            else:
                found[name] = Particle(mass, position)
        return found

    def coordinate_rates(self, t, q, u):
        """SymPy's kinematic equations, solved for the rates."""
        return _vector(self._expressions.rates.values(self._leaves(t, q, u))["rates"])

    def loads(self, motion):
        """SymPy's loads; those that are constant have a potential."""
        kinds = {"weight": {}, "force": {}, "torque": {}, "generalized": {}}
        for key, value in self._expressions.loads.values(self._leaves_of(motion)).items():
            name, _, kind = key.rpartition(" ")
            kinds[kind][name] = _vector(value)
        weights, forces, torques, generalized = kinds.values()
        found = ()
        if weights:
            found += (Load(forces=weights, potential=-sum(force @ motion[name].position for name, force in weights.items())),)
        if forces or torques or generalized:
            found += (Load(forces, torques, {name: value[0] for name, value in generalized.items()}),)
        return found

    def geometric_constraints(self, pose):
        """SymPy's configuration constraints."""
        return _rows("configuration", self._expressions.geometric.values(self._leaves(pose.t, pose.q))["rows"])

    def velocity_constraints(self, motion):
        """SymPy's velocity constraints that are not rates of the others."""
        return _rows("velocity", self._expressions.velocity.values(self._leaves_of(motion))["rows"])

    def _leaves(self, t, q, u=None) -> dict[Any, Float[Array, ""]]:
        known = self._expressions
        leaves = {known.time: t} | {constant: getattr(self, name) for constant, name in known.fields.items()}
        leaves |= {symbol: q.array[k] for k, symbol in enumerate(known.q)}
        return leaves if u is None else leaves | {symbol: u.array[k] for k, symbol in enumerate(known.u)}

    def _leaves_of(self, motion) -> dict[Any, Float[Array, ""]]:
        leaves = self._leaves(motion.t, motion.q, motion.u)
        return leaves | {symbol: motion.inputs.array[k] for k, symbol in enumerate(self._expressions.inputs)}


def _vector(values: list) -> Float[Array, "values"]:
    return jnp.stack([jnp.asarray(value, jnp.result_type(float)) for value in values])


def _rows(kind: str, values: list) -> dict[str, Float[Array, ""]]:
    return {f"{kind} {k + 1}": jnp.asarray(value, jnp.result_type(float)) for k, value in enumerate(values)}


def from_sympy(system, origin=None, values: Mapping[Any, Any] | None = None, *, name: str = "SympyScene") -> type[Scene]:
    """A class of scenes from the mechanics of SymPy: what moves, what pushes and what holds comes from there, the equations of motion from here.

        Pendulum = jj.from_sympy(kane, O, {m: 1.0, l: 0.5, g: 9.81})
        jj.simulate(Pendulum(), {"q": 0.3}, t1=5.0)

    - `system`: a `KanesMethod` that knows its bodies and loads (its equations need not be formed), a `System`, or a `JointsMethod`, all of
      `sympy.physics.mechanics`.
    - `origin`: the point of SymPy that positions count from, at rest or moving (default: the `fixed_point` of a `System`; otherwise it must be given).
    - `values`: symbol, or its name, -> number, for every constant in the expressions, in its unit.
    - `name`: of the class.

    **Returns** a class. Its coordinates and speeds have SymPy's names, the speeds are the generalized speeds of SymPy. Constants are fields: parameters with
    the given `values` as defaults. Functions of time that are neither coordinates nor speeds are inputs. The class can be subclassed, say for `events`.

    Velocities that SymPy states apart from positions, such as those of a rolling disc whose contact point is given no place, bring coordinates of their
    own: `C_x`, `C_y` for the path of the `origin` C, `W_angle` for a frame W with an angular velocity and no orientation.

    **Raises** ValueError, by name: a constant without a value, a value for what does not occur, a function that JAX does not have, a system without bodies or
    kinematic equations, a rate that no equation gives. ImportError without `sympy`.

    **Examples**

        from sympy import symbols
        from sympy.physics.mechanics import KanesMethod, Particle, Point, ReferenceFrame, dynamicsymbols

        q, u, tension = dynamicsymbols("q u T")
        m, l, g = symbols("m l g", positive=True)
        N, O = ReferenceFrame("N"), Point("O")
        A = N.orientnew("A", "Axis", [q, N.y])
        P = O.locatenew("P", -l * A.z)
        O.set_vel(N, 0)
        kane = KanesMethod(N, [q], [u], [q.diff() - u], bodies=[Particle("bob", P, m)], forcelist=[(P, -m * g * N.z)])
        Pendulum = jj.from_sympy(kane, O, {m: 1.0, l: 0.5, g: 9.81}, name="Pendulum")
        print(jj.simulate(Pendulum(), {"q": 0.3}, t1=1.0))
    """
    given = _checked_values({} if values is None else values)
    states = RandomStates(given)
    known, poses = poses_of(mechanical_system(system, origin), states)
    return _scene_class(known, poses, forces_of(known, poses), velocity_rows(known, states), given, name)


def _checked_values(values: Mapping[Any, Any]) -> dict[str, float]:
    """The values by the name of their symbol."""
    if not isinstance(values, Mapping):
        raise ValueError(f"`values` is {described(values)}, expected a dictionary: symbol -> number")
    return {str(symbol): float(checked_real(value, f"value of `{symbol}`", (), advice="give one number")) for symbol, value in values.items()}


def _scene_class(system: MechanicalSystem, poses: list[Pose], forces: Forces, rows: list[Any], given: dict[str, float], name: str) -> type[Scene]:
    """The class, when all expressions are known."""
    bodies: dict[str, list] = {}
    for pose in poses:
        bodies |= {f"{pose.name} mass": [pose.mass], f"{pose.name} position": list(pose.position)}
        if pose.orientation is not None and pose.inertia is not None:
            bodies |= {f"{pose.name} inertia": list(pose.inertia), f"{pose.name} orientation": list(system.resolved(pose.orientation))}
    u_names = identifiers([_name_of(x) for x in system.speeds], "speed")
    loads = {f"{body} {kind}": list(value) for kind in ("weight", "force", "torque") for body, value in getattr(forces, f"{kind}s").items()}
    loads |= {f"{u_names[_name_of(speed)]} generalized": [value] for speed, value in forces.generalized.items()}
    parts = {
        "bodies": bodies,
        "rates": {"rates": [system.rates[q.diff(system.time)] for q in system.coordinates]},
        "loads": loads,
        "geometric": {"rows": [system.resolved(row) for row in system.configuration]},
        "velocity": {"rows": rows},
    }
    used = symbols_in(e for lists in parts.values() for expressions in lists.values() for e in expressions) - {system.time}
    leaves = [*system.coordinates, *system.speeds, system.time, *used]
    constants = sorted((x for x in used if x.is_Symbol), key=str)
    unknown = sorted((x for x in used if not x.is_Symbol and x not in (*system.coordinates, *system.speeds)), key=str)
    _check_known(system, parts, constants, unknown, given)
    formulas = {part: Formulas(lists, leaves) for part, lists in parts.items()}
    fields = identifiers(dict.fromkeys(map(str, constants)), "constant", taken=dir(SympyScene))
    q_names = identifiers([_name_of(x) for x in system.coordinates], "coordinate")
    input_names = identifiers([_name_of(x) for x in unknown], "input")
    expressions = _Expressions(
        system.time,
        system.coordinates,
        system.speeds,
        tuple(unknown),
        {constant: fields[str(constant)] for constant in constants},
        {pose.name: pose.orientation is not None for pose in poses},
        **formulas,
    )
    parameters = {fields[str(x)]: parameter(given[str(x)], about=f"{x} of SymPy", positive=bool(x.is_positive)) for x in constants}
    attributes = {
        "coordinates": coordinates(" ".join(q_names.values())),
        "speeds": speeds(" ".join(u_names.values())),
        "inputs": inputs(" ".join(input_names.values())),
        "conventions": f"Axes are those of the inertial frame {system.frame.name} of SymPy, positions count from {system.origin.name}.",
        "_expressions": expressions,
    }
    return scene_class(SympyScene, class_name(name), f"A scene from SymPy: {', '.join(pose.name for pose in poses)}.", parameters, attributes)


def _name_of(function) -> str:
    return str(function.func)


def _check_known(system: MechanicalSystem, parts: dict[str, dict[str, list]], constants: list[Any], unknown: list[Any], given: dict[str, float]) -> None:
    """A ValueError for rates that nothing gives, inputs where there can be none, constants without a value, and values of nothing."""
    sympy = sympy_package()
    for x in unknown:
        if isinstance(x, sympy.Derivative):
            speed = x.args[0] in system.speeds
            advice = "loads and rows may depend on speeds, not on their rates" if speed else f"make `{x.args[0]}` a coordinate or a speed"
            raise ValueError(f"`{x}` occurs, and no kinematic equation gives it; {advice}")
    places = symbols_in(e for part in ("bodies", "rates", "geometric") for expressions in parts[part].values() for e in expressions)
    misplaced = next((x for x in unknown if x in places), None)
    if misplaced is not None:
        advice = "make it a coordinate; to drive it as a function of time, define `prescribed(self, t)` in a subclass"
        raise ValueError(f"`{misplaced}` occurs in a position, an orientation or a configuration constraint, and is neither coordinate nor speed; {advice}")
    names = {str(constant) for constant in constants}
    missing = sorted(names - given.keys())
    if missing:
        listed = ", ".join(f"`{symbol}`" for symbol in missing)
        raise ValueError(f"no value for {listed}; give `values={{{missing[0]}: 1.0}}`, a number for each constant, by symbol or name")
    for symbol in given:
        if symbol not in names:
            raise ValueError(f"`values` names `{symbol}`, which does not occur in the system; {nearest(symbol, sorted(names))}")
