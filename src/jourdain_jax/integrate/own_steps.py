"""Integrator by this package's loop over steps, with derivatives. It runs as machine code if possible,
otherwise in JAX, where batches of a scalar program run in blocks of `width` samples.
"""

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import PyTree

from jourdain_jax.calculus.derivative_errors import SECOND_ORDER_MESSAGE, DifferentiationModeError
from jourdain_jax.calculus.derivatives import Rules, pushed_by_jax, with_derivatives_of, with_rules
from jourdain_jax.calculus.reals import Indices, at_index, is_traced
from jourdain_jax.integrate import result_codes
from jourdain_jax.integrate.arrays import array_motion as on_arrays
from jourdain_jax.integrate.explicit_steps import Method, method_of
from jourdain_jax.integrate.implicit_steps import FixedStepMethod, ImplicitMethod
from jourdain_jax.integrate.inputs import (
    Constant,
    FunctionOfTime,
    Inputs,
    Mode,
    Sampled,
    in_phases,
    samples_in,
)
from jourdain_jax.integrate.loop import native_motion, taylor
from jourdain_jax.integrate.loop.form import Form
from jourdain_jax.integrate.loop.loop_function import (
    OF_SAMPLES,
    Found,
    Start,
    driven,
    flow,
    form_of,
    modes_among,
    numbers_of,
    others_of,
    solved,
    start_of,
)
from jourdain_jax.integrate.loop.rate_functions import event_program, reason_against_derivatives
from jourdain_jax.integrate.loop.time_functions import function_may_jump
from jourdain_jax.integrate.setup import Begun, Integrator, Setup, Solved, Times
from jourdain_jax.integrate.vector_fields.field import ByProgram, Integrated, VectorField
from jourdain_jax.kernels import ffi
from jourdain_jax.kernels.scalar_program import unsupported
from jourdain_jax.lowering.lowered_equations import Lowered
from jourdain_jax.lowering.relations import MOST_WATCHED
from jourdain_jax.lowering.sides import loads_have_relations, may_jump, with_sides
from jourdain_jax.program.graph import ARRAYS, Unsupported
from jourdain_jax.scene.scene import Scene

# Limit on the number of operations. Measured compile times: 15,000 operations of a chain of 128 trailers take
# 2.8 s (XLA: 40 s), 18,000 operations of a chain of 23 joint angles take 1.2 s.
LARGEST_PROGRAM = 60_000  # tuning
MOST_PRODUCTS = 12_000  # tuning: limit on products of coefficients in a Taylor step, whose code has no loops


@jax.tree_util.register_static
@dataclass(frozen=True)
class OwnSteps(Integrator):
    """Loop over steps by a Runge-Kutta tableau, an implicit method or Taylor series."""

    solver: Method | ImplicitMethod
    tried: bool
    max_steps: int
    event_names: tuple[str, ...]
    native: bool  # whether machine code may integrate
    order: int | None  # order of the Taylor series used in place of the tableau; None: no series
    memory: int  # limit in bytes for the record of reverse mode
    most: int  # maximum number of events after which a motion continues
    stopping: bool  # whether stop events end a motion
    own: ClassVar[bool] = True

    @property
    def name(self) -> str:
        return self.solver.name if self.order is None else "Taylor"

    def reason_against_machine_code(self, setup: Setup) -> str:
        if not self.native:
            return "another backend was requested"
        if not isinstance(self.solver, Method):
            return "the solver is implicit"
        return reason_against(setup.field, setup.scene, setup.inputs, bool(self.event_names), self.order)

    def solved(self, setup: Setup, begun: Begun) -> Solved:
        native = not setup.reason_against_machine_code
        way = self._by_machine_code if native else self._on_arrays
        mover = partial(native_motion.mover, form=self._form(setup)) if native else on_arrays.mover

        def run(setup: Setup, begun: Begun) -> Solved:
            form, start, flow, back, reason = way(*in_sides(setup, begun))
            rules = Rules(pushed_by_jax(flow), partial(_pulled, back), lambda *_: reason())
            found = (flow if self.tried else with_rules(flow, rules))(start)
            return solved(form, start.goals, found)

        return _on_times(run, mover, setup, begun)

    def _on_arrays(self, setup: Setup, begun: Begun) -> "_Way":
        program = setup.field.lowered
        at_once = 0 if program is None or not isinstance(self.solver, Method) else width(program)
        of, start = on_arrays.loop_of(self.solver, setup, begun, self._events(setup))

        def back(asked: Indices, start: Start, found: Found, g: Found) -> tuple:
            return on_arrays.flow_back(of, at_once, asked, self.memory)(start, g)

        return _Way(of.form, start, on_arrays.flow(of, at_once), back, lambda: SECOND_ORDER_MESSAGE)

    def _form(self, setup: Setup) -> Form:
        return form_of(setup.field, setup.inputs, **self._events(setup))

    def _events(self, setup: Setup) -> dict[str, Any]:
        sides = setup.field.lowered.sides if setup.field.lowered else ()
        return {"has_events": bool(self.event_names or sides), "most": self.most, "stopping": self.stopping}

    def _by_machine_code(self, setup: Setup, begun: Begun) -> "_Way":
        form, start = self._form(setup), start_of(setup, begun)
        assert isinstance(self.solver, Method)
        back = partial(native_motion.cotangents, form, self.solver, self.memory)
        run = flow(form, self.solver, self.order)
        return _Way(form, start, run, back, partial(reason_against_derivatives, form, 2))


class _Way(NamedTuple):
    """Motion as a function of its start, and its reverse mode."""

    form: Form
    start: Start
    flow: Callable[[Start], Found]
    # (indices of known numbers, start, motion, cotangents of the motion) -> cotangents of the initial state
    # and of these numbers
    back: Callable[..., tuple]
    reason_against_second: Callable[[], str]


def _pulled(back: Callable, perturbed: tuple[Start], arguments: tuple[Start], found: Found, g: Found):
    """Return the cotangents of a start: zero except for its state and its known numbers."""
    (varies,), (start,) = perturbed, arguments
    if any(jax.tree.leaves(varies.tables)):
        raise DifferentiationModeError(OF_SAMPLES)
    asked = tuple(i for i, is_asked in enumerate(varies.known[0]) if is_asked)
    by_y, by_known = back(asked, start, found, g)
    known = dict(zip(asked, by_known, strict=True))
    zeros = jax.tree.map(lambda varies, x: jnp.zeros_like(x) if varies else None, varies, start)
    return (zeros._replace(y=(by_y,), known=(tuple(map(known.get, range(len(start.known[0])))),)),)


def own_steps(solver, **static) -> OwnSteps | None:
    """Return this package's loop if it supports the solver; otherwise None, and diffrax is used."""
    method = solver if isinstance(solver, Method | ImplicitMethod) else method_of(solver)
    if method is None:
        return None
    if isinstance(method, FixedStepMethod):
        # without the step, so that a new step size needs no compilation
        method = eqx.tree_at(lambda method: method.step, method, None)
    return OwnSteps(method, **static)


def _on_times(run: Callable[[Setup, Begun], Solved], mover: Callable, setup: Setup, begun: Begun) -> Solved:
    """Return the motion of `run`, with derivatives with respect to the setup's times. Times within `run` have
    no derivatives; therefore, the start and the saved states are shifted to the setup's times.

    A time that was reached equals its goal. The loop itself computes the time of a stop event. Any other end
    time keeps its distance from the start.
    """
    numbers = jax.lax.stop_gradient
    alone = setup.at(begun.plain.times if begun.plain else numbers(setup.times))

    def moved_start(y0, args, shared) -> Integrated:
        return mover(args, shared)(y0, args[-1], numbers(args[-1]) - args[-1])

    given = begun.args, begun.shared
    y0, args = with_derivatives_of(moved_start, begun.y0, *given), (*begun.args[:-1], alone.t0)
    found = run(alone, eqx.tree_at(lambda b: (b.y0, b.args), begun, (y0, args)))
    return with_derivatives_of(partial(_moved, mover), found, *given, setup.times, alone.ts)


def _moved(mover: Callable, found: Solved, args: tuple, shared: tuple, times: Times, ts) -> Solved:
    """Return a motion with derivatives with respect to its times. `shared`: as in `Begun`; `ts`: saved times
    without derivatives.
    """
    numbers, (field, scene, inputs, fixed, start) = jax.lax.stop_gradient, args
    goals, later = times.goals, start - numbers(start)
    passed, number, direction = found.passed, numbers(goals), jnp.sign(numbers(goals[-1]))
    transitions = passed.times(numbers(start), ts, number[:-1], direction)
    inputs = in_phases(inputs, transitions, passed.modes, direction)
    moved = mover((field, scene, inputs, fixed, start), shared)
    event = (found.code == result_codes.EVENT) & (found.accepted > 0)
    t_end = numbers(found.t_end)
    by_goal = jnp.append(found.reached, t_end == number[-1]) & ~(event & (number == t_end))
    by = jnp.where(by_goal, goals - number + later, jnp.where(event, 0.0, later))
    at = numbers(start) + jnp.where(by_goal, number, t_end)
    every = jax.tree.map(lambda ys, y: jnp.concatenate([ys, y[None]]), found.ys, found.y_end)
    every = jax.vmap(moved)(every, at, by)
    return eqx.tree_at(
        lambda s: (s.ts, s.ys, s.y_end, s.t_end, s.passed.ts),
        found,
        (
            goals[:-1],
            at_index(every, slice(-1)),
            at_index(every, -1),
            found.t_end + jnp.where(event, -later, jnp.where(by_goal[-1], goals[-1] - number[-1], 0.0)),
            passed.ts - later,
        ),
    )


def in_sides(setup: Setup, begun: Begun) -> tuple[Setup, Begun]:
    """Return the motion with a mode and an event for each relation, such as `a < b` (`lowering/sides.py`),
    and with functions of time merged into its program.
    """
    field, inputs = setup.field, begun.args[2]
    if _reason_against_sides(setup) or not isinstance(field, ByProgram):
        return setup, begun
    has_events = bool(setup.integrator.event_names)
    program, numbers = _relations(field.program, inputs, has_events)
    if not numbers:
        return setup, begun
    merged = program is not field.program
    kept = lambda inputs: [x for x in inputs.channels if not (merged and isinstance(x, FunctionOfTime))]
    program = with_sides(program, has_events, modes_among(Inputs(tuple(kept(inputs)))))
    field = replace(field, program=program, stops=program.stops)

    def within(args: tuple) -> tuple:
        _, scene, inputs, fixed, origin = args
        functions = [x for x in inputs.channels if merged and isinstance(x, FunctionOfTime)]
        fixed += tuple(jnp.asarray(x, jnp.result_type(float)) for f in functions for x in numbers_of(f))
        sides = [Mode(jnp.zeros(()))] * len(program.sides)
        return field, scene, Inputs((*kept(inputs), *sides)), fixed, origin

    args = within(begun.args)
    plain = begun.plain and begun.plain._replace(args=within(begun.plain.args))
    return setup._replace(field=field, inputs=args[2]), replace(begun, args=args, plain=plain)


def reason_against_watching(setup: Setup) -> str:
    """Return why relations in loads or stop events are not all monitored; empty if they are, or if there are
    none. Parts of a scene without a scalar form may contain relations that are not known.
    """
    program = setup.field.lowered
    hides = program is not None and program.graph.calls([*program.qdot, *program.ydot, *program.events])
    return _reason_against_sides(setup) or ("parts of the scene are JAX calls" if hides else "")


def _reason_against_sides(setup: Setup) -> str:
    """Return why relations of the scalar program are not monitored; empty if they are or there are none."""
    if setup.field.lowered is None:
        jump = loads_have_relations(setup.scene) or any(map(function_may_jump, setup.inputs.programs))
        return "the scene has no scalar program" if jump else ""
    program, numbers = _relations(
        setup.field.lowered, setup.inputs, has_events := bool(setup.integrator.event_names)
    )
    if not numbers:
        return ""
    if not setup.integrator.own:
        return "the solver is a diffrax solver"
    if getattr(setup.integrator.solver, "even", False):
        return "the method has fixed steps"
    if has_events and not setup.field.lowers_events:
        return "an event has no scalar form"
    if any(program.graph.op[n] in ARRAYS for n in program.fixed):
        return "parts of the scene are JAX calls"
    sampled = [
        n
        for n, channel in zip(program.traced.inputs.tolist(), others_of(setup.inputs), strict=True)
        if isinstance(channel, Sampled)
    ]
    if set(sampled) & set(program.graph.reachable(numbers)):
        return "one depends on a sampled input"
    return f"there are {len(numbers)}, more than {MOST_WATCHED}" if len(numbers) > MOST_WATCHED else ""


def moving_jumps(field: VectorField, scene: Scene, inputs: Inputs, scene_varies: bool, watched: bool) -> bool:
    """Return whether rates may jump at a time that varies and whose derivatives are neglected. Such a time
    depends on the state, on numbers of inputs or, if `scene_varies`, on parameters. `watched`: whether
    relations are monitored.
    """
    if watched and field.lowered is not None:
        program, numbers = _relations(field.lowered, inputs, False)
        if set(numbers) <= set(program.sided):
            return False
    functions = [channel for channel in inputs.channels if isinstance(channel, FunctionOfTime)]
    if any(function_may_jump(x.program, _varying(x)) for x in functions):
        return True
    return may_jump(scene, scene_varies, any(_traced(inputs.channels)))


def _varying(channel: FunctionOfTime) -> list[bool]:
    """Return for each number of a function of time whether it is traced."""
    shapes = channel.program.shapes
    parts = _traced([channel.numbers] * (len(shapes) - len(channel.held)) + [*channel.held])
    return [varies for varies, shape in zip(parts, shapes, strict=True) for _ in range(math.prod(shape))]


def _traced(parts: Iterable) -> list[bool]:
    return [is_traced(x) for x in parts]


def _relations(program: Lowered, inputs: Inputs, has_events: bool) -> tuple[Lowered, Indices]:
    """Return the program with functions of time merged into it, and the numbers compared by its relations."""
    found = driven(program, inputs)
    program = program if isinstance(found, str) else found
    return program, program.watched(has_events)


def reason_against(
    field: VectorField, scene: PyTree, inputs: Inputs, has_events: bool, order: int | None = None
) -> str:
    """Return why machine code cannot integrate a scene (by Taylor series if an `order` is given); empty if it
    can.
    """
    if not isinstance(field, ByProgram):
        return "the scene has no scalar program"
    if reason := ffi.reason_against():
        return reason
    if samples_in(scene):
        return "the scene itself has a sampled input"
    if not all(
        isinstance(channel, Constant | Sampled | FunctionOfTime | Mode) for channel in inputs.channels
    ):
        return "an input is a function of time that captures arrays"
    if isinstance(reason := driven(field.program, inputs), str):
        return reason
    if has_events and not field.lowers_events:
        return "a stop event is not part of the scalar program"
    return _reason_against_program(form_of(field, inputs, has_events, 1, True), order)


@lru_cache(maxsize=64)
def _reason_against_program(form: Form, order: int | None) -> str:
    """Return why machine code cannot evaluate the program of a form; empty if it can."""
    program, graph = form.program, form.program.graph
    operations = graph.operations(form.nodes)
    if operations > LARGEST_PROGRAM:
        return f"the scalar program has {operations} operations, more than {LARGEST_PROGRAM}"
    if reason := unsupported(graph, form.nodes):
        return reason
    if form.has_events and form.sampled:
        sampled = {program.variables[len(program.variables) - len(program.inputs) + i] for i in form.sampled}
        if sampled & set(graph.reachable(program.events)):
            return "a stop event depends on an input that changes with time"
    if form.has_events:
        try:
            event_program(form)
        except Unsupported as error:
            return f"the rate of a stop event has no scalar form ({error})"
    return "" if order is None else _reason_against_series(form, order)


def _reason_against_series(form: Form, order: int) -> str:
    if form.sampled:
        return "an input is given by samples"
    if reason := taylor.reason_against(form.program.graph, form.rates):
        return reason
    count = taylor.products(form, order)
    return f"Taylor series take {count} products, more than {MOST_PRODUCTS}" if count > MOST_PRODUCTS else ""


def width(program: Lowered) -> int:
    """Return the number of samples of a lowered scene that run together in one block.

    A block runs until its slowest sample ends, and its data should fit a core's fastest cache. Small blocks
    are therefore best if their overhead is small. On a CPU it is small if XLA compiles the whole loop into
    one function, as it does for loops that use little memory (`calculus/configuration.py`). Otherwise XLA
    starts each operation separately, and many samples must share that cost.
    """
    # larger loops use too much memory to become one function; the bicycle, with 2016 operations, still
    # becomes one
    return 8 if program.operations <= 3000 and jax.default_backend() == "cpu" else 2**30
