"""heyoka: Taylor series, compiled to machine code, on equations that the engine prints (`jj.lower(scene).python_source()`); on the disc, by hand too.

Also the second computation behind most references, in extended precision. Source: F. Biscani and D. Izzo, Mon. Not. R. Astron. Soc. 504 (2021) 2614.
"""

import functools

import jax.numpy as jnp
import numpy as np
from baselines import heyoka_disc, heyoka_lowered
from baselines.heyoka_lowered import MISSING, heyoka

import jourdain_jax as jj
from jourdain_jax.equations.minimal import minimal_kinematics
from work_precision_cases.curve import Curve, Prepared, Solved
from work_precision_cases.problem import Problem

TOLERANCES = tuple(10.0**-k for k in range(4, 16, 2))
FEWER = TOLERANCES[::2]  # every tolerance is compiled anew
LARGE, HUGE = 100, 1000  # operations: from LARGE on fewer tolerances, from HUGE on in compact mode, without which compiling takes minutes


@functools.cache
def applies(problem: Problem) -> bool:
    """Whether the scene has a scalar program to take the equations from."""
    try:
        return jj.lower(problem.scene) is not None
    except jj.NotLowered:
        return False


@functools.cache
def states(problem: Problem) -> tuple[tuple[str, ...], np.ndarray, list[int]]:
    """Names and start of the program's state (all speeds, where rows are kept by multipliers), and where in it the minimal state is."""
    program = jj.lower(problem.scene)
    names = (*program.coordinates, *(program.speeds[i] for i in program.independent))
    start = np.concatenate([problem.state.q, np.asarray(problem.state.u)[list(program.independent)]])
    return names, start, [names.index(name) for name in problem.minimal_names]


def system(problem: Problem) -> list:
    """The engine's scalar program as equations of heyoka."""
    return heyoka_lowered.equations(problem.scene)


def operations(problem: Problem) -> int:
    """Of the engine's program."""
    return jj.lower(problem.scene).operations


def extended(problem: Problem) -> dict[str, float]:
    """Coordinates and speeds at the end, integrated in long double with a tolerance of 1e-18; the speeds that are not integrated follow from the rows."""
    names, start, _ = states(problem)
    start = start.astype(np.longdouble)
    solver = heyoka.taylor_adaptive(system(problem), start, tol=np.longdouble("1e-18"), fp_type=np.longdouble, compact_mode=True)
    solver.propagate_until(np.longdouble(problem.end))
    found = dict(zip(names, solver.state.astype(float), strict=True))
    scene, independent = problem.scene, jj.lower(problem.scene).independent
    q, v = (jnp.array([found[name] for name in which]) for which in (names[: len(names) - len(independent)], names[len(names) - len(independent) :]))
    if len(independent) < len(scene.speed_names):
        v = minimal_kinematics(scene, tuple(independent), jj.structure_of(scene).kept_rows, jnp.asarray(problem.end), q, v).u
    return dict(zip(scene.speed_names.entries, np.asarray(v), strict=True)) | found


def _prepared(problem: Problem, equations: list, start: np.ndarray, minimal: list[int], compact: bool) -> Prepared:
    solvers: dict = {}

    def run(tolerance: float):
        if tolerance not in solvers:
            solvers[tolerance] = heyoka.taylor_adaptive(equations, start.tolist(), tol=tolerance, fast_math=True, compact_mode=compact)
        solver = solvers[tolerance]
        solver.time = 0.0
        solver.state[:] = start
        found = solver.propagate_until(problem.end)
        return solver.state.copy(), found[3]

    return Prepared(run, lambda raw: Solved(y=raw[0][minimal], steps=float(raw[1])))


def on_engines_equations(problem: Problem) -> Prepared:
    """One integrator per tolerance."""
    _, start, minimal = states(problem)
    return _prepared(problem, system(problem), start, minimal, compact=operations(problem) >= HUGE)


def on_disc_by_hand(problem: Problem) -> Prepared:
    """The disc's equations as an expert writes them."""
    start = problem.minimal_start
    return _prepared(problem, heyoka_disc.system(), start, list(range(len(start))), compact=False)


def _missing(problem: Problem) -> Prepared:
    raise ImportError(MISSING)


def curves(problem: Problem) -> list[Curve]:
    """Those of the problem."""
    if heyoka is None:
        return [Curve("heyoka", "peer", TOLERANCES, "tolerance", _missing)]
    found = []
    if problem.name == "tilting-disc":
        found.append(Curve("heyoka, equations by hand", "peer", TOLERANCES, "tolerance", on_disc_by_hand, ("heyoka",)))
    if applies(problem):
        tolerances = TOLERANCES if operations(problem) < LARGE else FEWER
        found.append(Curve("heyoka, the engine's equations", "peer", tolerances, "tolerance", on_engines_equations, ("heyoka",)))
    return found
