"""diffrax as its users call it, on equations derived by hand on a flat array."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from baselines.hand_derived import HAND_DERIVED

from work_precision_cases.curve import TOLERANCES, Curve, Prepared, Solved
from work_precision_cases.ours import MAX_STEPS
from work_precision_cases.problem import Problem

BY_HAND = ("tilting-disc", "chaplygin-sleigh")


def rates_by_hand(problem: Problem, stacked: bool = True):
    """`(t, y) -> dy/dt` of the minimal state, from `baselines/hand_derived.py`; `stacked`: in a flat array,
    otherwise in a tuple of scalars.
    """
    known, scene = HAND_DERIVED[problem.name], problem.scene
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


def by_hand(problem: Problem) -> Prepared:
    """The minimal state in a flat array."""
    rates, solver, y0 = rates_by_hand(problem), diffrax.Dopri8(), jnp.asarray(problem.minimal_start)
    compiled = jax.jit(lambda tolerance, y: final(rates, problem.end, solver, tolerance, y))
    read = lambda raw: Solved(y=np.asarray(raw[0]), steps=float(raw[1]))
    return Prepared(lambda tolerance: jax.block_until_ready(compiled(jnp.asarray(tolerance), y0)), read)


def curves(problem: Problem) -> list[Curve]:
    """Those of the problem."""
    return [Curve("JAX by hand, diffrax Dopri8", TOLERANCES, by_hand)] if problem.name in BY_HAND else []
