"""What a solver and its control of steps ask for besides rates: a form of the state, constant steps, states saved at ends of steps only, a clock."""

import jax.numpy as jnp

from jourdain_jax.motion.integrators.discrete_gradient import DiscreteGradient
from jourdain_jax.motion.integrators.implicit_steps import ImplicitMethod
from jourdain_jax.motion.integrators.of_diffrax import diffrax
from jourdain_jax.motion.vector_fields.field import VectorField
from jourdain_jax.scene.scene import Scene


def fitted(solver, scene: Scene, field: VectorField, asked: str) -> VectorField:
    """The form of the state that the solver integrates; a ValueError where it does not apply to the scene. `asked`: the `state` of its `Formulation`."""
    return solver.fitted(scene, field, asked) if isinstance(solver, ImplicitMethod) else field


def may_be_full(solver) -> bool:
    """Whether a motion that lost its privileged speeds may go on with the full state."""
    return not isinstance(solver, DiscreteGradient)


def check_solver(solver, controller, dt0, saveat, max_step, adjoint) -> None:
    """ValueError for options that do not go with one of our own implicit solvers, or with a control of steps of the user's; others pass."""
    if max_step is not None and controller is not None:
        raise ValueError("`max_step` bounds the steps of the default control: give `dtmax` to `stepsize_controller`")
    if not isinstance(solver, ImplicitMethod):
        return
    given = {"stepsize_controller": controller, "saveat": saveat} | ({"dt0": dt0, "max_step": max_step} if solver.even else {})
    for name in (name for name, value in given.items() if value is not None):
        advice = f"; its steps are at most as long as its `step`: jj.{solver.name}(step=...)" if solver.even else ""
        raise ValueError(f"`{name}` does not go with `{solver.name}`, whose steps are our own{advice}")
    if isinstance(adjoint, diffrax.DirectAdjoint):
        raise ValueError(f"`{solver.name}` takes no diffrax.DirectAdjoint as `adjoint`; leave it away for reverse mode, or use diffrax.ForwardMode()")


def time_origin(controller, t0):
    """The time from which times count in the loops: the start, but zero where a `controller` of the user's may hold times of its own."""
    return t0 if controller is None or type(controller) in (diffrax.PIDController, diffrax.ConstantStepSize) else jnp.zeros_like(t0)


def steps_are_given(controller) -> bool:
    """Whether the user says where each step ends."""
    return controller is not None and isinstance(controller, diffrax.StepTo)
