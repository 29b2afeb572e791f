"""The loop over steps of one of our own methods, explicit (`explicit_steps.py`) or implicit (`implicit_steps.py`), with little besides.

A batch of lanes runs in lockstep, from one time asked for to the next (`erk_step`). Every lane carries its own result code, and a lane that has ended
stands still. A lane whose step ended beyond a stop event goes back to it in further steps of the same loop, so that there is one copy of the rates to
compile (`event_search`). In reverse mode the loop keeps a record of its steps, which are then gone back over (`recorded_adjoint`).
"""

from typing import Literal

import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PyTree

from jourdain_jax.motion.integrators import recorded_adjoint
from jourdain_jax.motion.integrators.erk_step import Progress, advanced, begun, running
from jourdain_jax.motion.integrators.explicit_steps import Method, code_at_end
from jourdain_jax.motion.integrators.implicit_steps import ImplicitMethod
from jourdain_jax.motion.integrators.problem import Problem


def integrate(
    problem: Problem, method: Method | ImplicitMethod, y0: PyTree, t0, goals: Float[Array, "times *lanes"], dt0, kind: Literal["forward", "reverse"]
) -> tuple[PyTree, Bool[Array, "times *lanes"], Progress]:
    """States at the goals (monotonic; what was not reached repeats the last state), which were reached, and where the lane ended.

    `kind`: which mode of differentiation it is for; "forward" to any order, "reverse" to the first.
    """
    if kind == "forward":
        ys, reached, end = _motion(problem, method, y0, t0, goals, dt0)
    else:
        ys, reached, end = recorded_adjoint.motion(_motion, problem, method, y0, t0, goals, dt0)
    return ys, reached, eqx.tree_at(lambda p: p.code, end, code_at_end(end.code, end.h, end.accepted, end.t - t0))


def _motion(problem: Problem, method: Method | ImplicitMethod, y0: PyTree, t0, goals, dt0) -> tuple[PyTree, Bool[Array, "times *lanes"], Progress]:
    direction = jnp.sign(goals[-1] - t0)

    def to_goal(progress: Progress, goal):
        def step(p):
            return advanced(problem, method, p, goal, goals[-1], direction)

        end = eqxi.while_loop(lambda p: jnp.any(running(p, goal)), step, progress, kind="lax")
        return end, (end.y, end.t == goal)

    end, (ys, reached) = jax.lax.scan(to_goal, begun(problem, y0, t0, dt0, direction), goals)
    return ys, reached, end
