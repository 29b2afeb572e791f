"""The engine: all solvers with the default reduction, all reductions and forms of the state with one solver."""

import dataclasses
from collections.abc import Callable

import diffrax
import jax
import jax.numpy as jnp
import numpy as np

import jourdain_jax as jj
from jourdain_jax.motion.integrators.taylor import order_for
from work_precision_cases.curve import TOLERANCES, Curve, NotApplicable, Prepared, Solved
from work_precision_cases.problem import Problem

REDUCTIONS = ("privileged", "qr", "svd", "kkt", "udwadia-kalaba", "gibbs-appell")
COARSE = TOLERANCES[::2]  # 1e-4, 1e-6, ..., 1e-12: of methods that are slow
IMPLICIT_TOLERANCES = (1e-4, 1e-6, 1e-8, 1e-10)
MAX_STEPS = 200_000
CALLS_BEFORE = 10
DEFAULT = "simulate, as it comes"


def stages(solver) -> int | None:
    """Evaluations per step of an explicit method in the engine's own loop; None for implicit ones, whose inner iterations are not counted."""
    if not isinstance(solver, diffrax.AbstractERK):
        return None
    tableau = solver.tableau
    return len(tableau.b_sol) - int(tableau.fsal and tableau.b_error[-1] == 0)


def _read(solver) -> Callable[[tuple], Solved]:
    def read(raw):
        q, u, accepted, rejected, result = raw
        steps, each = float(accepted + rejected), stages(solver)
        failed = "" if int(result) == 0 else jj.SimulationError.__name__ + f", code {int(result)}"
        return Solved(q=np.asarray(q), u=np.asarray(u), steps=steps, rhs_evaluations=None if each is None else steps * each, failed=failed)

    return read


def _by_simulate(solver, stepped: bool = False, **options) -> Callable[[Problem], Prepared]:
    """`simulate` under the user's `jit`, the setting and the start traced: compiled once for all settings."""

    def prepare(problem: Problem) -> Prepared:
        scene, ends = problem.scene, jnp.array([problem.end])

        @jax.jit
        def compiled(setting, start):
            how = {"solver": solver(step=setting)} if stepped else {"solver": solver, "rtol": setting, "atol": setting}
            motion = jj.simulate(scene, start, ts=ends, events=False, max_steps=MAX_STEPS, **how, **options)
            return motion.q_end, motion.u_end, motion.accepted, motion.rejected, motion.result

        start = dataclasses.replace(problem.state)
        try:
            compiled.lower(jnp.asarray(0.01), start)
        except (ValueError, TypeError) as refused:
            raise NotApplicable(str(refused).splitlines()[0]) from refused
        return Prepared(lambda setting: jax.block_until_ready(compiled(jnp.asarray(setting), start)), _read(solver))

    return prepare


def _by_series(problem: Problem) -> Prepared:
    """As `_by_simulate`, by Taylor series of the order for each tolerance."""
    prepared = {TOLERANCES[-1]: _by_simulate(jj.Taylor(order_for(TOLERANCES[-1])))(problem)}  # refused where the series are too long

    def run(tolerance: float):
        if tolerance not in prepared:
            prepared[tolerance] = _by_simulate(jj.Taylor(order_for(tolerance)))(problem)
        return prepared[tolerance].run(tolerance)

    return Prepared(run, _read(jj.Taylor()))


def as_it_comes(problem: Problem) -> Prepared:
    """`simulate` called from Python with nothing chosen but the tolerance, one saved time; its Python is part of the time.

    The engine compiles some of what precedes the motion only after several calls: hence the calls before anything is timed.
    """

    def run(tolerance: float):
        motion = jj.simulate(problem.scene, problem.state, ts=[problem.end], rtol=tolerance, atol=tolerance)
        return jax.block_until_ready((motion.q_end, motion.u_end, motion.accepted, motion.rejected, motion.result)), tolerance

    for _ in range(CALLS_BEFORE):
        run(TOLERANCES[0])

    def read(raw):
        return _read(diffrax.Tsit5() if raw[1] >= 1e-6 else diffrax.Dopri8())(raw[0])

    return Prepared(run, read)


def _tolerance(name: str, group: str, solver, settings=TOLERANCES, **options) -> Curve:
    return Curve(name, "ours", settings, "tolerance", _by_simulate(solver, **options), group=group)


def _step(name: str, problem: Problem, solver, **options) -> Curve:
    return Curve(name, "ours", problem.steps, "step (s)", _by_simulate(solver, stepped=True, **options), group="solver")


def curves(problem: Problem, quick: bool) -> list[Curve]:
    """Those of the problem; `quick`: explicit solvers, one reduction, the full state, and the implicit midpoint rule."""
    found = [
        Curve(DEFAULT, "ours", COARSE[1:4:2] if quick else COARSE, "tolerance", as_it_comes, group="solver"),
        _tolerance("Tsit5", "solver", diffrax.Tsit5()),
        _tolerance("Dopri8", "solver", diffrax.Dopri8()),
    ]
    found.append(Curve("Taylor", "ours", TOLERANCES, "tolerance", _by_series, group="solver"))
    if not problem.large:
        found.append(_step("implicit midpoint", problem, jj.ImplicitMidpoint))
    given = _tolerance("minimal state, not projected, Dopri8", "state", diffrax.Dopri8(), formulation=jj.Formulation(stabilisation=None))
    full = _tolerance("full state, projected, Dopri8", "state", diffrax.Dopri8(), COARSE, formulation=jj.Formulation("full"))
    if quick:
        return [*found, given, full]
    if not problem.large:
        found.append(_tolerance("Kvaerno5", "solver", diffrax.Kvaerno5(), IMPLICIT_TOLERANCES, work=False))
    if problem.structure_preserving:
        found += [_step("discrete Lagrange-d'Alembert", problem, jj.DiscreteLagrangeDAlembert), _step("discrete gradient", problem, jj.DiscreteGradient)]
    loose = _tolerance("full state, not projected, Dopri8", "state", diffrax.Dopri8(), COARSE, formulation=jj.Formulation("full", stabilisation=None))
    # the privileged reduction is the default one, here with dense matrices
    reductions = ("privileged", "kkt") if problem.large else REDUCTIONS
    reduced = [
        _tolerance(f"{name} reduction, Dopri8", "reduction", diffrax.Dopri8(), COARSE, formulation=jj.Formulation(reduction=name)) for name in reductions
    ]
    return [*found, given, full, loose, *reduced]
