"""Loads and rows of SymPy's mechanics: forces on mass centres, torques on bodies, generalized forces by partial velocities, rows without what they repeat."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from jourdain_jax.importers.formulas import Formulas, sympy_package
from jourdain_jax.importers.sympy_kinematics import Pose
from jourdain_jax.importers.sympy_samples import affine, sampled
from jourdain_jax.importers.sympy_system import MechanicalSystem


def forces_of(system: MechanicalSystem, poses: Sequence[Pose]) -> dict[tuple[str, Any], Any]:
    """The loads by kind and place, inertial frame: "weight" (constant, so that it has a potential), "force" and "torque" of a body, "generalized" of a speed.

    A force on a point that is no mass centre, and a torque on a frame that is no body's, count by the power that they have by SymPy's velocity of that
    point or frame: Q_k = F . dv/du_k.
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
    """The velocity rows that are not the rates of the geometric ones: SymPy wants both."""
    rows = [system.resolved(row) for row in system.velocity]
    if not rows or not system.configuration:
        return rows
    both = {"own": rows, "rates": [system.resolved(row) for row in system.rates_of_configuration()]}
    kept = np.zeros(len(rows), bool)
    samples = sampled(system, {f"{name} of rows": several for name, several in both.items()})
    formulas = Formulas(both, list(samples[0].leaves))
    for sample in samples:
        given, implied = (affine(lambda at, name=name: formulas.numbers(at)[name], sample.leaves, system.speeds) for name in both)  # type: ignore[misc]
        left = given - given @ np.linalg.pinv(implied) @ implied
        # of a row: what of it the geometric rows leave, relative
        kept |= np.max(np.abs(left), axis=1) > 1e-9 * np.max(np.abs(given), axis=1)
    return [row for row, keep in zip(rows, kept, strict=True) if keep]
