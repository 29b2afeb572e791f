"""Options of integration: one object for `simulate`, `rollout`, `fit`, `Study` and similar functions. These
functions also accept its fields by name.
"""

import difflib
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any, TypedDict

import jax
import numpy as np

from jourdain_jax.calculus.reals import (
    Number,
    Numbers,
    checked_unless_traced,
    checked_whole,
    described,
    known_numbers,
)
from jourdain_jax.integrate.explicit_steps import Method, Taylor, diffrax
from jourdain_jax.integrate.implicit_steps import ImplicitMethod
from jourdain_jax.scene.arguments import BuiltFor
from jourdain_jax.scene.coordinates import nearest

if TYPE_CHECKING:
    from jourdain_jax.integrate.vector_fields.field import Formulation

TOLERANCE, MOST_STEPS = 1e-8, 100_000  # numerics


@dataclass(frozen=True)
class Options:
    """Options of integration.

    - `rtol`, `atol`: tolerances of a step, relative and absolute.
    - `solver`: a diffrax solver or one of `jj.Taylor`, `jj.RadauIIA`, `jj.ImplicitMidpoint`,
      `jj.DiscreteLagrangeDAlembert`, `jj.DiscreteGradient`. `diffrax.diffeqsolve` runs diffrax's solvers,
      except Tsit5, Dopri5 and Dopri8, which run in this package's loop. The last three solvers of `jj` take
      equal steps of at most their `step` between saved times. None: Tsit5 for rtol >= 1e-6, Dopri8 below.
    - `max_steps`: maximum number of steps; `max_step`: the longest step (s). None: 1/14 of the span, so that
      brief loads and brief dips of event values are not missed; inf: no limit.
    - `events`: stop where an event value of the scene falls through zero. False: ignore events that stop a
      motion; events after which it continues stay active. `work`: integrate the work of loads that have no
      potential.
    - `max_transitions`: maximum number of events after which a motion continues (`jj.Event`).
    - `retry`: repeat a failed motion with the full state if its independent speeds became invalid, or with an
      implicit solver if it is stiff and no `solver` is given. `trajectory.fallback` and the summary report
      the retry. With False, or inside your own `jit` or `vmap`, there is no retry.

    `simulate` and similar functions take an `Options`, or its fields by name, which take precedence.

    **Examples**

        careful = jj.Options(rtol=1e-11, atol=1e-11, max_step=0.1)
        motion = jj.simulate(jj.models.TiltingDisc(), t1=1.0, options=careful)
        leans = {"lean": jnp.linspace(0.1, 0.3, 4)}
        lanes = jj.rollout(jj.models.TiltingDisc(), leans, t1=1.0, options=careful, events=False)
    """

    rtol: Number = TOLERANCE
    atol: Number = TOLERANCE
    solver: "diffrax.AbstractSolver | ImplicitMethod | Taylor | None" = None
    max_steps: int = MOST_STEPS
    max_step: Number | None = None
    events: bool = True
    work: bool = True
    retry: bool = False
    max_transitions: int = 1000


@dataclass(frozen=True)
class AllOptions(Options):
    """Options with all further settings of the integration."""

    solver: "diffrax.AbstractSolver | ImplicitMethod | Taylor | Method | None" = None
    formulation: "Formulation | None" = None
    backend: str = "auto"
    memory: int | None = None  # of a model: limit in bytes for batches and reverse mode; None: `setup.MEMORY`
    # whether a fit tries these parameters: values and tangents are computed in one run, for `jvp` and
    # `jacfwd` only, and moments of inertia may be impossible, since the minimum may lie beyond such a body
    tried: bool = False


class OptionFields(TypedDict, total=False):
    """Fields of `Options` by name, and all further settings of the integration."""

    rtol: Number
    atol: Number
    solver: "diffrax.AbstractSolver | ImplicitMethod | Taylor | None"
    max_steps: int
    max_step: Number | None
    events: bool
    work: bool
    retry: bool
    max_transitions: int
    formulation: "Formulation | None"
    backend: str


class MotionFields(OptionFields, total=False):
    """Span and inputs of a motion by name, and `OptionFields`."""

    t0: Number
    t1: Number
    ts: Numbers
    inputs: Any


SPAN = ("t0", "t1", "ts", "inputs")  # arguments of a motion by name besides its options
_STATIC = ("max_steps", "max_transitions", "events", "work", "retry", "backend", "memory", "tried")
OPTION_NAMES = tuple(OptionFields.__annotations__)


def _register(kind: type[Options]) -> None:
    """Register a class of options as a pytree whose leaves may be any object."""
    names = [field.name for field in fields(kind)]
    leaves = [name for name in names if name not in _STATIC]
    static = [name for name in names if name in _STATIC]

    def unflattened(known: tuple, values) -> Options:
        options = object.__new__(kind)
        vars(options).update(zip((*leaves, *static), (*values, *known), strict=True))
        return options

    def flattened(options: Options) -> tuple[list, tuple]:
        return [getattr(options, name) for name in leaves], tuple(getattr(options, name) for name in static)

    jax.tree_util.register_pytree_node(kind, flattened, unflattened)


_register(Options)
_register(AllOptions)
_DEFAULT = AllOptions()
_BY_DIFFRAX = "call `diffrax.diffeqsolve(jj.diffrax_term(scene), ...)` with it"
GONE = {  # replacements of removed options
    "adjoint": (
        f"all motions have derivatives in forward and in reverse mode; for a diffrax adjoint {_BY_DIFFRAX}"
    ),
    "dt0": (
        "the first step is 7e-4 of the span; structure-preserving solvers have their own, as in "
        "solver=jj.ImplicitMidpoint(step=0.01)"
    ),
    "memory": "a model has its own; pass it to `jj.build`",
    "saveat": f"pass times to save as `ts`; for values between steps, or at each step, {_BY_DIFFRAX}",
    "stepsize_controller": (
        "pass `rtol`, `atol` and `max_step`, or solver=jj.ImplicitMidpoint(step=0.01); "
        f"for another control {_BY_DIFFRAX}"
    ),
}


def as_options(
    options: Options | None,
    by_name: Mapping[str, Any],
    function: str = "simulate",
    refused: Mapping[str, str] | None = None,
    scene=None,
) -> AllOptions:
    """Return the options of a call of `function`: the fields of `options`, overridden by those given by name.

    `refused`: names that do not apply to this function, with reasons. `scene`: if it is a model, it supplies
    formulation, backend and memory. Raises TypeError for refused and unknown names, ValueError for invalid
    values.
    """
    of_model = (
        {name: getattr(scene, name) for name in ("formulation", "backend", "memory")}
        if isinstance(scene, BuiltFor)
        else {}
    )
    if not (by_name or of_model) and (options is None or type(options) is AllOptions):
        return _DEFAULT if options is None else options
    if options is not None and not isinstance(options, Options):
        raise ValueError(f"`options` is {described(options)}, expected `jj.Options(...)`")
    refusals = dict.fromkeys(of_model, "a model has its own; pass it to `jj.build`") | dict(refused or {})
    for name in by_name:
        if name in refusals:
            raise TypeError(f"{function}() takes no `{name}`: {refusals[name]}")
        if name in GONE:
            raise TypeError(f"`{name}` is no longer an option: {GONE[name]}")
        if name not in OPTION_NAMES:
            known = [option for option in (*SPAN, *OPTION_NAMES) if option not in refusals]
            raise TypeError(
                f"{function}() got an unexpected keyword argument '{name}'; {nearest(name, known)}"
            )
    found = AllOptions(**({} if options is None else vars(options)) | of_model | dict(by_name))
    _check(found)
    return found


def bytes_of(memory: Any) -> int:
    """Return the number of bytes that `memory` states: a number, or a text such as "2GB" (1 GB = 10^9 bytes)
    or "500 MiB" (1 MiB = 2^20 bytes). Raises ValueError for anything else.
    """
    found = re.fullmatch(
        r"\s*([0-9]*\.?[0-9]+(?:e[0-9]+)?)\s*(?:(?:([kmgt])(i?))?b)?\s*", str(memory).lower()
    )
    if isinstance(memory, bool) or not found or not math.isfinite(float(found[1])):
        raise ValueError(
            f"`memory` is {described(memory)}, expected a number of bytes, or a text such as '2GB' or '500MB'"
        )
    return int(float(found[1]) * (1024 if found[3] else 1000) ** " kmgt".index(found[2] or " "))


def stated(options: AllOptions) -> dict[str, Any]:
    """Return the options that differ from the defaults, by name."""
    return {
        name: value
        for name, value in vars(options).items()
        if value is not getattr(_DEFAULT, name) and value != getattr(_DEFAULT, name)
    }


_POSITIVE = (
    lambda x: (x > 0) & (x < np.inf),
    "a positive finite number; pass a tolerance such as 1e-8",
    "pass one number, such as 1e-8",
)
_NUMBERS = {  # condition, expectation and advice
    "rtol": _POSITIVE,
    "atol": _POSITIVE,
    "max_step": (
        lambda x: x > 0,
        "a positive time in s; None limits steps to 1/14 of the span, inf sets no limit",
        "pass the longest step in s, None for 1/14 of the span, or inf for no limit",
    ),
}


def _check(options: AllOptions) -> None:
    """Raise ValueError for numbers out of range and for objects of a wrong type."""
    for name, (fits, expected, advice) in _NUMBERS.items():
        value = getattr(options, name)
        if (type(value) is float and fits(value)) or (value is None and name == "max_step"):
            continue
        number = checked_unless_traced(value, f"`{name}`", (), advice=advice)
        if not np.all(fits(known_numbers(number))):
            raise ValueError(f"`{name}` is {float(number):g}, expected {expected}")
    for name in ("events", "work", "retry"):
        if not isinstance(value := getattr(options, name), bool | np.bool_):
            raise ValueError(f"`{name}` is {described(value)}, expected True or False")
    for name, what in (("max_steps", "steps"), ("max_transitions", "events")):
        expected = f"of at least 1; pass the number of {what} after which to stop"
        checked_whole(getattr(options, name), f"`{name}`", 1, expected=expected)
    solver = options.solver
    own = solver is None or isinstance(solver, Taylor | Method | ImplicitMethod)
    if not own and not isinstance(solver, diffrax.AbstractSolver):
        raise ValueError(
            f"`solver` is {described(solver)}, expected a solver object; write "
            f"`{_meant(solver) or 'diffrax.Dopri8()'}`"
        )


def _meant(value) -> str:
    """Return code for the solver that a string or class probably means; empty if none is similar."""
    kind = diffrax.AbstractSolver
    if isinstance(value, type) and issubclass(value, kind | ImplicitMethod | Taylor):
        return f"{'jj' if value.__module__.startswith('jourdain_jax') else 'diffrax'}.{value.__name__}()"
    if not isinstance(value, str):
        return ""
    members = {
        name.lower(): name
        for name in dir(diffrax)
        if isinstance(member := getattr(diffrax, name), type) and issubclass(member, kind)
    }
    near = difflib.get_close_matches(
        value.lower(), [name for name in members if not name.startswith("abstract")], n=1, cutoff=0.5
    )
    return f"diffrax.{members[near[0]]}()" if near else ""
