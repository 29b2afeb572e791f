"""What a solver and its control of steps ask for besides rates: a form of the state, constant steps, states saved at ends of steps only, a clock."""

import jax.numpy as jnp

from jourdain_jax.motion.integrators.of_diffrax import diffrax, discrete_gradient, fixed_step
from jourdain_jax.motion.integrators.tableaus import Method
from jourdain_jax.motion.vector_fields.field import VectorField
from jourdain_jax.scene.scene import Scene


def fitted(solver, scene: Scene, field: VectorField, asked: str) -> VectorField:
    """The form of the state that the solver integrates; a ValueError where it does not apply to the scene. `asked`: the `state` of its `Formulation`."""
    return solver.fitted(scene, field, asked) if takes_even_steps(solver) else field


def takes_even_steps(solver) -> bool:
    """Whether it is a structure-preserving solver, which takes steps of one length."""
    return not isinstance(solver, Method | None) and isinstance(solver, fixed_step.FixedStepSolver)


def may_be_full(solver) -> bool:
    """Whether a motion that lost its privileged speeds may go on with the full state."""
    return isinstance(solver, Method | None) or not isinstance(solver, discrete_gradient.DiscreteGradient)


def check_solver(solver, controller, dt0, saveat, max_step) -> None:
    """ValueError for options that do not go with a structure-preserving solver, or with a control of steps of the user's; others pass."""
    if max_step is not None and (controller is not None or takes_even_steps(solver)):
        raise ValueError(f"`max_step` bounds the steps of the default control: give {'`dtmax` to `stepsize_controller`' if controller else '`dt0`, the step'}")
    if not takes_even_steps(solver):
        return
    name = type(solver).__name__
    if saveat is not None and saveat.subs.ts is not None:
        raise ValueError(f"`{name}` has states at ends of steps only: give times to save at as `ts`, not in `saveat`")
    if isinstance(controller, diffrax.AbstractAdaptiveStepSizeController):
        raise ValueError(
            f"`{name}` takes steps of one length and has no error estimate, which `stepsize_controller` = {type(controller).__name__} needs; leave it away "
            "and give `dt0`, the step in s"
        )
    if dt0 is None and not isinstance(controller, diffrax.StepTo):
        raise ValueError(f"`{name}` takes steps of one length; give `dt0`, the step in s")


def time_origin(controller, t0):
    """The time from which times count in the loops: the start, but zero where a `controller` of the user's may hold times of its own."""
    return t0 if controller is None or type(controller) in (diffrax.PIDController, diffrax.ConstantStepSize) else jnp.zeros_like(t0)


def steps_are_given(controller) -> bool:
    """Whether the user says where each step ends."""
    return controller is not None and isinstance(controller, diffrax.StepTo)
