"""The engine: explicit solvers and Taylor series, as compiled under the user's `jit`, and `simulate` as most
people would call it.
"""

from functools import cache

import diffrax
import jax
import jax.numpy as jnp
import numpy as np

import jourdain_jax as jj
from jourdain_jax.integrate.explicit_steps import order_for
from work_precision_cases.curve import TOLERANCES, Curve, NotApplicable, Prepared, Solved

COARSE = TOLERANCES[::2]  # 1e-4, 1e-6, ..., 1e-12
MAX_STEPS = 200_000


def _end(problem, start, tolerance, **options):
    motion = jj.simulate(
        problem.scene, start, ts=jnp.array([problem.end]), rtol=tolerance, atol=tolerance, **options
    )
    return motion.q_end, motion.u_end, motion.accepted, motion.rejected, motion.result


def _read(raw) -> Solved:
    q, u, accepted, rejected, result = raw
    failed = "" if int(result) == 0 else jj.SimulationError.__name__ + f", code {int(result)}"
    return Solved(q=np.asarray(q), u=np.asarray(u), steps=float(accepted + rejected), failed=failed)


def _by_simulate(solver, **options):
    """`simulate` under the user's `jit`, the setting and the start traced: compiled once for all settings."""

    def prepare(problem) -> Prepared:
        how = {"events": False, "max_steps": MAX_STEPS, "solver": solver} | options
        compiled = jax.jit(lambda tolerance, start: _end(problem, start, tolerance, **how))
        try:
            compiled.lower(jnp.asarray(0.01), problem.state)
        except (ValueError, TypeError) as refused:
            raise NotApplicable(str(refused).splitlines()[0]) from refused
        run = lambda setting: compiled(jnp.asarray(setting), problem.state)
        return Prepared(lambda setting: jax.block_until_ready(run(setting)), _read)

    return prepare


def _by_series(problem) -> Prepared:
    """As `_by_simulate`, by Taylor series of the order for each tolerance."""
    prepared = cache(lambda tolerance: _by_simulate(jj.Taylor(order_for(tolerance)))(problem))
    prepared(TOLERANCES[-1])  # refused where the series are too long
    return Prepared(lambda tolerance: prepared(tolerance).run(tolerance), _read)


def as_it_comes(problem) -> Prepared:
    """`simulate` called from Python with nothing chosen but the tolerance, one saved time; its Python is part
    of the time.

    The engine compiles some of what precedes the motion only after several calls: hence the calls before
    anything is timed.
    """

    run = lambda tolerance: jax.block_until_ready(_end(problem, problem.state, tolerance))
    for _ in range(10):
        run(TOLERANCES[0])
    return Prepared(run, _read)


def curves(problem, quick) -> list[Curve]:
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
