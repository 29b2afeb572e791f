"""diffrax as its users call it, on equations derived by hand on a flat array."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from baselines.hand_derived import HAND_DERIVED

from work_precision_cases.curve import TOLERANCES, Curve, Prepared, Solved
from work_precision_cases.ours import MAX_STEPS

BY_HAND = ("tilting-disc", "chaplygin-sleigh")


def rates_by_hand(problem, stacked=True):
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


def motion(problem, stacked=True):
    """A function of a tolerance and a start: the end of the motion and the number of steps."""
    rates = rates_by_hand(problem, stacked)

    def end(tolerance, y0):
        found = diffrax.diffeqsolve(
            diffrax.ODETerm(lambda t, y, _: rates(t, y)),
            diffrax.Dopri8(),
            0.0,
            problem.end,
            None,
            y0,
            stepsize_controller=diffrax.PIDController(rtol=tolerance, atol=tolerance),
            saveat=diffrax.SaveAt(t1=True),
            max_steps=MAX_STEPS,
        )
        return jax.tree.map(lambda y: y[0], found.ys), found.stats["num_steps"]

    return end


def by_hand(problem) -> Prepared:
    """The minimal state in a flat array."""
    compiled, y0 = jax.jit(motion(problem)), jnp.asarray(problem.minimal_start)
    read = lambda raw: Solved(y=np.asarray(raw[0]), steps=float(raw[1]))
    return Prepared(lambda tolerance: jax.block_until_ready(compiled(jnp.asarray(tolerance), y0)), read)


def curves(problem) -> list[Curve]:
    """Those of the problem."""
    return [Curve("JAX by hand, diffrax Dopri8", TOLERANCES, by_hand)] if problem.name in BY_HAND else []
