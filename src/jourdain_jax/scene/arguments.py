"""Checks of arguments of public functions: the scene, vectors of q and u, inputs.

The checks read types and shapes only. Both are known during tracing, so the checks add
nothing to compiled programs.

The traceback of an error in a user's method shows only the user's lines; set JAX_TRACEBACK_FILTERING=off to
see all lines. Tracebacks of other errors are complete.
"""

import sys
import sysconfig
import warnings
from collections.abc import Callable, Mapping
from functools import wraps
from pathlib import Path
from types import FrameType, TracebackType
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jourdain_jax.calculus.compilation import with_usual_promotion
from jourdain_jax.calculus.derivative_errors import DifferentiationModeError
from jourdain_jax.calculus.reals import (
    Entries,
    Number,
    Numbers,
    PerCoordinate,
    Scalar,
    Speeds,
    at_once,
    checked_real,
    checked_unless_traced,
    described,
    is_traced,
    real_type,
)
from jourdain_jax.scene.coordinates import Labels, check_names
from jourdain_jax.scene.scene import Scene

F = TypeVar("F", bound=Callable)


class BuiltFor:
    """A scene with its formulation, backend and memory: the base of `Model` (`motion/model.py`). Functions
    that call `as_scene` accept it in place of a scene.
    """

    scene: Scene
    formulation: Any
    backend: str
    memory: int | None
    reference: Any

    def __getattr__(self, name: str):
        raise AttributeError(
            f"`{type(self).__name__}` has no attribute `{name}`; its scene is the attribute `scene`"
        )


def as_scene(scene) -> Scene:
    """Return `scene`, or the scene of a model. Raises ValueError for any other value, such as a
    scene class.
    """
    if isinstance(scene, Scene):
        return scene
    if isinstance(scene, BuiltFor):
        return scene.scene
    if isinstance(scene, type) and issubclass(scene, Scene):
        raise ValueError(
            f"`scene` is the class `{scene.__name__}`, expected an instance; write `{scene.__name__}()`, "
            "with parameters in the parentheses"
        )
    raise ValueError(
        f"`scene` is {described(scene)}, expected a scene: an instance of a subclass of `jj.Scene`"
    )


def of_known_numbers(function: F) -> F:
    """Decorate a function of a scene or motion so that it computes with concrete numbers, even inside
    `jit`, `vmap` and derivatives.

    For a traced argument the decorated function raises DifferentiationModeError with its own name.
    """

    @wraps(function)
    def called(known, *args, **kwargs):
        known = known.scene if isinstance(known, BuiltFor) else known
        if is_traced(known, args, kwargs):
            raise DifferentiationModeError(
                f"`{function.__name__}` was called inside jit, vmap or a derivative with traced numbers; "
                "call it outside"
            )
        with at_once():
            return function(known, *args, **kwargs)

    return called  # type: ignore[return-value]


def as_time(t: Number) -> Scalar:
    """Return a time in s, as a number of the default floating-point type."""
    advice = "give one time in s; use `jax.vmap` for many"
    return checked_real(t, "`t`", (), advice=advice).astype(real_type())


def one_time(t, name: str = "t"):
    """Return a time as a NumPy number, a tracer if it is traced, or None if it is None. Raises ValueError,
    with the argument's name, for any other value.
    """
    advice = "give one time in s; use `jax.vmap` for many"
    return None if t is None else checked_unless_traced(t, f"`{name}`", (), advice=advice)


def vector_of_times(ts) -> Float[Entries, "times"]:
    """Return a vector of times in s, as a NumPy array unless it is traced. Raises ValueError if
    it is empty or not a vector.
    """
    ts = checked_unless_traced(ts, "`ts`", advice="give a vector of times in s")
    if ts.ndim != 1 or ts.size == 0:
        raise ValueError(f"`ts` has shape {ts.shape}, expected a vector of at least one time in s")
    return ts


def as_coordinates(scene: Scene, q) -> PerCoordinate:
    """Return q as a vector of the scene's coordinates."""
    return _as_vector(scene, "q", q, as_scene(scene).coordinate_names.entries)


def as_speeds(scene: Scene, u, what: str = "u") -> Speeds:
    """Return u, or another vector over the speeds, as a vector of the scene's speeds.
    `what`: its name in messages.
    """
    return _as_vector(scene, what, u, as_scene(scene).speed_names.entries)


def _as_vector(scene: Scene, what: str, x, names: Labels) -> Array:
    if isinstance(x, jax.Array) and x.shape == (len(names),) and x.dtype == real_type() and not x.weak_type:
        return x  # the usual case, twenty times faster than the checks below
    listed = ", ".join(names)
    if isinstance(x, Mapping):
        raise ValueError(
            f"`{what}` of `{type(scene).__name__}` is a dictionary, expected a vector of "
            f"{listed}; `jj.start(scene, **values)` makes one by name"
        )
    advice = f"one number for each of {listed}; use `jax.vmap` or `rollout` for many states"
    return checked_real(x, f"`{what}` of `{type(scene).__name__}`", (len(names),), advice=advice).astype(
        real_type()
    )


class ChangingInputs(eqx.Module):
    """Inputs as linear functions of time near `t`. The rates matter where inputs occur in constraints:
    accelerations depend on them.
    """

    t: Scalar  # s
    values: Float[Array, "inputs"]
    rates: Float[Array, "inputs"]  # per s

    def __call__(self, t) -> Float[Array, "inputs"]:
        """Return the values at a time near `t`."""
        return self.values + self.rates * (t - self.t)


# values of inputs at one instant
InputLike = Numbers | Mapping[str, Any] | ChangingInputs | None


def as_input_vector(scene: Scene, inputs, dtype=None) -> Float[Array, "inputs"]:
    """Return the scene's inputs at one instant as a vector. `inputs`: a vector, a dictionary, or None;
    omitted inputs are zero.
    """
    names = scene.inputs.entries
    if inputs is None:
        return jnp.zeros(len(names), dtype)
    if not isinstance(inputs, Mapping):
        listed = ", ".join(names) or "none: the scene has no inputs"
        return checked_real(
            inputs,
            f"`inputs` of `{type(scene).__name__}`",
            (len(names),),
            advice=f"one number for each of {listed}",
        )
    check_names(inputs, names, f"`{type(scene).__name__}` has no input `{{}}`")
    advice = "give its value at this instant; only `simulate` takes functions of time"
    inputs = {
        name: scene.modes.number(name, x, "`inputs`") if name in dict(scene.modes.pairs) else x
        for name, x in inputs.items()
    }
    values = [
        checked_real(inputs.get(name, 0.0), f"input `{name}` of `{type(scene).__name__}`", (), advice=advice)
        for name in names
    ]
    return jnp.stack(values) if values else jnp.zeros(0, dtype)


_OURS = str(Path(__file__).parents[1])
_INSTALLED = tuple(sysconfig.get_paths()[name] for name in ("stdlib", "platstdlib", "purelib", "platlib"))
_NOTE = (
    "Lines of jourdain_jax between yours are omitted from this traceback; JAX_TRACEBACK_FILTERING=off shows"
    " them."
)


def shown_from_users_lines(function: F) -> F:
    """Decorate a function so that the tracebacks of its errors show only the user's lines, if there are any,
    such as lines of a scene's method. While it runs, JAX promotes types by its default rules.
    """

    @wraps(function)
    def called(*args, **kwargs):
        __tracebackhide__ = True  # for IPython and pytest
        try:
            modes = jax.config.jax_numpy_dtype_promotion, jax.config.jax_numpy_rank_promotion
            usual = modes == ("standard", "allow")
            return (function if usual else with_usual_promotion(function))(*args, **kwargs)
        except Exception as error:
            if not _is_shortened(error):
                raise
            raise error.with_traceback(_of_users(error.__traceback__)) from error.__cause__

    return called  # type: ignore[return-value]


def warn(text: str, kind: type[Warning] = UserWarning) -> None:
    """Issue a warning that points to the user's line."""
    frame, level = sys._getframe(), 1
    while frame.f_back is not None and not _is_users(frame):
        frame, level = frame.f_back, level + 1
    warnings.warn(text, kind, stacklevel=level)


def _is_shortened(error: BaseException) -> bool:
    """Return whether the traceback contains a user's line. If so, add a note to the
    error on how to see all lines.
    """
    if jax.config.jax_traceback_filtering == "off":
        return False
    if not any(_is_users(entry.tb_frame) for entry in _frames(error.__traceback__)):
        return False
    if _NOTE not in getattr(error, "__notes__", ()):
        error.add_note(_NOTE)
    return True


def _frames(traceback: TracebackType | None) -> list[TracebackType]:
    found = []
    while traceback is not None:
        found.append(traceback)
        traceback = traceback.tb_next
    return found


def _is_users(frame: FrameType) -> bool:
    """Return whether a frame is outside this package, installed packages and Python's library."""
    return not frame.f_code.co_filename.startswith((_OURS, *_INSTALLED, "<frozen"))


def _of_users(traceback: TracebackType | None) -> TracebackType | None:
    """Return the traceback with the user's lines only."""
    kept: TracebackType | None = None
    for entry in reversed(_frames(traceback)):
        if _is_users(entry.tb_frame):
            kept = TracebackType(kept, entry.tb_frame, entry.tb_lasti, entry.tb_lineno)
    return kept
