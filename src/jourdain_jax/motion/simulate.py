"""Simulate a scene: integrate from a start to a `Trajectory`, by this package's loop over steps or diffrax.

The default state is minimal (coordinates and independent speeds) if the independent speeds are well
conditioned over the scene's domain and the constraints are linear or affine. Otherwise it is full
(coordinates and all speeds), projected after every step.
"""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Unpack, cast

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float

from jourdain_jax.calculus.compilation import nan_is_a_mark
from jourdain_jax.calculus.lazy_imports import module_on_first_use
from jourdain_jax.calculus.reals import (
    Number,
    Numbers,
    all_finite,
    as_array,
    described,
    eps_of,
    is_traced,
    known_numbers,
    nothing_is_traced,
    real_type,
)
from jourdain_jax.integrate import result_codes
from jourdain_jax.integrate.constraint_projection import Usual
from jourdain_jax.integrate.explicit_steps import DOPRI8, TSIT5, Method, Taylor, diffrax, order_for
from jourdain_jax.integrate.implicit_steps import FixedStepMethod, ImplicitMethod
from jourdain_jax.integrate.inputs import Inputs, check_inputs_in_rows, inputs_at
from jourdain_jax.integrate.own_steps import own_steps
from jourdain_jax.integrate.setup import LONGEST, MEMORY, Setup, ends_fit
from jourdain_jax.integrate.state import State
from jourdain_jax.motion.integration import integrate
from jourdain_jax.motion.model import Model, modelled
from jourdain_jax.motion.options import AllOptions, OptionFields, Options, as_options
from jourdain_jax.motion.retries import retried
from jourdain_jax.motion.sensitivity import warn_if_ill_conditioned
from jourdain_jax.motion.start import named_start
from jourdain_jax.motion.trajectories.trajectory import Trajectory
from jourdain_jax.scene.arguments import (
    BuiltFor,
    as_coordinates,
    as_speeds,
    one_time,
    shown_from_users_lines,
    vector_of_times,
    warn,
)
from jourdain_jax.scene.scene import Scene
from jourdain_jax.structure.structure import check_bodies, is_judged

if TYPE_CHECKING:
    from jourdain_jax.motion import diffrax_steps
else:
    diffrax_steps = module_on_first_use("jourdain_jax.motion.diffrax_steps")


@shown_from_users_lines
def simulate(
    scene: Scene | BuiltFor,
    start: "State | Mapping[str, Any] | None" = None,
    *,
    t0: Number | None = None,
    t1: Number | None = None,
    ts: "Numbers | None" = None,
    inputs: "Inputs | Mapping[str, Any] | None" = None,
    options: Options | None = None,
    **by_name: Unpack[OptionFields],
) -> Trajectory:
    """Integrate a scene's equations of motion from `start` over [t0, t1].

    **Arguments**

    - `start`: a `State`, a dictionary of named values (`jj.start` solves for omitted ones), or None for the
      scene's example.
    - `t0`, `t1`: start and end of the motion (s). Default of `t0`: the time of a `State`, otherwise 0; of
      `t1`: the last of `ts`, otherwise `t0` plus the scene's `example_span`.
    - `ts`: times to save, at each of which a step ends (default: 201, evenly spaced).
    - `inputs`: inputs by name, each a number, a function of time, or `Sampled`.
    - `options`: a `jj.Options`: tolerances, solver, steps, events, work, retries. `by_name`: its fields, such
      as `rtol=1e-10`, which take precedence, and two further settings:
    - `formulation`: the equations to integrate, a `jj.Formulation(state, reduction, stabilisation)` (default:
      chosen for the scene).
    - `backend`: "native", the scene's scalar program (`jj.lower`) as machine code, which needs llvmlite and a
      default solver; "xla", the same program compiled by XLA, which also supports third derivatives,
      derivatives with respect to samples, `jax.export` and other devices; "dense", dense matrices; "auto"
      (default), the first of these that applies. "native" and "xla" take the same steps.

    All motions have derivatives in forward and in reverse mode. Machine code also has second derivatives in
    all combinations (`jax.hessian`); other backends support forward mode of forward mode, to any order, but
    with respect to times to second order.

    **Returns** a `Trajectory`. A failure sets a result code, whose message advises what to do;
    `trajectory.raise_if_failed()` raises `SimulationError`.

    **Raises** TypeError for unknown options, ValueError for bad arguments or a start that contradicts the
    constraints, `DifferentiationModeError` for unsupported derivatives.

    **Examples**

        disc = jj.models.TiltingDisc()
        motion = jj.simulate(disc, {"lean": 0.3, "spin_rate": -3.0}, t1=2.0)
        print(motion)                             # result, steps, drift of the energy, contact forces
        motion["lean"], motion.q_end, motion.ts   # a coordinate over time; end state; saved times
        motion.point("disc")                      # path of the mass centre
        motion.point("disc", (0, 0.5, 0))         # path of a point fixed in the body

        def lean_at_end(radius):                  # a derivative with respect to a parameter
            return jj.simulate(disc.replace(radius=radius), {"lean": 0.3}, ts=[0.5])["lean"][-1]

        slope = jax.grad(lean_at_end)(0.5)
    """
    options = as_options(options, by_name, scene=scene)

    def run(options: AllOptions) -> tuple[Setup, Trajectory]:
        model = modelled(scene, options.formulation, options.backend)
        with model.standing_in:
            setup = _set_up(model, start, t0, t1, ts, inputs, options)
            return setup, (
                _integrated(setup) if nothing_is_traced() else warn_if_ill_conditioned(setup, _integrated)
            )

    setup, motion = run(options)
    return retried(run, setup, motion, options) if options.retry else motion


def _integrated(setup: Setup) -> Trajectory:
    """Integrate the motion. Under `jax_debug_nans`, NaN may mark unreached times; a failed motion is
    integrated again without this exception, so that JAX reports the operation that made the NaN.
    """
    if not jax.config.jax_debug_nans:
        return integrate(setup)
    with nan_is_a_mark():
        motion = integrate(setup)
    return motion if np.all(known_numbers(motion.result) <= result_codes.EVENT) else integrate(setup)


def set_up(
    scene: Scene | BuiltFor,
    start=None,
    *,
    t0=None,
    t1=None,
    ts=None,
    inputs=None,
    options: Options | None = None,
    **by_name,
) -> Setup:
    """Return the setup that `simulate` would integrate for these arguments."""
    options = as_options(options, by_name, scene=None if type(options) is AllOptions else scene)
    return _set_up(modelled(scene, options.formulation, options.backend), start, t0, t1, ts, inputs, options)


def _set_up(model: Model, start, t0, t1, ts, inputs, options: AllOptions) -> Setup:
    scene, max_step, (solver, order) = model.scene, options.max_step, solver_of(options)
    if isinstance(solver, FixedStepMethod):
        if max_step is not None:
            raise ValueError(
                f"`max_step` cannot be combined with `{solver.name}`; set its step with "
                f"jj.{solver.name}(step=...)"
            )
        max_step = solver.step
    native = options.backend in ("auto", "native")
    inputs = model.inputs(inputs)
    constant = inputs.constant
    given_ts, (t0, ts, t1) = ts, span_and_times(scene, start, t0, t1, ts)
    if scene.switching.contacts and (known_numbers(t1 - t0) < 0).any():
        raise ValueError(
            f"`{type(scene).__name__}` has contacts with friction, which cannot run backward in "
            f"time from t0 = {t0} to t1 = {t1} s; pass t1 > t0"
        )
    start, usual = _start(model, start, t0, inputs)
    field, dtype = model.field(constant, bool(options.work)), start.q.dtype
    field = solver.fitted(scene, field, model.state) if isinstance(solver, ImplicitMethod) else field
    if not constant:
        check_inputs_in_rows(scene, inputs, t0, t1)
    events = field.event_names if options.events or not all(field.stops) else ()
    static: dict[str, Any] = {"max_steps": options.max_steps, "event_names": events, "tried": options.tried}
    own = own_steps(
        solver,
        **static,
        native=native,
        order=order,
        memory=options.memory or MEMORY,
        most=options.max_transitions,
        stopping=options.events,
    )
    integrator = diffrax_steps.Diffrax(cast(Any, solver), **static) if own is None else own
    # as arrays, so that a new tolerance needs no compilation
    tolerances = tuple(as_array(x, dtype) for x in (options.rtol, options.atol))
    # after two tenfold steps it is the longest; diffrax's own guess would compile the vector field twice more
    first_step = (1.0 if isinstance(solver, FixedStepMethod) else 7e-4) * (t1 - t0)
    longest = LONGEST * abs(t1 - t0) if max_step is None else as_array(max_step, dtype)
    judged = model.once("judged", lambda: is_judged(scene))
    if not options.tried:
        model.once("possible", lambda: check_bodies(scene))
    steps = tolerances, first_step, longest, integrator
    apart = lambda: bool(abs(t1 - t0) > 1e3 * eps_of(t1) * abs(t1))  # otherwise default times may coincide
    fits = not is_traced(t0, t1, ts) and (given_ts is not None or apart())
    setup = Setup(scene, start, inputs, t0, t1, ts, field, *steps, usual, judged, fits, model.decided)
    if own is None:
        diffrax_steps.check(setup)
    if (options.backend == "native" or order is not None) and (reason := setup.reason_against_machine_code):
        asked, advice = (
            ("backend='native'", "use backend='auto', the fastest possible")
            if order is None
            else ("solver=jj.Taylor()", "omit `solver`, or use solver=diffrax.Dopri8()")
        )
        raise ValueError(f"{asked} cannot integrate `{type(scene).__name__}`: {reason}; {advice}")
    return setup


def _start(model: Model, given, t0, inputs: Inputs) -> tuple[State, Usual | None]:
    """Return the start, and the typical sizes by which the compiled program will project it. Only a `State`
    is projected there; any other start is projected here, and the sizes are None.
    """
    if not (isinstance(given, State) and model.formulation.projects):
        return as_state(model, given, t0=t0, inputs=inputs_at(inputs, t0)), None
    q, u = as_coordinates(model.scene, given.q), as_speeds(model.scene, given.u)
    as_given = q is given.q and u is given.u
    return given if as_given else eqx.tree_at(lambda s: (s.q, s.u), given, (q, u)), model.usual(False)


def solver_of(options: AllOptions) -> tuple["diffrax.AbstractSolver | ImplicitMethod | Method", int | None]:
    """Return the solver, by default chosen by the tolerance, and the order if it is a Taylor series. Raises
    ValueError if the tolerance is traced and no solver is given.

    Warns if the precision is too low for the tolerance.
    """
    rtol, solver = options.rtol, options.solver
    if real_type() == np.float32 and np.any(known_numbers(rtol) < 1e-5):
        warn(
            f"rtol = {rtol} is too small for float32; set jax.config.update('jax_enable_x64', True), or "
            "raise rtol and atol to 1e-5"
        )
    if isinstance(solver, Taylor):
        return DOPRI8, solver.order or order_for(rtol)
    if solver is None and is_traced(rtol):
        raise ValueError(
            "`rtol` is traced, so no default solver can be chosen; pass a `solver`, such as diffrax.Dopri8()"
        )
    return solver or (TSIT5 if rtol >= 1e-6 else DOPRI8), None


DEFAULT_SAMPLES = 201  # tuning
_EVEN = np.linspace(0.0, 1.0, DEFAULT_SAMPLES)


def as_state(model: Model | Scene, given, *, what: str = "start", t0=None, inputs=None) -> State:
    """Return the state for a `State`, a dictionary of named values (`jj.start` solves for omitted ones), or
    None for the scene's example.

    `inputs`: the scene's inputs at that time, as a vector or by name (default: zero). Velocity constraints
    may depend on them.
    """
    if isinstance(given, State):
        return given
    if given is not None and not isinstance(given, Mapping):
        advice = "; write `.state` after it" if isinstance(getattr(given, "state", None), State) else ""
        raise ValueError(
            f"`{what}` is {described(given)}, expected a State (from `jj.start` or `jj.consistent`), a "
            f"dictionary of named values, or None for the scene's example{advice}"
        )
    model = modelled(model)
    return named_start(
        model, model.scene.example if given is None else given, one_time(0.0) if t0 is None else t0, inputs
    )


def span_and_times(scene: Scene, start, t0, t1, ts):
    """Return t0, the saved times, and t1. Raises ValueError if concrete values are inconsistent."""
    from_state = isinstance(start, State)
    if from_state and start.q.ndim != 1:
        raise ValueError(
            f"`start` holds a batch of shape {start.q.shape[:-1]}; use `jj.rollout` or "
            "`jax.vmap` for many starts"
        )
    ts = None if ts is None else saved_times(ts)
    t0, t1 = one_time(t0, "t0"), one_time(t1, "t1")
    if t0 is None:
        t0 = as_array(start.t if from_state else 0.0, real_type())
    if t1 is None:
        t1 = as_array(t0 + scene.example_span if ts is None else ts[-1], t0.dtype)
    ends, eps = known_numbers((t0, t1)).tolist(), float(eps_of(t0))
    if ends and not 0 < abs(ends[1] - ends[0]) < np.inf:
        raise ValueError(
            f"the span from t0 = {t0} to t1 = {t1} s is empty or not finite; pass a "
            "finite `t1` different from `t0`"
        )
    if ts is None:
        ts = t0 + (t1 - t0) * _EVEN.astype(t0.dtype)  # computed by NumPy if concrete, without compilation
    elif (
        ends
        and len(known := known_numbers(ts).tolist())
        and not ends_fit(known[0], known[-1], ends[0], ends[1], eps)
    ):
        raise ValueError(
            f"`ts` runs from {ts[0]} to {ts[-1]} s, outside the span from t0 = {t0} to t1 = "
            f"{t1} s or in the opposite direction; pass `t0` and `t1` that enclose `ts`"
        )
    return t0, ts, t1


def saved_times(ts) -> "Float[Array, 'times'] | Float[np.ndarray, 'times']":
    """Return the saved times, a NumPy array if concrete. Raises ValueError unless they are finite and
    strictly monotonic.
    """
    ts = vector_of_times(ts)
    known = known_numbers(ts)
    steps = known[1:] - known[:-1]
    if not ((steps > 0).all() or (steps < 0).all()) or not all_finite(known):
        raise ValueError(
            "`ts` must be finite and strictly increasing (or decreasing, for reversed time); "
            "sort it and drop repeated times"
        )
    return ts
