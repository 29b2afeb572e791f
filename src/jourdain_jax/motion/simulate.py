"""Simulation: a scene and a start in, a `Trajectory` out, by our own loop over steps or by a solver of diffrax.

The default state is the minimal one (coordinates and privileged speeds) where the privileged velocities are well conditioned over the scene's
domain and the rows are linear or affine; otherwise the full one (coordinates and all speeds), projected after every step.
"""

import warnings
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any, Unpack, cast

import equinox as eqx
import jax
import numpy as np

from jourdain_jax.calculus.on_first_use import module_on_first_use
from jourdain_jax.calculus.reals import Number, as_array, is_traced, nothing_is_traced
from jourdain_jax.motion.arguments import as_state, span_and_times
from jourdain_jax.motion.inputs import Inputs, as_inputs, inputs_at
from jourdain_jax.motion.inputs_in_rows import check_inputs_in_rows
from jourdain_jax.motion.integration import integrate
from jourdain_jax.motion.integrators.implicit_steps import FixedStepMethod, ImplicitMethod
from jourdain_jax.motion.integrators.tableaus import DOPRI8, TSIT5, Method
from jourdain_jax.motion.integrators.taylor import Taylor, order_for
from jourdain_jax.motion.marks import nan_is_a_mark
from jourdain_jax.motion.options import AllOptions, OptionFields, Options, as_options
from jourdain_jax.motion.own_steps import own_steps
from jourdain_jax.motion.put_on_rows import Usual, usual_sizes
from jourdain_jax.motion.retries import retried
from jourdain_jax.motion.sensitivity import warn_if_ill_conditioned
from jourdain_jax.motion.setup import LONGEST, Setup
from jourdain_jax.motion.start import State, nearest_state
from jourdain_jax.motion.trajectories import results
from jourdain_jax.motion.trajectories.trajectory import Trajectory
from jourdain_jax.motion.vector_fields.choice import as_formulation, vector_field
from jourdain_jax.scene.arguments import BuiltFor, as_coordinates, as_scene, as_speeds
from jourdain_jax.scene.scene import Scene
from jourdain_jax.scene.tracebacks import shown_from_users_lines, users_level

if TYPE_CHECKING:
    from jourdain_jax.motion import diffrax_steps
else:
    diffrax_steps = module_on_first_use("jourdain_jax.motion.diffrax_steps")


@shown_from_users_lines
def simulate(
    scene: Scene | BuiltFor,
    start=None,
    *,
    t0: Number | None = None,
    t1: Number | None = None,
    ts=None,
    inputs=None,
    options: Options | None = None,
    **by_name: Unpack[OptionFields],
) -> Trajectory:
    """Integrate a scene's equations of motion from `start` over [t0, t1].

    **Arguments**
    - `start`: a `State`, a dictionary of named values (the rest is solved for, as by `jj.start`), or None for the scene's example.
    - `t0`, `t1`: ends of the span (s; defaults: the time of a `State`, otherwise 0; the last of `ts`, or the scene's
      `example_span` after t0); `ts`: times to save at (default: 201 even ones), at each of which a step ends.
    - `inputs`: name -> number, function of time, or `Sampled`.
    - `options`: a `jj.Options`: tolerances, solver, steps, events, work, retries. `by_name`: its fields, as `rtol=1e-10`, which take precedence.

    By name alone:
    - `formulation`: which equations are integrated, a `jj.Formulation(state, reduction, stabilisation)` (default: what serves the scene).
    - `backend`: "native", the scene's scalar program (`jj.lower`) as machine code made for it, on CPUs, where llvmlite is installed and the solver is a
      default one; "xla", that program compiled by XLA: also for third derivatives, derivatives with respect to samples, `jax.export` and other devices, which
      machine code refuses; "dense", the dense matrices; "auto" (default), the first of these that serves. The first two take the same steps.

    Derivatives in forward and in reverse mode serve all motions. Where machine code integrates, so do those of the second order in all combinations
    (`jax.hessian`); elsewhere forward mode of forward mode does, to any order.

    **Returns** a `Trajectory`, with a result code instead of an exception, whose message says what to do; `trajectory.raise_if_failed()` raises
    `SimulationError`.

    **Raises** TypeError for unknown options, ValueError for bad arguments or a start that contradicts the constraints, `DifferentiationModeError` for
    derivatives that there are not.

    **Examples**

        disc = jj.models.TiltingDisc()
        motion = jj.simulate(disc, {"lean": 0.3, "spin_rate": -3.0}, t1=2.0)
        print(motion)                                             # result, steps, drift of the energy, contact forces
        motion["lean"], motion.q_end, motion.ts                   # by name; as vectors
        motion.point("disc"), motion.point("disc", (0, 0.5, 0))   # paths of the mass centre and of a point fixed in the body

        def lean_at_end(radius):                                  # a derivative with respect to a parameter
            return jj.simulate(disc.replace(radius=radius), {"lean": 0.3, "spin_rate": -3.0}, ts=[1.0])["lean"][-1]

        slope = jax.grad(lean_at_end)(0.5)
    """
    options = as_options(options, by_name, scene=scene)
    run = partial(_run, scene, start, {"t0": t0, "t1": t1, "ts": ts, "inputs": inputs})
    if isinstance(scene, BuiltFor):
        with scene.reference.stands_in():
            return _simulated(run, options)
    return _simulated(run, options)


def _simulated(run: Callable[[AllOptions], tuple[Setup, Trajectory]], options: AllOptions) -> Trajectory:
    setup, motion = run(options)
    return retried(run, setup, motion, options) if options.retry else motion


def _run(scene, start, span: dict, options: AllOptions) -> tuple[Setup, Trajectory]:
    """Return the setup and its motion."""
    setup = set_up(scene, start, **span, options=options)
    return setup, warn_if_ill_conditioned(setup, _integrated)


def _integrated(setup: Setup) -> Trajectory:
    """The motion; under `jax_debug_nans`, NaN after an event is a mark, and a motion that failed is integrated again for JAX to find the NaN."""
    if not jax.config.jax_debug_nans:
        return integrate(setup)
    with nan_is_a_mark():
        motion = integrate(setup)
    if is_traced(motion.result) or int(motion.result) in (results.SUCCESS, results.EVENT):
        return motion
    return integrate(setup)


def set_up(scene: Scene | BuiltFor, start=None, *, t0=None, t1=None, ts=None, inputs=None, options: Options | None = None, **by_name) -> Setup:
    """Return the setup that `simulate` integrates for its arguments."""
    options = as_options(options, by_name, scene=None if type(options) is AllOptions else scene)
    reference = scene.reference if isinstance(scene, BuiltFor) else None
    solver, max_step = options.solver, options.max_step
    scene, formulation = as_scene(scene), as_formulation(options.formulation)
    order, solver = (solver.order or order_for(options.rtol), None) if isinstance(solver, Taylor) else (None, solver)
    if isinstance(solver, FixedStepMethod):
        if max_step is not None:
            raise ValueError(f"`max_step` does not go with `{solver.name}`, whose steps are at most as long as its `step`: jj.{solver.name}(step=...)")
        max_step = solver.step
    native = options.backend in ("auto", "native")
    inputs = as_inputs(scene, inputs)
    t0, ts, t1 = span_and_times(scene, start, t0, t1, ts)
    start, usual = _start(scene, start, t0, inputs, native, formulation.projects)
    field = vector_field(scene, formulation, options.work, options.backend, inputs)
    field = solver.fitted(scene, field, formulation.state) if isinstance(solver, ImplicitMethod) else field
    if not inputs.constant:
        check_inputs_in_rows(scene, inputs, t0, t1)
    warn_float32(start.q.dtype, options.rtol)
    if solver is None:
        solver = default_solver(options.rtol) if order is None else DOPRI8
    static: dict[str, Any] = {"max_steps": options.max_steps, "event_names": field.event_names if options.events else ()}
    static["alongside"] = options.alongside
    own = own_steps(solver, **static, native=native, order=order)
    integrator = diffrax_steps.Diffrax(cast(Any, solver), **static) if own is None else own
    tolerances = tuple(as_array(x, start.q.dtype) for x in (options.rtol, options.atol))  # arrays: another tolerance is no other program
    first_step = (1.0 if isinstance(solver, FixedStepMethod) else 1e-4) * (t1 - t0)  # diffrax's own guess costs two more copies of the vector field to compile
    longest = as_array(LONGEST * abs(t1 - t0) if max_step is None else max_step, start.q.dtype)
    setup = Setup(scene, start, inputs, t0, t1, ts, field, tolerances, first_step, longest, integrator, usual, reference)
    if own is None:
        diffrax_steps.check(setup)
    if (options.backend == "native" or order is not None) and (reason := setup.reason_against_machine_code):
        asked, advice = ("backend='native'", "use backend='auto', which takes what serves") if order is None else _BY_SERIES
        raise ValueError(f"{asked} cannot integrate `{type(scene).__name__}`: {reason}; {advice}")
    return setup


_BY_SERIES = "solver=jj.Taylor()", "omit `solver`, or use solver=diffrax.Dopri8()"


def _start(scene: Scene, given, t0, inputs: Inputs, native: bool, projects: bool) -> tuple[State, Usual | None]:
    """Return the start on its constraints; or a `State` as it is, and the sizes by which the program that integrates projects it."""
    if not (projects and isinstance(given, State)):
        return as_state(scene, given, t0=t0, inputs=inputs_at(inputs, t0), native=native), None
    if nothing_is_traced():
        q, u = as_coordinates(scene, given.q), as_speeds(scene, given.u)
        as_given = q is given.q and u is given.u
        return given if as_given else eqx.tree_at(lambda s: (s.q, s.u), given, (q, u)), usual_sizes(scene, False, native)
    return nearest_state(scene, t0, given.q, given.u, inputs_at(inputs, t0), native=native), None


def default_solver(rtol: Number) -> Method:
    """The method for this tolerance; a ValueError where it is traced."""
    if is_traced(rtol):
        raise ValueError("`rtol` is traced, and the default solver is chosen by its value; give a `solver` too, such as diffrax.Dopri8()")
    return TSIT5 if rtol >= 1e-6 else DOPRI8


def warn_float32(dtype, rtol) -> None:
    """A warning where the precision does not hold the tolerance."""
    if dtype == np.float32 and not isinstance(rtol, jax.core.Tracer) and rtol < 1e-5:
        warnings.warn(
            f"rtol = {rtol} asks for more digits than float32 has; set jax.config.update('jax_enable_x64', True), or loosen rtol and atol to 1e-5",
            stacklevel=users_level(),
        )
