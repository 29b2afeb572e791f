"""A case of the atlas: a name, tolerances with their reason, and a probe that any method can be put to."""

from collections.abc import Callable
from dataclasses import dataclass

import jax


@dataclass(frozen=True)
class Case:
    """One row of the atlas. `name` begins with the row of the table of hard cases, E1 to E36."""

    name: str
    title: str
    # sets it up, once per process; `cell(method, tolerance)` of what it returns is an `Outcome`
    probe: Callable
    tolerance: float  # float64
    tolerance32: float  # float32
    reason: str  # of both tolerances
    must_be_right: bool = False  # the default path, in float64
    flag_is_right: bool = False  # nothing but a flag is a right answer here
    quick: bool = False


def required(*case, **more) -> Case:
    """A case that the default path must get right in float64."""
    return Case(*case, must_be_right=True, **more)


def unanswered(name, title, probe, reason) -> Case:
    """A case that has no right number: nothing but a flag is right."""
    return Case(name, title, probe, 0.0, 0.0, reason, flag_is_right=True)


def single():
    """Whether this process computes in float32."""
    return not jax.config.jax_enable_x64


def by_type(double, single_value):
    """One value for float64, another for float32."""
    return single_value if single() else double
