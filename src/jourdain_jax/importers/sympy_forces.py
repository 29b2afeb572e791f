"""Loads and rows of SymPy's mechanics: forces on mass centres, torques on bodies, generalized forces by partial velocities, rows without what they repeat."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from jourdain_jax.importers.formulas import sympy_package
from jourdain_jax.importers.sympy_kinematics import AffineRows, Pose, RandomStates
from jourdain_jax.importers.sympy_system import MechanicalSystem


@dataclass(frozen=True)
class Forces:
    """What pushes the bodies: expressions in the inertial frame."""

    weights: dict[str, Any] = field(default_factory=dict)  # body -> 3x1, N, constant: with a potential
    forces: dict[str, Any] = field(default_factory=dict)  # body -> 3x1, N, at the mass centre
    torques: dict[str, Any] = field(default_factory=dict)  # body -> 3x1, N m
    generalized: dict[Any, Any] = field(default_factory=dict)  # speed -> force on it


def forces_of(system: MechanicalSystem, poses: Sequence[Pose]) -> Forces:
    """The loads of the system.

    A force on a point that is no mass centre, and a torque on a frame that is no body's, count by the power that they have by SymPy's velocity of that
    point or frame: Q_k = F . dv/du_k.
    """
    sympy = sympy_package()
    found = Forces()
    for where, vector in system.loads:
        value = system.resolved(vector.to_matrix(system.frame))
        is_point = isinstance(where, sympy.physics.mechanics.Point)
        body = next((pose.name for pose in poses if (pose.centre if is_point else pose.frame) == where), None)
        if body is not None:
            kind = found.torques if not is_point else found.weights if system.is_constant(value) else found.forces
            kind[body] = kind[body] + value if body in kind else value
            continue
        velocity = where.vel(system.frame) if is_point else where.ang_vel_in(system.frame)
        partial = system.resolved(velocity.to_matrix(system.frame)).jacobian(sympy.Matrix(system.speeds))
        for speed, power in zip(system.speeds, system.resolved(partial.T * value), strict=True):
            if power != 0:
                found.generalized[speed] = found.generalized.get(speed, 0) + power
    return found


def velocity_rows(system: MechanicalSystem, states: RandomStates) -> list[Any]:
    """The velocity rows that are not the rates of the geometric ones: SymPy wants both."""
    sympy = sympy_package()
    rows = [system.resolved(sympy.sympify(row)) for row in system.velocity]
    if not rows or not system.configuration:
        return rows
    own, rates = AffineRows(system, rows), AffineRows(system, [sympy.sympify(row).diff(system.time) for row in system.configuration])
    kept = np.zeros(len(rows), bool)
    for found in states.finite(own.symbols | rates.symbols, lambda leaves: {"own": own.coefficients(leaves), "rates": rates.coefficients(leaves)}, "a row"):
        given, implied = found["own"], found["rates"]
        left = given - given @ np.linalg.pinv(implied) @ implied
        # of a row: what of it the geometric rows leave, relative
        kept |= np.max(np.abs(left), axis=1) > 1e-9 * np.max(np.abs(given), axis=1)
    return [row for row, keep in zip(rows, kept, strict=True) if keep]
