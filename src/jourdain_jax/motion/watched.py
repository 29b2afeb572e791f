"""The relations of a scene that XLA's loop watches, and why some are not watched (`motion/integrators/crossings.py`)."""

from collections.abc import Callable
from functools import partial
from itertools import compress

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jourdain_jax.calculus.reals import is_traced
from jourdain_jax.lowering.kinks import loads_have_relations, loads_may_jump
from jourdain_jax.lowering.lowered import Lowered
from jourdain_jax.lowering.relations import MOST_WATCHED
from jourdain_jax.motion.input_programs import FunctionOfTime
from jourdain_jax.motion.inputs import Inputs
from jourdain_jax.motion.native.functions_of_time import numbers_of
from jourdain_jax.motion.native.native_motion import driven
from jourdain_jax.motion.setup import Setup
from jourdain_jax.motion.vector_fields.field import VectorField
from jourdain_jax.program.analyticity import depend_on
from jourdain_jax.scene.scene import Scene


def watched(field: VectorField, inputs: Inputs, has_events: bool) -> tuple[Callable | None, int]:
    """The numbers whose signs are watched, as a function (args, tau, y) -> (numbers, *lanes), and how many are relations; None where none are, or too many."""
    if field.lowered is None:
        return None, 0
    program, nodes = _relations(field.lowered, inputs, has_events)
    events = program.events if has_events and program.event_relations else ()
    return (partial(_values, program, (*nodes, *events)), len(nodes)) if 0 < len(nodes) <= MOST_WATCHED else (None, 0)


def reason_against_watching(setup: Setup) -> str:
    """Why no step watches the relations that the loads of a scene, or its stop events, have; empty where one does, or they have none."""
    if setup.field.lowered is None:
        return "the scene has no scalar program" if loads_have_relations(setup.scene) else ""
    count = len(_relations(setup.field.lowered, setup.inputs, bool(setup.integrator.event_names))[1])
    if not setup.integrator.watches:
        return "solvers of diffrax do not" if count else ""
    return f"they are {count}, more than {MOST_WATCHED}" if count > MOST_WATCHED else ""


def moving_jumps(field: VectorField, scene: Scene, inputs: Inputs, scene_varies: bool) -> bool:
    """Return whether rates may jump at a time that depends on the state, on numbers of inputs, or, where the `scene_varies`, on parameters."""
    if field.lowered is None:
        return loads_may_jump(scene)
    program, _ = _relations(field.lowered, inputs, False)
    if not program.jumps:
        return False
    lowered = [isinstance(channel, FunctionOfTime) and program is not field.lowered for channel in inputs.channels]
    numbers = [varies for channel in compress(inputs.channels, lowered) for varies in numbers_of(jax.tree.map(is_traced, channel))]
    others = [is_traced(channel) for channel, is_lowered in zip(inputs.channels, lowered, strict=True) if not is_lowered]
    count = len(program.traced.q) + len(program.independent)
    varies = [*[scene_varies] * len(field.lowered.fixed), *numbers, False, *[True] * count, *others]
    return any(depend_on(program.graph, program.jumps, compress(program.variables, varies)))


def _relations(program: Lowered, inputs: Inputs, has_events: bool) -> tuple[Lowered, tuple[int, ...]]:
    """The program with the functions of time among the inputs, where it takes these, and the relations in it."""
    found = driven(program, inputs)
    program = program if isinstance(found, str) else found
    return program, program.watched(has_events)


@eqx.filter_jit
def _values(program: Lowered, nodes: tuple[int, ...], args, tau, y) -> Float[Array, "numbers *lanes"]:
    _, _, inputs, fixed, origin = args
    t, given = origin + tau, partial(_given, len(program.inputs))
    values = eqx.filter_vmap(given, out_axes=-1)(inputs, t) if jnp.ndim(tau) else given(inputs, t)
    numbers = len(values) - len(program.inputs)
    state = jax.lax.stop_gradient(((*fixed, *values[:numbers]), t, tuple(y.q), tuple(y.v), values[numbers:]))
    return program.values(nodes, *state)


def _given(count: int, inputs: Inputs, t) -> Float[Array, "given"]:
    """Numbers of the functions of time, and values of the `count` inputs that are left to the program."""
    functions = [channel for channel in inputs.channels if isinstance(channel, FunctionOfTime)] if count < len(inputs.channels) else []
    numbers = [x for channel in functions for x in numbers_of(channel)]
    values = [channel(t) for channel in inputs.channels if not (functions and isinstance(channel, FunctionOfTime))]
    return jnp.stack([jnp.asarray(x, jnp.result_type(float)) for x in (*numbers, *values)]) if numbers or values else jnp.zeros(0)
