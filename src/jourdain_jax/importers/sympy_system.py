"""The imported parts of a system of SymPy's mechanics: coordinates, speeds, kinematic equations, bodies,
loads and constraints, but no equations of motion.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from jourdain_jax.calculus.reals import check_kind, described
from jourdain_jax.importers.formulas import sympy_package


@dataclass(frozen=True)
class MechanicalSystem:
    """A mechanical system of SymPy, with expressions in q(t), u(t), t and constants."""

    given: Mapping[str, float]  # values of constants, by name
    origin: Any  # the point from which positions are measured
    frame: Any  # the inertial frame
    coordinates: tuple[Any, ...]
    speeds: tuple[Any, ...]
    rates: dict[Any, Any]  # qdot -> expression in q, u, t
    bodies: tuple[Any, ...]
    loads: tuple[tuple[Any, Any], ...]  # a point and a force, or a frame and a torque
    configuration: tuple[Any, ...]  # expressions that vanish
    velocity: tuple[Any, ...]  # expressions, affine in u, that vanish
    auxiliary: tuple[Any, ...]  # speeds fixed at zero

    def resolved(self, expression):
        """Return the expression (or matrix) without rates of coordinates and auxiliary speeds."""
        zero = dict.fromkeys((*self.auxiliary, *(speed.diff(self.time) for speed in self.auxiliary)), 0)
        return sympy_package().sympify(expression).xreplace(self.rates).xreplace(zero)

    def rates_of_configuration(self) -> tuple[Any, ...]:
        """Return rates of configuration constraints, in rates of the coordinates."""
        return tuple(sympy_package().sympify(row).diff(self.time) for row in self.configuration)

    def with_coordinates(self, rates: dict[Any, Any]) -> "MechanicalSystem":
        """Return the system with further coordinates, whose `rates` are given."""
        new = {coordinate.diff(self.time): self.resolved(rate) for coordinate, rate in rates.items()}
        return replace(self, coordinates=(*self.coordinates, *rates), rates=self.rates | new)

    @property
    def time(self):
        """Return the symbol of the time."""
        return sympy_package().physics.mechanics.dynamicsymbols._t

    def is_constant(self, expression) -> bool:
        """Return whether the expression depends only on constants."""
        return not expression.has(self.time) and not expression.atoms(
            sympy_package().core.function.AppliedUndef
        )


def mechanical_system(system, origin, given: Mapping[str, float]) -> MechanicalSystem:
    """Return the parts of a `KanesMethod`, a `JointsMethod` with formed equations, or a `System` of SymPy.
    Raises ValueError for anything else, and for missing parts.
    """
    mechanics = sympy_package().physics.mechanics
    system = getattr(system, "method", None) or system  # of a JointsMethod
    if isinstance(system, mechanics.KanesMethod):
        read = _of_kane
    elif (
        type(system).__name__ == "System"
        and hasattr(system, "kdes")
        and hasattr(system, "holonomic_constraints")
    ):
        read, origin = _of_system, system.fixed_point if origin is None else origin
    else:
        raise ValueError(
            f"`system` is {described(system)}, expected a `KanesMethod` or a `System` of "
            "sympy.physics.mechanics, or a `JointsMethod` after its `form_eoms()`"
        )
    check_kind(
        origin, mechanics.Point, "`origin`", "SymPy's point of origin for positions, such as Point('O')"
    )
    frame, rates, loads, *several = read(system)
    q, u, bodies, configuration, velocity, auxiliary = map(tuple, several)
    pairs = tuple((load[0], load[1]) for load in loads)
    return MechanicalSystem(
        given, origin, frame, q, u, dict(rates), bodies, pairs, configuration, velocity, auxiliary
    )


def _of_kane(kane) -> tuple:
    if kane.bodies is None:
        raise ValueError(
            "the `KanesMethod` does not know its bodies; give it `bodies=` and `forcelist=`, or "
            "call its `kanes_equations(bodies, loads)` first"
        )
    try:
        rates = kane.kindiffdict()
    except AttributeError:
        raise ValueError(
            "the `KanesMethod` has no kinematic equations; give it `kd_eqs=`, the rates of the "
            "coordinates in terms of the speeds"
        ) from None
    velocity = kane._k_nh * kane.u + kane._f_nh if kane._f_nh else ()
    return (
        kane._inertial,
        rates,
        kane.forcelist or (),
        kane.q,
        kane.u,
        kane.bodies,
        kane._f_h,
        velocity,
        kane._uaux,
    )


def _of_system(system) -> tuple:
    sympy = sympy_package()
    q, kinematic = sympy.Matrix(system.q), sympy.Matrix(system.kdes)
    if len(kinematic) != len(q):
        raise ValueError(
            f"the `System` has {len(kinematic)} kinematic equations for {len(q)} coordinates; "
            "add the missing ones by `add_kdes`"
        )
    qdot = q.diff(sympy.physics.mechanics.dynamicsymbols._t)
    # kinematic = A qdot + b = 0
    solved = -kinematic.jacobian(qdot).LUsolve(kinematic.xreplace(dict.fromkeys(qdot, sympy.S.Zero)))
    loads = [*system.loads, *(load for actuator in system.actuators for load in actuator.to_loads())]
    rows = system.holonomic_constraints, system.velocity_constraints
    return (
        system.frame,
        zip(qdot, solved, strict=True),
        loads,
        q,
        system.u,
        system.bodies,
        *rows,
        system.u_aux,
    )
