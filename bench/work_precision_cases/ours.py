"""The engine: explicit solvers and Taylor series, as compiled under the user's `jit`, and `simulate` as most
people would call it.
"""

import dataclasses
from collections.abc import Callable

import diffrax
import jax
import jax.numpy as jnp
import numpy as np

import jourdain_jax as jj
from jourdain_jax.integrate.explicit_steps import order_for
from work_precision_cases.curve import TOLERANCES, Curve, NotApplicable, Prepared, Solved
from work_precision_cases.problem import Problem

COARSE = TOLERANCES[::2]  # 1e-4, 1e-6, ..., 1e-12
MAX_STEPS = 200_000


def _read(raw) -> Solved:
    q, u, accepted, rejected, result = raw
    failed = "" if int(result) == 0 else jj.SimulationError.__name__ + f", code {int(result)}"
    return Solved(q=np.asarray(q), u=np.asarray(u), steps=float(accepted + rejected), failed=failed)


def _by_simulate(solver, **options) -> Callable[[Problem], Prepared]:
    """`simulate` under the user's `jit`, the setting and the start traced: compiled once for all settings."""

    def prepare(problem: Problem) -> Prepared:
        scene, ends = problem.scene, jnp.array([problem.end])

        @jax.jit
        def compiled(setting, start):
            motion = jj.simulate(
                scene,
                start,
                ts=ends,
                events=False,
                max_steps=MAX_STEPS,
                solver=solver,
                rtol=setting,
                atol=setting,
                **options,
            )
            return motion.q_end, motion.u_end, motion.accepted, motion.rejected, motion.result

        start = dataclasses.replace(problem.state)
        try:
            compiled.lower(jnp.asarray(0.01), start)
        except (ValueError, TypeError) as refused:
            raise NotApplicable(str(refused).splitlines()[0]) from refused
        return Prepared(lambda setting: jax.block_until_ready(compiled(jnp.asarray(setting), start)), _read)

    return prepare


def _by_series(problem: Problem) -> Prepared:
    """As `_by_simulate`, by Taylor series of the order for each tolerance."""
    prepared = {
        TOLERANCES[-1]: _by_simulate(jj.Taylor(order_for(TOLERANCES[-1])))(problem)
    }  # refused where the series are too long

    def run(tolerance: float):
        if tolerance not in prepared:
            prepared[tolerance] = _by_simulate(jj.Taylor(order_for(tolerance)))(problem)
        return prepared[tolerance].run(tolerance)

    return Prepared(run, _read)


def as_it_comes(problem: Problem) -> Prepared:
    """`simulate` called from Python with nothing chosen but the tolerance, one saved time; its Python is part
    of the time.

    The engine compiles some of what precedes the motion only after several calls: hence the calls before
    anything is timed.
    """

    def run(tolerance: float):
        motion = jj.simulate(problem.scene, problem.state, ts=[problem.end], rtol=tolerance, atol=tolerance)
        return jax.block_until_ready(
            (motion.q_end, motion.u_end, motion.accepted, motion.rejected, motion.result)
        )

    for _ in range(10):
        run(TOLERANCES[0])
    return Prepared(run, _read)


def curves(problem: Problem, quick: bool) -> list[Curve]:
    """Those of the problem."""
    unprojected = _by_simulate(diffrax.Dopri8(), formulation=jj.Formulation(stabilisation=None))
    ways = {
        "Tsit5": _by_simulate(diffrax.Tsit5()),
        "Dopri8": _by_simulate(diffrax.Dopri8()),
        "Taylor": _by_series,
        "minimal state, not projected, Dopri8": unprojected,
    }
    found = [Curve("simulate, as it comes", COARSE[1:4:2] if quick else COARSE, as_it_comes, kind="ours")]
    return [*found, *(Curve(name, TOLERANCES, prepare, kind="ours") for name, prepare in ways.items())]
