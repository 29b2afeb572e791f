"""Errors in a user's own methods: the traceback shows their lines, and leaves out those of this package and of JAX between them; and lines of warnings.

As with JAX's own filtering, JAX_TRACEBACK_FILTERING=off shows all of them. Errors on whose way no user's method was keep their whole traceback.
"""

import functools
import sys
import sysconfig
from collections.abc import Callable
from pathlib import Path
from types import FrameType, TracebackType
from typing import TypeVar

import jax

from jourdain_jax.calculus.promotion import with_usual_promotion

F = TypeVar("F", bound=Callable)
_OURS = str(Path(__file__).parents[1])
_INSTALLED = tuple(sysconfig.get_paths()[name] for name in ("stdlib", "platstdlib", "purelib", "platlib"))
_NOTE = "Lines of jourdain_jax between yours are left out of this traceback; JAX_TRACEBACK_FILTERING=off shows them."


def shown_from_users_lines(function: F) -> F:
    """The function, whose errors show users' lines where any of these was on the way: a method of a scene, an input, an event; in usual modes of promotion."""

    @functools.wraps(function)
    def called(*args, **kwargs):
        __tracebackhide__ = True  # for IPython and pytest
        try:
            usual = jax.config.jax_numpy_dtype_promotion == "standard" and jax.config.jax_numpy_rank_promotion == "allow"
            return (function if usual else with_usual_promotion(function))(*args, **kwargs)
        except Exception as error:
            if not _is_shortened(error):
                raise
            raise error.with_traceback(_of_users(error.__traceback__)) from error.__cause__

    return called  # type: ignore[return-value]


def users_level() -> int:
    """The `stacklevel` with which a warning, given where this is called, shows the user's line that led there."""
    frame, level = sys._getframe(1), 1
    while frame.f_back is not None and not _is_users(frame):
        frame, level = frame.f_back, level + 1
    return level


def _is_shortened(error: BaseException) -> bool:
    """Whether the error comes from a user's line, called from here; then it has the note."""
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
    """Whether a line stands neither here nor in an installed package or Python's own library."""
    return not frame.f_code.co_filename.startswith((_OURS, *_INSTALLED, "<frozen"))


def _of_users(traceback: TracebackType | None) -> TracebackType | None:
    """The traceback without lines of this package and of JAX."""
    kept: TracebackType | None = None
    for entry in reversed(_frames(traceback)):
        if _is_users(entry.tb_frame):
            kept = TracebackType(kept, entry.tb_frame, entry.tb_lasti, entry.tb_lineno)
    return kept
