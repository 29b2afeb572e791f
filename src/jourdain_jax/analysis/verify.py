"""A scene's equations checked against each other at one state: different ways must give the same numbers.

reductions         udot and A' lambda by every applicable reduction
forms              M and h by Lagrange's energy derivatives and by the Gibbs function, against Jourdain's virtual power
virtual power      Z' (M udot + h - Q) = 0 over the admissible virtual velocities, row by row too           (18), (71)-(73)
Newton             sum beta' R + gamma' T = A' lambda, R = m a - F per body (S1); R from the rows alone, where nothing is built in
energy             d(T + V)/dt along the motion, less the power of what has no potential
gradients          of udot and A' lambda: forward against reverse mode, and against central differences
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jourdain_jax.calculus.null_space import null_space_svd
from jourdain_jax.calculus.pseudo_inverse import pseudo_inverse, rank_cutoff
from jourdain_jax.equations.accelerations import reductions
from jourdain_jax.equations.gibbs_appell import GibbsAppell, gibbs_equations
from jourdain_jax.equations.instant import constraint_rows
from jourdain_jax.equations.kinematics import coordinate_rates, motion_at, partial_velocities
from jourdain_jax.equations.lagrange import lagrange_equations, speeds_are_rates
from jourdain_jax.equations.power import power_of_nonconservative
from jourdain_jax.equations.reactions import row_reactions
from jourdain_jax.equations.reductions import diagnosed, reduce
from jourdain_jax.equations.rows import names_of_rows
from jourdain_jax.equations.scaling import row_scale, speed_scale
from jourdain_jax.equations.virtual_power import equations_and_rows, kinetic_energy, newton_residual, potential_energy
from jourdain_jax.motion.arguments import as_state
from jourdain_jax.motion.start import State
from jourdain_jax.scene.answers import loads_of, potential_of
from jourdain_jax.scene.arguments import as_input_vector, as_scene
from jourdain_jax.scene.printing import Printed
from jourdain_jax.scene.scene import Scene

THRESHOLDS = {"reductions": 1e-10, "forms": 1e-10, "virtual power": 1e-10, "Newton": 1e-10, "energy": 1e-9, "jvp against vjp": 1e-11, "differences": 1e-6}


class Check(eqx.Module):
    """One comparison: its relative size, what it may be, and what it is about."""

    name: str = eqx.field(static=True)
    value: float
    threshold: float
    culprit: str = eqx.field(static=True)  # reduction, form, row, body or direction with the largest value
    note: str = eqx.field(static=True, default="")

    @property
    def passed(self) -> bool:
        """Whether the value is within its threshold."""
        return bool(self.value <= self.threshold)


class Verification(Printed, eqx.Module):
    """All checks of one state."""

    scene: str = eqx.field(static=True)
    checks: tuple[Check, ...]
    not_applicable: tuple[str, ...] = eqx.field(static=True)  # reductions that do not apply at this state

    @property
    def passed(self) -> bool:
        """Whether every check passed."""
        return all(check.passed for check in self.checks)

    def largest(self, *names: str) -> float:
        """The largest value among the named checks; NaN counts as largest, None stands for none."""
        values = [check.value for check in self.checks if check.name in names]
        return float(np.max(values)) if values else 0.0

    def as_dict(self) -> dict:
        """The result for machines."""
        return {
            "max_disagreement": self.largest("reductions", "forms", "Newton"),
            "virtual_power": self.largest("virtual power"),
            "energy_balance": self.largest("energy"),
            "gradient_error": self.largest("jvp against vjp", "differences"),
            "passed": self.passed,
            "not_applicable": list(self.not_applicable),
            "checks": [
                {"name": c.name, "value": float(c.value), "threshold": c.threshold, "passed": c.passed, "culprit": c.culprit, "note": c.note}
                for c in self.checks
            ],
        }

    def _text(self) -> str:
        lines = [f"Verification of {self.scene}: {'passed' if self.passed else 'FAILED'}"]
        for check in self.checks:
            verdict = "ok" if check.passed else f"FAILED, look at {check.culprit}"
            lines.append(f"  {check.name:<16} {check.value:9.1e}  (at most {check.threshold:.0e})  {verdict}" + (f"; {check.note}" if check.note else ""))
        if self.not_applicable:
            lines.append("  not applicable at this state: " + ", ".join(self.not_applicable))
        return "\n".join(lines)


def verify(scene: Scene, state: State | dict | None = None, inputs: Float[Array, "inputs"] | dict | None = None, *, seed: int = 0) -> Verification:
    """Check the equations of a scene at a consistent state; every check has a threshold, and a failed one names its culprit.

    Values are relative to the size of what is compared. Directions for the gradients are random: admissible in the coordinates, free in the
    speeds, relative in the parameters; the Gibbs-Appell reduction is left out of them. Parameters that split rows which are dependent have no
    derivative there and are left out, with a note.
    """
    state = as_state(as_scene(scene), state, what="state")
    t, q, u = state.t, state.q, state.u
    inputs = as_input_vector(scene, inputs)
    found = jax.tree.map(np.asarray, _evaluate(scene, t, q, u, inputs))
    applicable = [name for name, ok in found["applicable"].items() if ok]
    checks = [_reductions(found, applicable), *_forms(found), _virtual_power(found, applicable, names_of_rows(scene)), _newton(scene, found), _energy(found)]
    checks += _gradients(scene, t, q, u, inputs, tuple(applicable), seed)
    return Verification(type(scene).__name__, tuple(checks), tuple(name for name in found["applicable"] if name not in applicable))


@eqx.filter_jit
def _evaluate(scene, t, q, u, inputs) -> dict:
    equations, rows = equations_and_rows(scene, t, q, u, inputs)
    ways = {name: diagnosed(_by(way, scene, t, q, u, equations, rows), equations, rows) for name, way in reductions(scene).items()}
    c = speed_scale(equations.M)
    reference = ways["svd"]
    newton = newton_residual(scene, t, q, u, reference.udot, inputs)
    partial = partial_velocities(scene, t, q, u)
    turned = jnp.stack([body.orientation for body in motion_at(scene, t, q, u, inputs).bodies.values()])
    hidden_torque = jnp.einsum("bji,bj->bi", turned, newton.angular)
    by_body = jnp.einsum("bik,bi->bk", partial.linear, newton.linear) + jnp.einsum("bik,bi->bk", partial.angular, hidden_torque)
    reactions = row_reactions(scene, t, q, u, reference, inputs)
    torque = jnp.einsum("bji,sbj->sbi", turned, reactions.torque)
    by_row = jnp.einsum("bik,sbi->sk", partial.linear, reactions.force) + jnp.einsum("bik,sbi->sk", partial.angular, torque) + reactions.direct
    energy_rate = jax.jvp(lambda t, q, u: _energy_of(scene, t, q, u, inputs), (t, q, u), (jnp.ones_like(t), coordinate_rates(scene, t, q, u), reference.udot))
    forms = {"Gibbs function": gibbs_equations(scene, t, q, u, inputs)}
    if speeds_are_rates(scene):
        forms["Lagrange's equations"] = lagrange_equations(scene, t, q, u, inputs)
    return {
        "udot": {name: way.udot / c for name, way in ways.items()},
        "force": {name: way.constraint_force * c for name, way in ways.items()},
        "applicable": {name: way.applicable for name, way in ways.items()},
        "impressed": c * (equations.Q - equations.h),
        "M": c[:, None] * equations.M * c,
        "h": c * equations.h,
        "forms": {name: (c[:, None] * form.M * c, c * form.h) for name, form in forms.items()},
        "Z": null_space_svd(row_scale(rows.A * c)[:, None] * rows.A * c),
        "newton": by_body * c,
        "rows": by_row * c,
        "reference": reference.constraint_force * c,
        "energy_rate": energy_rate[1],
        "power": power_of_nonconservative(scene, t, q, u, inputs, reference),
        "power_scale": jnp.abs(energy_rate[0]) + jnp.linalg.norm(u / c) * jnp.linalg.norm(c * (jnp.abs(equations.Q) + jnp.abs(equations.h))),
    }


def _by(way, scene, t, q, u, equations, rows):
    """One reduction of equations and rows that all share."""
    return way.accelerations(scene, t, q, u, equations, rows) if isinstance(way, GibbsAppell) else reduce(way, equations, rows)


def _energy_of(scene, t, q, u, inputs):
    return kinetic_energy(scene, t, q, u) + potential_energy(scene, motion_at(scene, t, q, u, inputs))


def _worst(values: dict[str, float]) -> tuple[str, float]:
    """The name with the largest value; NaN counts as larger than any number."""
    if not values:
        return "nothing", 0.0
    name = max(values, key=lambda key: np.inf if np.isnan(values[key]) else values[key])
    return name, values[name]


def _check(name: str, values: dict[str, float], kind: str, note: str = "") -> Check:
    culprit, value = _worst(values)
    return Check(name, float(value), THRESHOLDS[name], f"{kind} `{culprit}`", note)


def _reductions(found: dict, applicable: list[str]) -> Check:
    if not applicable:
        return Check("reductions", np.inf, THRESHOLDS["reductions"], "the mass matrix and the rows: no reduction applies")
    differences: dict[str, float] = {}
    for quantity in ("udot", "force"):
        # against the median of all: one wrong way does not make the others look wrong
        middle = np.median(np.stack([found[quantity][name] for name in applicable]), axis=0)
        size = np.max(np.abs(middle)) + np.max(np.abs(found["impressed"])) + np.finfo(float).tiny
        for name in applicable:
            differences[name] = np.max([differences.get(name, 0.0), np.max(np.abs(found[quantity][name] - middle)) / size])
    return _check("reductions", differences, "reduction")


def _forms(found: dict) -> list[Check]:
    size = 1 + np.max(np.abs(found["h"]))
    values = {name: np.max([np.max(np.abs(M - found["M"])), np.max(np.abs(h - found["h"])) / size]) for name, (M, h) in found["forms"].items()}
    return [_check("forms", values, "form")]


def _virtual_power(found: dict, applicable: list[str], names: tuple[str, ...]) -> Check:
    size = np.max(np.abs(found["impressed"])) + np.max(np.abs(found["reference"])) + np.finfo(float).tiny
    values = {f"reduction {name}": np.max(np.abs(found["Z"].T @ found["force"][name]), initial=0.0) / size for name in applicable}
    values |= {f"row {name}": np.max(np.abs(found["Z"].T @ force), initial=0.0) / size for name, force in zip(names, found["rows"], strict=True)}
    return _check("virtual power", values, "")


def _newton(scene: Scene, found: dict) -> Check:
    size = np.max(np.abs(found["impressed"])) + np.max(np.abs(found["newton"])) + np.finfo(float).tiny
    direct_loads = np.max(np.abs(found["newton"].sum(0) - found["reference"])) / size
    rows = np.max(np.abs(found["rows"].sum(0) - found["reference"]), initial=0.0) / size
    values = {"rows: their reactions do not add up to the constraint force": rows}
    if not _acts_on_speeds(scene):
        values["bodies: m a - F does not add up to the constraint force"] = direct_loads
    return _check("Newton", values, "")


def _acts_on_speeds(scene: Scene) -> bool:
    """Whether loads act directly on speeds, or a potential is given as a function of coordinates: then bodies do not show all forces."""
    q, u, _ = scene.named()
    flags: list[bool] = []

    def look(scene):
        motion = motion_at(scene, 0.0, q, u)
        flags.append(potential_of(scene, motion.pose()) is not None)
        flags.extend(bool(load.generalized) for load in loads_of(scene, motion))

    jax.eval_shape(look, scene)
    return any(flags)


def _energy(found: dict) -> Check:
    value = np.abs(found["energy_rate"] - found["power"]) / (1e-300 + found["power_scale"])
    return Check("energy", float(value), THRESHOLDS["energy"], "a load whose potential does not give its force, or a row whose power is not counted")


def derivative_exists(scene: Scene, t, q, u, direction: Scene, dq, inputs=None) -> bool:
    """Whether accelerations have a derivative along a change of parameters (`direction`, like the scene) and coordinates `dq`.

    They have none where the change splits rows that are dependent: `(1 - A A+) dA (1 - A+ A)` is not zero.
    """
    A, dA, size = (np.asarray(x) for x in _row_change(scene, t, q, u, direction, dq, inputs))
    if A.size == 0:
        return True
    P = np.asarray(pseudo_inverse(jnp.asarray(A)))
    split = (np.eye(len(A)) - A @ P) @ dA @ (np.eye(A.shape[1]) - P @ A)
    return bool(np.max(np.abs(split)) <= 1e3 * rank_cutoff(A.dtype) * (size + np.max(np.abs(dA))))


@eqx.filter_jit
def _row_change(scene, t, q, u, direction, dq, inputs):
    moving, fixed = eqx.partition(scene, eqx.is_inexact_array)

    def A(parameters, q):
        rows = constraint_rows(eqx.combine(parameters, fixed), t, q, u, inputs)
        return jax.lax.stop_gradient(row_scale(rows.A))[:, None] * rows.A

    value, change = jax.jvp(A, (moving, q), (eqx.filter(direction, eqx.is_inexact_array), dq))
    return value, change, jnp.max(jnp.abs(value), initial=1.0)


def _gradients(scene, t, q, u, inputs, ways: tuple[str, ...], seed: int) -> list[Check]:
    generator = np.random.default_rng(seed)
    moving, fixed = eqx.partition(scene, eqx.is_inexact_array)
    relative = jax.tree.map(lambda x: jnp.asarray(generator.normal(size=x.shape) * np.where(x == 0, 1.0, x)), moving)
    weights = jnp.asarray(generator.normal(size=2 * u.shape[0]))
    rows = constraint_rows(scene, t, q, u, inputs)
    Z = null_space_svd(row_scale(rows.A)[:, None] * rows.A)
    du = jnp.asarray(generator.normal(size=u.shape))
    dq = coordinate_rates(scene, t, q, Z @ du) - coordinate_rates(scene, t, q, jnp.zeros_like(u))
    note = ""
    if not derivative_exists(scene, t, q, u, eqx.combine(relative, fixed), dq, inputs):
        relative = jax.tree.map(jnp.zeros_like, relative)
        note = "parameters left out: a change of them splits rows that are dependent, and accelerations have no derivative there"
    ways = tuple(name for name in ways if name != "gibbs-appell")  # its Hessian of a Hessian costs more than all others together
    arguments = (ways, weights, t, inputs, fixed)
    point, direction = (moving, q, u), (relative, dq, du)
    forward, size = _forward(arguments, point, direction)
    reverse = _reverse(arguments, point, direction)
    # fourth-order central difference, every point through the same compiled function
    h = 1e-3 / (1 + float(jnp.max(jnp.abs(u), initial=0.0)))
    along = [_outcome(arguments, jax.tree.map(lambda x, d, k=k: x + k * h * d, point, direction)) for k in (-2, -1, 1, 2)]
    difference = (along[0] - 8 * along[1] + 8 * along[2] - along[3]) / (12 * h)
    by_way = lambda error: {name: float(e) for name, e in zip(ways, np.asarray(error / size), strict=True)}  # noqa: E731
    return [
        _check("jvp against vjp", by_way(jnp.abs(forward - reverse)), "reduction", note),
        _check("differences", by_way(jnp.abs(forward - difference)), "reduction", note),
    ]


@eqx.filter_jit
def _outcome(arguments, point) -> Float[Array, "reductions"]:
    """A random combination of accelerations and constraint forces, by every reduction."""
    ways, weights, t, inputs, fixed = arguments
    parameters, q, u = point
    scene = eqx.combine(parameters, fixed)
    equations, rows = equations_and_rows(scene, t, q, u, inputs)
    found = [_by(reductions(scene)[way], scene, t, q, u, equations, rows) for way in ways]
    return jnp.stack([weights @ jnp.concatenate([a.udot, a.constraint_force]) for a in found])


@eqx.filter_jit
def _forward(arguments, point, direction):
    value, change = jax.jvp(lambda point: _outcome(arguments, point), (point,), (direction,))
    return change, jnp.abs(value) + jnp.abs(change) + jnp.sum(jnp.abs(arguments[1])) * 1e-3


@eqx.filter_jit
def _reverse(arguments, point, direction):
    value, pull = jax.vjp(lambda point: _outcome(arguments, point), point)
    return jax.vmap(lambda way: _dot(pull(way)[0], direction))(jnp.eye(value.size, dtype=value.dtype))


def _dot(a, b):
    return sum(jnp.sum(x * y) for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True))
