"""What is handed to `simulate` and its kin, checked: starts, tolerances, and objects of diffrax where a text or a class was given."""

import difflib
from collections.abc import Mapping

import diffrax
import numpy as np

from jourdain_jax.motion.start import State, named_start
from jourdain_jax.scene.arguments import as_input_vector
from jourdain_jax.scene.numbers import checked_unless_traced, described, is_traced
from jourdain_jax.scene.scene import Scene

_KINDS = {
    "solver": (diffrax.AbstractSolver, "diffrax.Dopri8()"),
    "adjoint": (diffrax.AbstractAdjoint, "diffrax.DirectAdjoint()"),
    "stepsize_controller": (diffrax.AbstractStepSizeController, "diffrax.PIDController(rtol=1e-8, atol=1e-8)"),
    "saveat": (diffrax.SaveAt, "diffrax.SaveAt(ts=...)"),
}


def as_state(scene: Scene, given, *, what: str = "start", t0=0.0, inputs=None) -> State:
    """A state from a `State`, a dictionary of named values (the rest is solved for, as by `jj.start`), or None for the scene's example.

    `inputs`: the scene's inputs at that instant, a vector or by name (default: zero); they count where velocity rows depend on them.
    """
    if isinstance(given, State):
        return given
    if given is not None and not isinstance(given, Mapping):
        raise ValueError(
            f"`{what}` is {described(given)}, expected a State (from `jj.start` or `jj.consistent`), a dictionary of named values, or None for the "
            "scene's example"
        )
    return named_start(scene, scene.example if given is None else given, t0, as_input_vector(scene, inputs))


def check_options(*, rtol=1e-8, atol=1e-8, max_steps=1, dt0=None, switches: dict | None = None, **objects) -> None:
    """ValueError for tolerances that are no positive numbers, and for `solver`, `adjoint`, ... that are no objects of their kind (None is let pass)."""
    for name, value in (("rtol", rtol), ("atol", atol)):
        number = checked_unless_traced(value, f"`{name}`", (), advice="give one number, such as 1e-8")
        if not is_traced(number) and not 0 < float(number) < np.inf:
            raise ValueError(f"`{name}` is {float(number):g}, expected a positive finite number; give a tolerance such as 1e-8")
    for name, value in (switches or {}).items():
        if not isinstance(value, bool | np.bool_):
            raise ValueError(f"`{name}` is {described(value)}, expected True or False")
    if dt0 is not None:
        first = checked_unless_traced(dt0, "`dt0`", (), advice="give the first step in s, or None for 1e-4 of the span")
        if not is_traced(first) and not 0 < abs(float(first)) < np.inf:
            raise ValueError(f"`dt0` is {float(first):g}, expected a finite first step in s that is not zero; or None for 1e-4 of the span")
    if max_steps is not None and (not isinstance(max_steps, int | np.integer) or isinstance(max_steps, bool) or max_steps < 1):
        raise ValueError(f"`max_steps` is {max_steps!r}, expected a whole number of at least 1; give the number of steps after which to stop")
    for name, value in objects.items():
        kind, example = _KINDS[name]
        if value is not None and not isinstance(value, kind):
            raise ValueError(f"`{name}` is {described(value)}, expected an object of diffrax; write `{_meant(value, kind) or example}`")


def _meant(value, kind: type) -> str:
    """The object that a text or a class may stand for."""
    if isinstance(value, type) and issubclass(value, kind):
        return f"diffrax.{value.__name__}()"
    if not isinstance(value, str):
        return ""
    members = {name.lower(): name for name, member in vars(diffrax).items() if isinstance(member, type) and issubclass(member, kind)}
    near = difflib.get_close_matches(value.lower(), [name for name in members if not name.startswith("abstract")], n=1, cutoff=0.5)
    return f"diffrax.{members[near[0]]}()" if near else ""
