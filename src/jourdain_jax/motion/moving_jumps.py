"""Warnings about derivatives of motions whose loads jump at a time that moves with what is differentiated: they leave that out (`build/load_jumps.py`).

Loads may jump as the state, time or parameters change, or with an input that is a function of time, such as `lambda t: jnp.where(t > switched_on, 1.0, 0.0)`.
"""

import warnings
from collections.abc import Iterator

import equinox as eqx
import jax
import numpy as np

from jourdain_jax.build.load_jumps import jump_of_loads, loads_may_jump
from jourdain_jax.build.reference_parameters import with_reference_parameters
from jourdain_jax.calculus.cotangents import tap_differentiation
from jourdain_jax.calculus.reals import is_traced, nothing_is_traced
from jourdain_jax.motion.input_programs import FunctionOfTime
from jourdain_jax.motion.inputs import Inputs
from jourdain_jax.motion.inputs_in_rows import first_jump
from jourdain_jax.motion.sensitivity import SensitivityWarning
from jourdain_jax.motion.setup import Setup
from jourdain_jax.program.roughness import may_bend


def warns_of_jumps(setup: Setup) -> Setup:
    """The setup; where its loads jump, a derivative with respect to what may move the time of a jump warns, inside `jit`, too."""
    if nothing_is_traced():
        return setup
    functions = any(_may_jump(setup.inputs, jax.tree.map(lambda _: True, setup.inputs)))
    if not functions and not any(loads_may_jump(setup.scene)):
        return setup
    moving, others = eqx.partition((setup.scene, setup.start, setup.inputs, setup.t0), lambda x: eqx.is_inexact_array(x) and is_traced(x))
    leaves, treedef = jax.tree.flatten(moving)
    if not leaves:
        return setup
    scene = with_reference_parameters(setup.scene)
    inputs, span = _with_numbers(setup) if functions else (setup.inputs, ())

    def tell(moves: list[bool]):
        with jax.ensure_compile_time_eval(), np.errstate(all="ignore"):
            jump = jump_of_loads(scene) or _jump_of_inputs(scene.inputs.entries, inputs, jax.tree.unflatten(treedef, moves)[2], span)
        if jump:
            text = (
                f"derivatives of motions of `{type(scene).__name__}` that meet a jump of loads are wrong: they leave out how the time of the jump moves. "
                f"Here {jump}. Let it change within a short time or length, as by `jnp.tanh`, or end the motion there by an event and start another; motions "
                "themselves are right"
            )
            warnings.warn(text, SensitivityWarning, stacklevel=1)  # always in this place: Python shows it once

    told = eqx.combine(jax.tree.unflatten(treedef, tap_differentiation(leaves, tell)), others)
    return setup._replace(**dict(zip(("scene", "start", "inputs", "t0"), told, strict=True)))


def _may_jump(inputs: Inputs, moves: Inputs) -> Iterator[bool]:
    """Whether a branch of each input is decided by an array of its own that `moves`."""
    for channel, moving in zip(inputs.channels, moves.channels, strict=True):
        if isinstance(channel, FunctionOfTime) and isinstance(moving, FunctionOfTime):
            first = len(channel.program.numbers)
            yield any(may_bend(channel.program.closed, [first + k for k, moves in enumerate(moving.held) if moves]))
        else:
            yield False


def _jump_of_inputs(names, inputs: Inputs, moves: Inputs, span) -> str:
    """An input that jumps at a time that moves, in words; empty where none is seen to."""
    for name, channel, may in zip(names, inputs.channels, _may_jump(inputs, moves), strict=True):
        if may and (t := first_jump(channel, *span)) is not None:
            return f"input `{name}` jumps at t = {t:.3g} s"
    return ""


def _with_numbers(setup: Setup) -> tuple[Inputs, tuple[float, float]]:
    """The inputs, with times of the motion in place of numbers that are not known; and the span, the usual one where it is not known."""
    given = setup.inputs, setup.t0, setup.t1
    inputs, *span = jax.tree.map(lambda x: jax.lax.stop_gradient(x) if is_traced(x) else x, given)  # known where differentiated outside of `jit`
    t0, t1 = (0.0, float(setup.scene.example_span)) if is_traced(span) else map(float, span)
    generator = np.random.default_rng(11)
    return jax.tree.map(lambda x: np.sort(generator.uniform(t0, t1, np.shape(x)), axis=None).reshape(np.shape(x)) if is_traced(x) else x, inputs), (t0, t1)
