"""Find periodic motions by multiple shooting over one period, and their Floquet multipliers.

    z_k -> f_k(z_k),  k = 1 .. n:  motions over equal parts of the period T,   z = (q, u)
    R(z_1, .., z_n, T) = ( g(z_1), phi(z_1),  f_k(z_k) - z_{k+1},  K (f_n(z_n) - z_1),  c(z_1) )

g, phi: constraints; K: selects the entries of z other than ignorable coordinates; c: value of an event, if T
is unknown. Ignorable coordinates may shift by the same amount in every period. With small motions dz_k = B_k
x_k that satisfy the constraints, and L_k B_k = 1,

    x_{k+1} = M_k x_k,  M_k = L_{k+1} (df_k/dz_k) B_k:       the multipliers are the eigenvalues of M_n .. M_1

The multipliers are computed as n-th powers of the eigenvalues of the cyclic matrix with the blocks M_k, so
that small multipliers keep their digits beside large ones. R has redundant but consistent rows. Derivatives
with respect to parameters use the pseudo-inverse of its Jacobian at the root. Source: R. Seydel, Practical
Bifurcation and Stability Analysis (2010), chapter 7; multipliers without products: T. F. Fairgrieve and A. D.
Jepson, SIAM J. Numer. Anal. 28 (1991) 1446.
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, Unpack

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex

from jourdain_jax.analysis.families.equations import Look, Modes, Motions, Vector
from jourdain_jax.analysis.families.multiple_shooting import Shooting, Unknowns
from jourdain_jax.analysis.families.special_points import SURE
from jourdain_jax.analysis.motion_derivatives import instant_of, unseen
from jourdain_jax.calculus.compilation import compiled_quickly
from jourdain_jax.calculus.reals import (
    Flag,
    Number,
    Scalar,
    all_finite,
    checked_real,
    checked_whole,
    known_numbers,
    largest,
)
from jourdain_jax.calculus.roots import smooth_root
from jourdain_jax.equations.rows import names_of_events
from jourdain_jax.integrate.explicit_steps import diffrax
from jourdain_jax.integrate.inputs import as_inputs, inputs_at
from jourdain_jax.integrate.state import State, state_of
from jourdain_jax.motion.model import modelled
from jourdain_jax.motion.options import SPAN, MotionFields, Options, as_options
from jourdain_jax.motion.simulate import as_state
from jourdain_jax.scene.arguments import BuiltFor, as_scene, shown_from_users_lines
from jourdain_jax.scene.coordinates import Labels, as_names, check_name, check_names
from jourdain_jax.scene.printing import Printed, complex_numbers
from jourdain_jax.scene.scene import Scene, state_names
from jourdain_jax.structure.structure import structure_of


class PeriodicMotion(Printed, eqx.Module):
    """Motion that repeats itself after each period. `orbit["yaw_rate"]` is the value at the start of a
    period.

    `jj.simulate(scene, orbit.state, t1=orbit.period)` computes the motion.
    """

    state: State  # at the start of a period
    period: Scalar  # s
    shift: dict[str, Scalar]  # change per period of ignorable coordinates and of those with a given shift
    multipliers: Complex[Array, "multipliers"]  # growth of small motions per period, largest first
    residual: Scalar  # largest residual of the equations, in units of the unknowns' sizes
    converged: Flag
    by: "Shooting"  # the equations
    unknowns: Unknowns  # states at the starts of the pieces, and the period

    def __getitem__(self, name: str) -> Scalar:
        """Return a coordinate or speed at the start, by name."""
        return self.state[name]

    @property
    def stable(self) -> Flag:
        """Return whether no small motion grows. Multipliers that belong to symmetries and conserved
        quantities equal one up to round-off, and count as not growing.
        """
        return jnp.all(jnp.abs(self.multipliers) <= 1 + SURE)

    def _text(self) -> str:
        if self.residual.ndim:
            return (
                f"{int(self.converged.sum())} of {self.converged.size} periodic motions found\n{self.state}"
            )
        head = (
            f"periodic motion of {float(self.period):.9g} s"
            if self.converged
            else "no periodic motion found near the guess"
        )
        shifts = ", ".join(f"{name} by {float(value):.6g}" for name, value in self.shift.items())
        lines = [
            f"{head}: residual {float(self.residual):.1e}",
            *([f"in a period, it shifts {shifts}"] if shifts else []),
            str(self.state),
            f"multipliers: {', '.join(complex_numbers(self.multipliers))} "
            f"({'stable' if self.stable else 'unstable'})",
        ]
        return "\n".join(lines)


@shown_from_users_lines
def periodic(
    scene: Scene | BuiltFor,
    guess: "State | Mapping[str, Any]",
    period: Number,
    *,
    until: str | None = None,
    held: str | Labels = (),
    shift: Mapping[str, Number] | None = None,
    pieces: int = 4,
    options: Options | None = None,
    **by_name: Unpack[MotionFields],
) -> PeriodicMotion:
    """Return the periodic motion near a guess, with its Floquet multipliers.

        torque = {"torque": lambda t: 0.6 * jnp.sin(2 * t)}
        orbit = jj.periodic(sleigh, {"forward": 0.4}, jnp.pi, inputs=torque)
        orbit.multipliers, orbit.stable, orbit.shift["heading"]
        jax.jacfwd(lambda drag: jj.periodic(sleigh.replace(drag=drag), guess, jnp.pi).multipliers)(0.15)

    **Arguments**

    - `guess`: a state near the motion: a `State`, or named values as for `simulate`.
    - `period`: the period in s. Without `until` it is fixed, and must be the period of the loads or inputs.
      With `until`, a rough value is enough.
    - `until`: the name of an event of the scene whose value is zero at the start and end of a period. The
      period is then found as well. Nothing in the scene may depend on time.
    - `held`: names of coordinates and speeds that keep the value of the guess at the start. It is needed if
      there are neighbouring periodic motions.
    - `shift`: changes of coordinates per period by name, such as `{"crank": 2 * jnp.pi}` for a rotating
      crank.
    - `pieces`: number of equal parts of the period, which are integrated as a batch. Increase it if
      disturbances grow by more than 1e3 in a part.
    - `options`, `by_name`: as in `simulate`, including `inputs`; the default tolerance is 1e-12.

    **Returns** a `PeriodicMotion`. Check `converged` and `residual`, because a failed search raises no error.
    Stop events do not end the motion. However, a motion whose events, sampled at 100 times in the period,
    become negative does not count as converged. Runs under `jit` and `vmap`. Differentiable with respect to
    the scene's parameters where the motion is a smooth function of them and its multipliers are distinct.

    **Raises** ValueError for an unknown name or a period that is not positive; TypeError for unknown options.
    """
    built, scene = scene, as_scene(scene)
    inputs = as_inputs(scene, by_name.pop("inputs", None))
    tolerances = {"rtol": 1e-12, "atol": 1e-12} if options is None else {}
    beside = "one `period` is integrated, stop events are passed, and neither work nor retries are needed"
    options = as_options(
        options,
        {**tolerances, **by_name},
        "periodic",
        dict.fromkeys((*SPAN, "events", "work", "retry"), beside),
        built,
    )
    # the solver is chosen here, because tolerances are traced below
    options = replace(options, solver=options.solver or diffrax.Dopri8(), events=False, work=False)
    period = checked_real(period, "`period`", (), advice="give a time in s")
    if not np.all(known_numbers(period) > 0) or not all_finite(known_numbers(period)):
        raise ValueError(f"`period` is {period}, expected a positive time in s")
    checked_whole(pieces, "`pieces`", 1, expected="of at least 1")
    events, held, entries = names_of_events(scene), as_names(held), scene.coordinate_names.entries
    names = entries + scene.speed_names.entries
    who, shift = f"`{type(scene).__name__}`", dict(shift or {})
    if until is not None:
        check_name(until, events, f"`until` names `{until}`, which is not an event of {who}")
        if timed := structure_of(scene).timed:
            raise ValueError(
                f"`until` needs a scene in which nothing depends on time, but in {who} "
                f"{' and '.join(timed)} do; omit `until`"
            )
    for given, valid in ((held, names), (shift, entries)):
        check_names(given, valid, f"{who} has no `{{}}` to hold or to shift")
    start = as_state(modelled(built), guess, what="guess", inputs=inputs_at(inputs, 0.0))
    instant = instant_of(built, structure_of(scene).independent)
    carried = unseen(instant, scene)
    kept = tuple(k for k, name in enumerate(names) if name not in carried)
    free = tuple(k for k in kept if names[k] not in held)
    shifts = (checked_real(shift.get(name, 0.0), f"`shift` of `{name}`", ()) for name in names)
    shifted = jnp.stack([*shifts]).astype(start.q.dtype)
    event, t = None if until is None else events.index(until), jnp.asarray(start.t)
    problem = Shooting(scene, t, inputs, options, shifted, instant, pieces, event, kept, free, tuple(shift))
    return _found(problem, start, period.astype(start.q.dtype))


@compiled_quickly
def _found(problem: Shooting, start: State, period: Scalar) -> PeriodicMotion:
    t, begun = problem.t, jnp.concatenate([start.q, start.u])
    still, z, given = jax.lax.stop_gradient((problem, begun, period))
    motion = still.motion(t, z, t + given * np.arange(1, problem.pieces + 1) / problem.pieces)
    zs = jnp.vstack([z, jnp.hstack([motion.q, motion.u])[:-1]])
    guess, held = jnp.append(jnp.ravel(zs), given), jnp.append(jnp.tile(begun, problem.pieces), period)
    size = jnp.where(problem.is_unknown, jnp.append(jnp.tile(problem.sizes, problem.pieces), given), 0.0)
    rows = lambda x: problem.rows(x, problem.ends(x))
    tolerance = 10.0 * jnp.asarray(problem.options.rtol)
    x = smooth_root(lambda x: still.look(x)[:2], rows, guess, held, size, tolerance, 1e-9)
    zs, period = problem.pieces_of(x)
    R, _, (D, ends) = problem.look(x)
    residual = largest(R)
    others = [k for k in range(len(names_of_events(problem.scene))) if k != problem.until]
    goes_on = jnp.array(True)
    if others:
        whole = jax.lax.stop_gradient(problem).motion(t, zs[0], t + period * np.linspace(0.01, 1.0, 100))
        values = jax.vmap(problem.events)(whole.ts, jnp.concatenate([whole.q, whole.u], axis=1))
        goes_on = jnp.all(values[:, np.array(others)] >= 0)
    names = problem.scene.coordinate_names.entries
    shifts = {
        name: ends[-1, k] - zs[0, k]
        for k, name in enumerate(names)
        if k not in problem.kept or name in problem.shifted
    }
    state = state_of(problem.scene, t, *problem.split(zs[0]), start.moved_q, start.moved_u, residual)
    multipliers, converged = problem.multipliers(x, D, ends), (residual < 1e-8) & goes_on
    return PeriodicMotion(state, period, shifts, multipliers, residual, converged, problem, x)


class OrbitEquations(Motions):
    """Equations of the periodic motions of one scene: the residual R, its derivatives and the multipliers as
    functions of z, which are the unknowns of a periodic motion and one varying parameter.
    """

    what, modes = "periodic motions", "multipliers"
    growth = staticmethod(lambda modes: np.abs(modes) - 1)
    crossing = staticmethod(
        lambda mode: "pair on the unit circle" if mode.imag else f"multiplier {np.sign(mode.real):.0f}"
    )

    def __init__(self, scene: Scene, orbit: PeriodicMotion, vary: Labels, held: Labels) -> None:
        self.scene = scene
        self.vary = vary
        self.problem = replace(orbit.by, scene=scene)
        self.t = orbit.state.t
        names = state_names(scene)
        pieces = [f"{name} in piece {k + 1}" if k else name for k in range(orbit.by.pieces) for name in names]
        self.given = np.append(np.asarray(orbit.unknowns), [float(getattr(scene, name)) for name in vary])
        self.by_name = {name: k for k, name in enumerate((*pieces, "period", *vary))}
        self.places = np.flatnonzero(np.append(orbit.by.is_unknown, np.ones(len(vary), bool)))
        all_sizes = np.append(np.tile(orbit.by.sizes, orbit.by.pieces), np.abs(self.given[len(pieces) :]))
        self.size = np.where(all_sizes == 0, 1.0, all_sizes)[self.places]
        self.begin(held)

    def __call__(self, z: Vector) -> Look:
        """Return the equations, their derivatives and the multipliers at z."""
        R, J, multipliers = map(np.asarray, _looked(self.problem, self.vary, self.at(z)))
        return self.with_held(R, J[:, self.places], z, (multipliers,))

    @staticmethod
    def eigenvalues(look: Look, tangent: Vector) -> Modes:
        """Return the multipliers."""
        return look.small[0]


@compiled_quickly
def _looked(problem: Shooting, vary: Labels, numbers: Unknowns) -> tuple[Array, Array, Array]:
    """Return R, its derivatives with respect to all numbers, and the multipliers."""
    x, parameters = jnp.split(numbers, [len(numbers) - len(vary)])
    moved = lambda values: replace(
        problem, scene=problem.scene.replace(**dict(zip(vary, values, strict=True)))
    )
    R, J, (D, ends) = moved(parameters).look(x)
    by_parameters = jax.jacfwd(lambda values: moved(values).rows(x, moved(values).ends(x)))(parameters)
    return R, jnp.concatenate([J, by_parameters], axis=1), moved(parameters).multipliers(x, D, ends)
