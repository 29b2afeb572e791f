"""What is taken from SymPy's mechanics: coordinates, speeds, their kinematic equations, bodies, loads and rows; no equation of motion."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from jourdain_jax.calculus.reals import described
from jourdain_jax.importers.formulas import sympy_package


@dataclass(frozen=True)
class MechanicalSystem:
    """A system as SymPy describes it; expressions in q(t), u(t), t and constants."""

    frame: Any  # the inertial one
    origin: Any  # a point; positions count from it
    coordinates: tuple[Any, ...]
    speeds: tuple[Any, ...]
    rates: dict[Any, Any]  # qdot -> expression in q, u, t
    bodies: tuple[Any, ...]
    loads: tuple[tuple[Any, Any], ...]  # a point and a force, or a frame and a torque
    configuration: tuple[Any, ...]  # expressions that vanish
    velocity: tuple[Any, ...]  # the same, affine in u
    auxiliary: tuple[Any, ...]  # speeds that are zero

    def resolved(self, expression):
        """The expression (or matrix) without rates of coordinates and auxiliary speeds."""
        zero = dict.fromkeys(self.auxiliary, 0) | {speed.diff(self.time): 0 for speed in self.auxiliary}
        return expression.xreplace(self.rates).xreplace(zero)

    def with_coordinates(self, rates: dict[Any, Any]) -> "MechanicalSystem":
        """The system with further coordinates, whose rates are given."""
        new = {coordinate.diff(self.time): self.resolved(rate) for coordinate, rate in rates.items()}
        return replace(self, coordinates=(*self.coordinates, *rates), rates=self.rates | new)

    @property
    def time(self):
        """The symbol of the time."""
        return sympy_package().physics.mechanics.dynamicsymbols._t

    def is_constant(self, expression) -> bool:
        """Whether it depends on constants only."""
        sympy = sympy_package()
        return not expression.has(self.time) and not expression.atoms(sympy.core.function.AppliedUndef)


def mechanical_system(system, origin) -> MechanicalSystem:
    """What a `KanesMethod`, a `JointsMethod` whose equations are formed, or a `System` of SymPy says. ValueError for anything else, and for what is missing."""
    sympy = sympy_package()
    mechanics = sympy.physics.mechanics
    system = getattr(system, "method", None) or system  # of a JointsMethod
    if isinstance(system, mechanics.KanesMethod):
        return _of_kane(system, _checked_origin(mechanics, origin))
    if type(system).__name__ == "System" and hasattr(system, "kdes") and hasattr(system, "holonomic_constraints"):
        return _of_system(sympy, system, system.fixed_point if origin is None else _checked_origin(mechanics, origin))
    raise ValueError(
        f"`system` is {described(system)}, expected a `KanesMethod` or a `System` of sympy.physics.mechanics, or a `JointsMethod` after its `form_eoms()`"
    )


def _checked_origin(mechanics, origin):
    if not isinstance(origin, mechanics.Point):
        raise ValueError(f"`origin` is {described(origin)}, expected the point of SymPy that positions count from, such as Point('O')")
    return origin


def _of_kane(kane, origin) -> MechanicalSystem:
    if kane.bodies is None:
        raise ValueError("the `KanesMethod` does not know its bodies; give it `bodies=` and `forcelist=`, or call its `kanes_equations(bodies, loads)` first")
    try:
        rates = kane.kindiffdict()
    except AttributeError:
        raise ValueError("the `KanesMethod` has no kinematic equations; give it `kd_eqs=`, which say how speeds move coordinates") from None
    velocity = kane._k_nh * kane.u + kane._f_nh if kane._f_nh else ()
    return MechanicalSystem(
        kane._inertial,
        origin,
        tuple(kane.q),
        tuple(kane.u),
        dict(rates),
        tuple(kane.bodies),
        _pairs(kane.forcelist or ()),
        tuple(kane._f_h),
        tuple(velocity),
        tuple(kane._uaux),
    )


def _of_system(sympy, system, origin) -> MechanicalSystem:
    time = sympy.physics.mechanics.dynamicsymbols._t
    q, kinematic = sympy.Matrix(system.q), sympy.Matrix(system.kdes)
    if len(kinematic) != len(q):
        raise ValueError(f"the `System` has {len(kinematic)} kinematic equations for {len(q)} coordinates; add the missing ones by `add_kdes`")
    qdot = q.diff(time)
    # kinematic = A qdot + b = 0
    coefficients, rest = kinematic.jacobian(qdot), kinematic.xreplace(dict.fromkeys(qdot, sympy.S.Zero))
    solved = -coefficients.LUsolve(rest)
    loads = [*system.loads, *(load for actuator in system.actuators for load in actuator.to_loads())]
    return MechanicalSystem(
        system.frame,
        origin,
        tuple(q),
        tuple(system.u),
        dict(zip(qdot, solved, strict=True)),
        tuple(system.bodies),
        _pairs(loads),
        tuple(system.holonomic_constraints),
        tuple(system.velocity_constraints),
        tuple(system.u_aux),
    )


def _pairs(loads: Sequence[Any]) -> tuple[tuple[Any, Any], ...]:
    return tuple((load[0], load[1]) for load in loads)
