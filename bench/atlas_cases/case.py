"""A case of the atlas: a name, tolerances with their reason, and a probe that any method can be put to."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import jax
import jax.numpy as jnp

from atlas_cases.methods import Method
from atlas_cases.outcomes import Outcome


class Probe(Protocol):
    """What a case asks of a method."""

    def cell(self, method: Method, tolerance: float) -> Outcome:
        """What became of `method`."""


@dataclass(frozen=True)
class Case:
    """One row of the atlas. `name` begins with the row of the table of hard cases, E1 to E36."""

    name: str
    title: str
    probe: Callable[[], Probe]  # sets it up; called once per process
    tolerance: float  # float64
    tolerance32: float  # float32
    reason: str  # of both tolerances
    must_be_right: bool = False  # the default path, in float64
    flag_is_right: bool = False  # nothing but a flag is a right answer here
    quick: bool = False


def single() -> bool:
    """Whether this process computes in float32."""
    return not jax.config.jax_enable_x64


def by_type(double, single_value):
    """One value for float64, another for float32."""
    return single_value if single() else double


def real():
    """The floating-point type of this process."""
    return jnp.float32 if single() else jnp.float64
