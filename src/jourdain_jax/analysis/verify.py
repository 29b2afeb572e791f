"""Verify a scene's equations at one state: independent formulations must give equal numbers.

inertia            possible masses and inertias; rotation matrices; unit vectors as directions of gravity
potentials         forces of loads with a potential are minus its gradient
derivatives        of every body, load, potential and constraint: autodiff against central differences
reductions         udot and A' lambda by every applicable reduction
forms              M and h by Lagrange's energy derivatives and by the Gibbs function, against Jourdain's
                   virtual power
virtual power      Z' (M udot + h - Q) = 0 over the admissible virtual velocities, also per constraint:
                   eqs. (18), (71)-(73)
Newton             sum beta' R + gamma' T = A' lambda, R = m a - F per body (S1); R also from the constraints
                   alone if no constraint is built into the coordinates
energy             d(T + V)/dt along the motion, minus the power of loads without potential
gradients          of udot and A' lambda: forward against reverse mode, and against central differences

`statements.py` has the first three checks. All checks run once, without compilation, which would take several
times longer.

`energy` computes the energy of a scene, and `energy_balance` names the powers that change it:

    E = T + V,   T = sum m v.v/2 + omega.I omega/2
    dE/dt = power of loads without a potential (`dynamics/reactions.py`)
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jourdain_jax.analysis.statements import gradient_checks, statement_checks
from jourdain_jax.analysis.verification import Verification, check
from jourdain_jax.calculus.matrices import null_space_svd
from jourdain_jax.calculus.reals import Number, Numbers, Scalar, Speeds, checked_whole, largest, tiny_of
from jourdain_jax.dynamics.accelerations import bare_accelerations, by_reduction, diagnosed, reductions
from jourdain_jax.dynamics.reactions import newton_residual, power, row_reactions
from jourdain_jax.equations.gibbs_appell import gibbs_equations
from jourdain_jax.equations.kinematics import (
    coordinate_rates,
    inertias,
    motion_at,
    of_bodies,
    partial_velocities,
    shapes_along_motion,
    speeds_are_rates,
    velocities,
)
from jourdain_jax.equations.reductions import row_scale, speed_scale
from jourdain_jax.equations.rows import names_of_rows
from jourdain_jax.equations.virtual_power import (
    energies_at,
    equations_and_rows,
    lagrange_equations,
    on_speeds,
    unconstrained_equations,
)
from jourdain_jax.integrate.state import State
from jourdain_jax.motion.check import check as look_for_mistakes
from jourdain_jax.motion.simulate import as_state
from jourdain_jax.motion.start import consistent
from jourdain_jax.program.eager import eval_numpy
from jourdain_jax.scene.arguments import (
    BuiltFor,
    InputLike,
    as_input_vector,
    as_scene,
    of_known_numbers,
    shown_from_users_lines,
)
from jourdain_jax.scene.scene import Scene
from jourdain_jax.scene.user_methods import loads_of, potential_of
from jourdain_jax.structure.sampling import sample_states
from jourdain_jax.structure.structure import plain_row_lengths, structure_of, usual_rows


@shown_from_users_lines
@of_known_numbers
def verify(
    scene: Scene | BuiltFor,
    state: "State | Mapping[str, Any] | None" = None,
    inputs: "Numbers | Mapping[str, Any] | None" = None,
    *,
    seed: int = 0,
) -> Verification:
    """Verify the equations of a scene, and each body, load and constraint, at a consistent state. A failed
    check names its culprit.

        print(verify(disc, start(disc, lean=0.3, spin_rate=-3.0)))

    Values are relative to the size of the compared quantities. Thresholds depend on the floating-point type
    (`analysis/verification.py`). Single precision detects only gross errors, so passing certifies nothing. If
    no reduction applies (no inertia along a free direction), gradients cannot be checked, and the
    verification fails.

    **Arguments**

    - `state`: a state on the constraints, from `start` or `consistent`, or named values as for `start`.
      Default: the scene's example, otherwise a random state of its domain. Symmetric states may hide errors.
    - `inputs`: values of the scene's inputs, a vector or by name (default: zero).
    - `seed`: for the random state and the random direction of derivatives. The direction is admissible in the
      coordinates, arbitrary in the speeds, and proportional to the values of the parameters. The Gibbs-Appell
      reduction is not differentiated. If a change of the parameters makes dependent constraints independent,
      no derivative exists (`derivative_exists`): parameters are then omitted, with a note.

    **Returns** a `Verification`, printed with the table of `jj.check`. A failed check raises no error. Raises
    DifferentiationModeError for traced numbers.
    """
    checked_whole(seed, "`seed`", 0, expected="that is not negative")
    scene = as_scene(scene)
    inputs = as_input_vector(scene, inputs)
    if state is None and not scene.example:
        (t,), (q,), (u,) = sample_states(scene, 1, seed)
        state = consistent(scene, t, q, u, inputs)
    state = as_state(scene, state, what="state", inputs=inputs)
    t, q, u = state.t, state.q, state.u
    found = _evaluate(scene, t, q, u, inputs, usual_rows(scene), plain_row_lengths(scene))
    applicable = [name for name, ok in found["applicable"].items() if ok]
    Z = jnp.asarray(found["directions"])
    checks = statement_checks(scene, t, q, u, inputs, Z, seed)
    checks += [
        check(name, values, found["M"].dtype)
        for name, values in _comparisons(scene, found, applicable).items()
    ]
    checks += gradient_checks(scene, t, q, u, inputs, Z, tuple(applicable), seed)
    left_out = tuple(name for name in found["applicable"] if name not in applicable)
    return Verification(type(scene).__name__, tuple(checks), left_out, str(look_for_mistakes(scene)))


@eval_numpy
def _evaluate(scene, t, q, u, inputs, usual, plain) -> dict:
    equations, rows = equations_and_rows(scene, t, q, u, inputs)
    rows = rows.judged_by(usual)
    ways = {
        name: diagnosed(by_reduction(way, scene, t, q, u, equations, rows), equations, rows)
        for name, way in reductions(scene).items()
    }
    c = speed_scale(equations.M)
    reference = ways["svd"]
    newton = newton_residual(scene, t, q, u, reference.udot, inputs)
    partial = partial_velocities(scene, t, q, u)
    turned = of_bodies(motion_at(scene, t, q, u, inputs), "orientation")
    hidden_torque = jnp.einsum("bji,bj->bi", turned, newton.angular)
    by_body = jnp.einsum("bik,bi->bk", partial.linear, newton.linear) + jnp.einsum(
        "bik,bi->bk", partial.angular, hidden_torque
    )
    reactions = row_reactions(scene, t, q, u, reference, inputs)
    torque = jnp.einsum("bji,sbj->sbi", turned, reactions.torque)
    by_row = on_speeds(partial, reactions.force, torque) + reactions.direct
    energy = lambda t, q, u: sum(energies_at(scene, motion_at(scene, t, q, u, inputs)))
    energy_rate = jax.jvp(
        energy, (t, q, u), (jnp.ones_like(t), coordinate_rates(scene, t, q, u), reference.udot)
    )
    forms = {"Gibbs function": gibbs_equations(scene, t, q, u, inputs)}
    # a varying mass joins or leaves at the velocity of its body (m a = F), but d/dt dT/dqdot would count its
    # momentum as lost
    if speeds_are_rates(scene) and not structure_of(scene).varying_inertia:
        forms["Lagrange's equations"] = lagrange_equations(scene, t, q, u, inputs)
    return {
        "udot": {name: way.udot / c for name, way in ways.items()},
        "force": {name: way.constraint_force * c for name, way in ways.items()},
        "applicable": {name: way.applicable for name, way in ways.items()},
        "impressed": c * (equations.Q - equations.h),
        "gyroscopic": c * _gyroscopic(scene, t, q, u, partial),
        "M": c[:, None] * equations.M * c,
        "h": c * equations.h,
        "forms": {name: (c[:, None] * form.M * c, c * form.h) for name, form in forms.items()},
        "Z": null_space_svd(row_scale(rows.A * c, usual.lengths)[:, None] * rows.A * c),
        "directions": null_space_svd(row_scale(rows.A, plain)[:, None] * rows.A),
        "newton": by_body * c,
        "rows": by_row * c,
        "reference": reference.constraint_force * c,
        "energy_rate": energy_rate[1],
        "power": power(scene, motion_at(scene, t, q, u, inputs), reference).total,
        "power_scale": (
            jnp.abs(energy_rate[0])
            + jnp.linalg.norm(u / c) * jnp.linalg.norm(c * (jnp.abs(equations.Q) + jnp.abs(equations.h)))
        ),
    }


def _gyroscopic(scene, t, q, u, partial) -> Speeds:
    """Return the size of the inertia forces `m v omega` and `omega I omega`. They may cancel in `h` and then
    leave round-off relative to this size.
    """
    weights, known = inertias(scene, t, q), velocities(scene, t, q, u)
    v, w = (jnp.linalg.norm(x, axis=1) for x in (known.linear, known.angular))
    force, torque = weights.mass * v * w, largest(weights.inertia, (1, 2)) * w**2
    return jnp.einsum("bik,b->k", jnp.abs(partial.linear), force) + jnp.einsum(
        "bik,b->k", jnp.abs(partial.angular), torque
    )


def _size(found: dict, *others) -> float:
    """Return the reference size for differences of forces: the size of impressed and inertial forces."""
    forces = (found["impressed"], found["gyroscopic"], *others)
    return sum(largest(force) for force in forces) + tiny_of(found["M"])


def _comparisons(scene: Scene, found: dict, applicable: list[str]) -> dict[str, dict[str, float]]:
    """Return relative differences by check and subject."""
    size, names = _size(found, found["reference"]), names_of_rows(scene)
    virtual = {f"reduction `{name}`": found["force"][name] for name in applicable}
    virtual |= {f"constraint `{name}`": force for name, force in zip(names, found["rows"], strict=True)}
    newton = {"constraints: their reactions do not add up to the constraint force": found["rows"]}
    if not _acts_on_speeds(scene):
        newton["bodies: m a - F does not add up to the constraint force"] = found["newton"]
    of_h, of_newton = 1 + largest(found["h"]), _size(found, found["newton"])
    energy = np.abs(found["energy_rate"] - found["power"]) / (tiny_of(found["M"]) + found["power_scale"])
    return {
        "reductions": _reductions(found, applicable),
        "forms": {
            f"form `{name}`": np.max([largest(M - found["M"]), largest(h - found["h"]) / of_h])
            for name, (M, h) in found["forms"].items()
        },
        "virtual power": {
            suspect: largest(found["Z"].T @ force) / size for suspect, force in virtual.items()
        },
        "Newton": {
            suspect: largest(forces.sum(0) - found["reference"]) / of_newton
            for suspect, forces in newton.items()
        },
        "energy": {"a load whose potential does not give its force, or a constraint that does work": energy},
    }


def _reductions(found: dict, applicable: list[str]) -> dict[str, float]:
    if not applicable:
        return {"the mass matrix and the constraints: no reduction applies": np.inf}
    differences = dict.fromkeys(applicable, 0.0)
    for quantity in ("udot", "force"):
        # compare with the median, so that one wrong reduction does not make the others look wrong
        middle = np.median(np.stack([found[quantity][name] for name in applicable]), axis=0)
        size = _size(found, middle)
        differences = {
            name: np.max([known, largest(found[quantity][name] - middle) / size])
            for name, known in differences.items()
        }
    return {f"reduction `{name}`": value for name, value in differences.items()}


def _acts_on_speeds(scene: Scene) -> bool:
    """Return whether loads act directly on speeds, or the scene has a potential. In either case the forces on
    bodies do not include all loads.
    """
    flags: list[bool] = []

    def look(scene, motion):
        flags.append(potential_of(scene, motion.pose()) is not None)
        flags.extend(bool(load.generalized) for load in loads_of(scene, motion))

    shapes_along_motion(look, scene)
    return any(flags)


_ORIGINS = {
    "loads": "loads without a potential",
    "rows": "constraints that do real work",
    "driven": "poses driven as functions of time",
    "potential": "potentials that depend on time",
    "inertia": "masses or inertias that change",
}


class Energy(eqx.Module):
    """Energy of one state, in J: `kinetic` T, `potential` V and their `total`."""

    kinetic: Scalar
    potential: Scalar  # of all loads and the scene; loads without a potential contribute nothing

    @property
    def total(self) -> Scalar:
        """Return T + V."""
        return self.kinetic + self.potential


@dataclass(frozen=True)
class EnergyBalance:
    """Whether T + V is conserved along every motion of a scene, and if not, the causes of its change."""

    conserved: bool
    changed_by: tuple[str, ...]

    def __str__(self) -> str:
        return (
            "T + V is conserved" if self.conserved else f"T + V is changed by {' and '.join(self.changed_by)}"
        )


def energy(scene: Scene, t: Number, q: Numbers, u: Numbers, inputs: InputLike = None) -> Energy:
    """Return the kinetic and potential energy (J) at (t, q, u). `inputs`: values of the scene's inputs
    (default: zero).
    """
    return Energy(*energies_at(scene, motion_at(scene, t, q, u, inputs)))


@of_known_numbers
def energy_balance(scene: Scene) -> EnergyBalance:
    """Report whether T + V is conserved, and the powers that change it, eqs. (71)-(73).

    Eight random admissible states with random inputs are examined. A power counts as zero if it is below 1e-9
    of the largest power (1e-4 in single precision). Raises DifferentiationModeError for traced numbers.
    """
    t, q, u = (jnp.asarray(x) for x in sample_states(scene, 8))
    inputs = jnp.asarray(np.random.default_rng(0).normal(size=(len(t), len(scene.inputs))))
    powers, size = _powers(scene, t, q, u, inputs)
    limit = (1e-9 if q.dtype == jnp.float64 else 1e-4) * float(jnp.max(size))
    changed_by = tuple(
        text for name, text in _ORIGINS.items() if float(largest(getattr(powers, name))) > limit
    )
    changed_by += ("potentials that depend on inputs",) if structure_of(scene).potentials_of_inputs else ()
    return EnergyBalance(not changed_by, changed_by)


@eqx.filter_jit
def _powers(scene: Scene, t, q, u, inputs):
    def one(t, q, u, inputs):
        found = bare_accelerations(scene, t, q, u, inputs)
        equations = unconstrained_equations(scene, t, q, u, inputs)
        forces = jnp.abs(equations.M) @ jnp.abs(found.udot) + jnp.abs(equations.h) + jnp.abs(equations.Q)
        return power(scene, motion_at(scene, t, q, u, inputs), found), jnp.abs(u) @ forces

    return jax.vmap(one)(t, q, u, inputs)
