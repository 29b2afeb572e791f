"""heyoka: Taylor series, compiled to machine code, on equations that the engine prints
(`jj.lower(scene).python_source()`); on the disc, by hand too.

Also the second computation behind most references, in extended precision. Source: F. Biscani and D. Izzo,
Mon. Not. R. Astron. Soc. 504 (2021) 2614.
"""

import functools

import jax.numpy as jnp
from baselines import heyoka_disc, heyoka_lowered
from baselines.heyoka_lowered import MISSING, heyoka

import jourdain_jax as jj
from work_precision_cases.curve import Curve, Prepared, Solved

TOLERANCES = tuple(10.0**-k for k in range(4, 16, 2))
FEWER = TOLERANCES[::2]  # every tolerance is compiled anew
# operations: from LARGE on fewer tolerances, from HUGE on in compact mode, without which compiling takes
# minutes
LARGE, HUGE = 100, 1000


@functools.cache
def states(problem):
    """Start of the program's state (all speeds, where rows are kept by multipliers), and where in it the
    minimal state is.
    """
    names = heyoka_lowered.names(problem.scene)
    start = heyoka_lowered.states(problem.scene, problem.state.q[None], problem.state.u[None])[0]
    return start, [names.index(name) for name in problem.minimal_names]


def system(problem):
    """The engine's scalar program as equations of heyoka."""
    return heyoka_lowered.equations(problem.scene)


def extended(problem):
    """Coordinates and speeds at the end, integrated in long double with a tolerance of 1e-18; the speeds that
    are not integrated follow from the rows.
    """
    start, minimal = states(problem)
    end = heyoka_lowered.extended(system(problem), problem.end, start[None])[0, minimal]
    return problem.named(*problem.completed(jnp.asarray(end)))


def _prepared(problem, equations, start, minimal, compact) -> Prepared:
    solvers = {}

    def run(tolerance):
        if tolerance not in solvers:
            solvers[tolerance] = heyoka.taylor_adaptive(
                equations, start.tolist(), tol=tolerance, fast_math=True, compact_mode=compact
            )
        solver = solvers[tolerance]
        solver.time = 0.0
        solver.state[:] = start
        found = solver.propagate_until(problem.end)
        return solver.state.copy(), found[3]

    return Prepared(run, lambda raw: Solved(y=raw[0][minimal], steps=float(raw[1])))


def on_engines_equations(problem) -> Prepared:
    """One integrator per tolerance."""
    return _prepared(
        problem, system(problem), *states(problem), compact=jj.lower(problem.scene).operations >= HUGE
    )


def on_disc_by_hand(problem) -> Prepared:
    """The disc's equations as an expert writes them."""
    return _prepared(problem, heyoka_disc.system(), problem.minimal_start, slice(None), compact=False)


def _missing(problem) -> Prepared:
    raise ImportError(MISSING)


def curves(problem) -> list[Curve]:
    """Those of the problem."""
    if heyoka is None:
        return [Curve("heyoka", TOLERANCES, _missing)]
    found = []
    if problem.name == "tilting-disc":
        found.append(Curve("heyoka, equations by hand", TOLERANCES, on_disc_by_hand, ("heyoka",)))
    tolerances = TOLERANCES if jj.lower(problem.scene).operations < LARGE else FEWER
    return [*found, Curve("heyoka, the engine's equations", tolerances, on_engines_equations, ("heyoka",))]
