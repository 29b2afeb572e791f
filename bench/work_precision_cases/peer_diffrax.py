"""diffrax as its users call it: dense matrices by autodiff (`baselines/dense.py`), and equations derived by hand on a flat array."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from baselines import dense
from baselines.hand_derived import HAND_DERIVED

from work_precision_cases.curve import TOLERANCES, Curve, Prepared, Solved
from work_precision_cases.ours import MAX_STEPS, stages
from work_precision_cases.problem import Problem

DENSE = {"tilting-disc": (dense.disc_rates, dense.DISC_PARAMETERS), "whipple-bicycle": (dense.bicycle_rates, dense.BICYCLE_PARAMETERS)}
BY_HAND = {
    "tilting-disc": "tilting-disc",
    "chaplygin-sleigh": "chaplygin-sleigh",
    "two-wheel-axle": "two-wheel-axle-coordinates",
    "ball-on-turntable": "ball-on-turntable",
}


def rates_by_hand(problem: Problem, stacked: bool = True):
    """`(t, y) -> dy/dt` of the minimal state, from `baselines/hand_derived.py`; `stacked`: in a flat array, otherwise in a tuple of scalars."""
    known, scene = HAND_DERIVED[BY_HAND[problem.name]], problem.scene
    parameters = {name: float(getattr(scene, name)) for name in known.parameters}
    n = len(known.coordinates)

    def rates(t, y):
        qdot, vdot = known.rates(parameters, t, tuple(y[:n]), tuple(y[n:]))
        return jnp.stack([*qdot, *vdot]) if stacked else (*qdot, *vdot)

    return rates


def final(rates, end: float, solver, tolerance, y0):
    """The end of one motion and the number of steps, by `diffrax.diffeqsolve`."""
    found = diffrax.diffeqsolve(
        diffrax.ODETerm(lambda t, y, _: rates(t, y)),
        solver,
        0.0,
        end,
        None,
        y0,
        stepsize_controller=diffrax.PIDController(rtol=tolerance, atol=tolerance),
        saveat=diffrax.SaveAt(t1=True),
        max_steps=MAX_STEPS,
    )
    return jax.tree.map(lambda y: y[0], found.ys), found.stats["num_steps"]


def _run(problem: Problem, rates, start, read) -> Prepared:
    solver = diffrax.Dopri8()
    compiled = jax.jit(lambda tolerance, y: final(rates, problem.end, solver, tolerance, y))
    y0 = jnp.asarray(start)

    def solved(raw):
        y, steps = np.asarray(raw[0]), float(raw[1])
        return read(y, steps, steps * stages(solver))

    return Prepared(lambda tolerance: jax.block_until_ready(compiled(jnp.asarray(tolerance), y0)), solved)


def by_dense(problem: Problem) -> Prepared:
    """All coordinates and all their rates, one saddle-point system per evaluation."""
    rates, parameters = DENSE[problem.name]
    n = len(problem.scene.coordinate_names.entries)
    start = np.concatenate([problem.state.q, problem.state.u])
    return _run(problem, lambda t, y: rates(parameters, t, y), start, lambda y, steps, rhs: Solved(q=y[:n], u=y[n:], steps=steps, rhs_evaluations=rhs))


def by_hand(problem: Problem) -> Prepared:
    """The minimal state in a flat array."""
    return _run(problem, rates_by_hand(problem), problem.minimal_start, lambda y, steps, rhs: Solved(y=y, steps=steps, rhs_evaluations=rhs))


def curves(problem: Problem, quick: bool) -> list[Curve]:
    """Those of the problem."""
    found = []
    if problem.name in BY_HAND:
        found.append(Curve("JAX by hand, diffrax Dopri8", "peer", TOLERANCES, "tolerance", by_hand))
    if problem.name in DENSE and not quick:
        found.append(Curve("dense autodiff, diffrax Dopri8", "peer", TOLERANCES, "tolerance", by_dense))
    return found
