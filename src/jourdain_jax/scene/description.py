"""Checks of a scene's class: spelling of methods, known coordinate names, ordered bounds.

Without these checks, a misspelt method would be ignored, and its force or constraint would be missing.
"""

import difflib
import inspect
from dataclasses import fields
from functools import lru_cache
from typing import Any

import numpy as np

from jourdain_jax.calculus.code import functions_in, names_in
from jourdain_jax.calculus.reals import all_finite, check_kind, has_unit, known_numbers
from jourdain_jax.scene.coordinates import Names, as_names, check_names
from jourdain_jax.scene.modes import Modes

METHODS = (
    "bodies",
    "coordinate_rates",
    "loads",
    "potential",
    "gauge",
    "prescribed",
    "geometric_constraints",
    "velocity_constraints",
    "contacts",
    "events",
    "invariants",
    "visuals",
)
ATTRIBUTES = (
    "coordinates",
    "speeds",
    "inputs",
    "modes",
    "privileged",
    "domain",
    "conventions",
    "example",
    "example_span",
)
_MEANT = {  # names in other programs and textbooks
    "forces": "loads",
    "applied_forces": "loads",
    "torques": "loads",
    "constraints": "velocity_constraints",
    "nonholonomic_constraints": "velocity_constraints",
    "holonomic_constraints": "geometric_constraints",
    "position_constraints": "geometric_constraints",
}


def check_description(scene, base: Any) -> None:
    """Raise ValueError for a mistake in the description of `scene`, a subclass of `base`. Traced values are
    not checked.
    """
    kind: Any = type(scene)
    misspelt = _misspelt(kind, base)
    if misspelt:
        raise ValueError(misspelt)
    for what in ("speeds", "inputs"):
        names = getattr(scene, what)
        check_kind(
            names, Names | None, f"`{what}` of `{kind.__name__}`", f"names; write {what} = jj.{what}('a b c')"
        )
    check_kind(scene.modes, Modes, f"`modes` of `{kind.__name__}`", "jj.modes(gear=('first', 'second'))")
    if scene.speeds is not None and kind.coordinate_rates is base.coordinate_rates:
        raise ValueError(
            f"`{kind.__name__}` defines speeds ({', '.join(scene.speeds.entries)}) but not the rates of its "
            "coordinates; define `coordinate_rates(self, t, q, u)`, which returns the rates of all "
            "coordinates"
        )
    _check_counts(scene)
    for name in scene.speed_names.entries:
        if name in scene.coordinate_names.entries:
            raise ValueError(
                f"`{kind.__name__}` has a coordinate and a speed named `{name}`; rename one of them"
            )
    _check_domain(scene)
    example = inspect.getattr_static(kind, "example")
    if isinstance(example, dict):
        valid = [
            name
            for names in (scene.coordinate_names, scene.speed_names)
            for name in (*names.entries, *(group for group, _, _ in names.groups))
        ]
        _check_keys(kind, "example", example, valid)


def checked_arguments(kind: type, given: dict) -> None:
    """Raise ValueError, with the nearest valid name, for an unknown argument of a new scene."""
    known = {field.name for field in fields(kind) if field.init}
    unknown = [name for name in given if name not in known]
    if not unknown:
        return
    taken = list(inspect.signature(kind.__init__).parameters.values())  # type: ignore[misc]
    valid = [parameter.name for parameter in taken][1:]
    if any(parameter.kind is inspect.Parameter.VAR_KEYWORD for parameter in taken):
        return
    check_names(unknown, valid, f"scene `{kind.__name__}` has no parameter `{{}}`")


@lru_cache(maxsize=512)
def _misspelt(kind: type, base: type) -> str:
    """Return an error message about a misspelt method, attribute or field of a class; empty if
    there is none.
    """
    own = {field.name for field in fields(kind)}
    owners = [owner for owner in kind.__mro__ if owner not in base.__mro__]
    read = {
        name
        for owner in owners
        for member in vars(owner).values()
        for f in functions_in(member)
        for name in names_in(f.__code__)
    }
    for owner in owners:
        annotated = inspect.get_annotations(owner)
        for name, member in vars(owner).items():
            if name in own and name not in annotated:
                return (
                    f"`{owner.__name__}` sets `{name}`, a field of a base class, without an annotation, "
                    f"which has no effect on scenes; write `{name}: float = jj.parameter(...)`, or pass the "
                    f"value: `{kind.__name__}({name}=...)`"
                )
            known = name.startswith("_") or name in own or name in ATTRIBUTES or hasattr(base, name)
            if known or name in read or isinstance(member, type | staticmethod | classmethod):
                continue
            callable_ = callable(member) or isinstance(member, property)
            near = [_MEANT[name]] if callable_ and name in _MEANT else []
            # the cutoff matches `load` to `loads`, but not `contact_arm` to `contacts`
            meant = (*METHODS, *ATTRIBUTES) if callable_ else ATTRIBUTES
            near = near or difflib.get_close_matches(name, meant, n=1, cutoff=0.85)
            # where the method of the right name exists too, this one is a helper
            if near and not any(name in vars(one) and near[0] in vars(one) for one in kind.__mro__):
                what = "a method" if callable_ else "an attribute"
                return (
                    f"`{kind.__name__}` has {what} `{name}`, which nothing calls; did you mean `{near[0]}`? "
                    f"Rename it, or begin its name with an underscore (`_{name}`)"
                )
    return next(filter(None, (_wrong_arguments(kind, base, name) for name in METHODS)), "")


def _wrong_arguments(kind: type, base: type, name: str) -> str:
    """Return an error message about the arguments of a method; empty if they are right or unknown."""
    expected = inspect.signature(getattr(base, name))
    try:
        taken = inspect.signature(getattr(kind, name))
    except (TypeError, ValueError):  # not a function of Python
        return ""
    every = list(expected.parameters)
    if isinstance(inspect.getattr_static(kind, name), staticmethod | classmethod):
        every = every[1:]
    try:
        taken.bind(*every)
    except TypeError:
        given = ", ".join(taken.parameters)
        return f"`{name}` of `{kind.__name__}` takes ({given}), expected ({', '.join(every)})"
    return ""


def _check_counts(scene) -> None:
    """Raise ValueError for an integer field that is neither static nor a parameter. JAX would trace the
    field, and a traced number cannot be the number of iterations of a loop.
    """
    for field in fields(scene):
        value, known = getattr(scene, field.name), field.metadata
        if isinstance(value, int) and not known.get("static") and not known.get("parameter"):
            raise ValueError(
                f"field `{field.name}` of `{type(scene).__name__}` is {value}, which is not a parameter; for "
                f"a count or switch write `{field.name}: {type(value).__name__} = eqx.field(static=True, "
                f"default={value})`, for a number `{field.name} = jj.parameter({float(value)})`"
            )


def _check_domain(scene) -> None:
    kind, domain = type(scene), scene.domain
    _check_keys(kind, "domain", domain, (*scene.coordinate_names.entries, *scene.speed_names.entries))
    for name, pair in domain.items():
        if has_unit(pair) or np.shape(pair) != (2,) or not _is_ordered(known_numbers(pair)):
            raise ValueError(
                f"`domain` of `{kind.__name__}` gives {pair} for `{name}`, expected two finite "
                "numbers (low, high) with low <= high"
            )


def _is_ordered(pair: np.ndarray) -> bool:
    """Return whether the numbers are finite and do not decrease."""
    return pair.dtype.kind in "biuf" and bool(all_finite(pair) and np.all(np.diff(pair) >= 0))


def _check_keys(kind: type, what: str, given, valid) -> None:
    check_kind(given, dict, f"`{what}` of `{kind.__name__}`", "a dictionary of coordinate or speed names")
    check_names(
        as_names(given),
        valid,
        f"`{what}` of `{kind.__name__}` names `{{}}`, which is not a coordinate or speed",
    )
