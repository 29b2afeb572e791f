"""Values of SymPy expressions at random states, used to detect constants, rates of coordinates, and repeated
constraints.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from jourdain_jax.calculus.reals import all_finite
from jourdain_jax.importers.formulas import Formulas, sympy_package
from jourdain_jax.importers.sympy_system import MechanicalSystem

_STATES, _TRIES = 3, 40  # number of random states that are compared, and limit of tried states
_STEP = 1e-6  # of finite differences


@dataclass(frozen=True)
class Sample:
    """One state, with values and rates of expressions, by the name of their list."""

    leaves: dict[Any, float]
    values: dict[str, Float[np.ndarray, "_"]]
    rates: dict[str, Float[np.ndarray, "_"]]


def symbols_in(expressions: Iterable[Any]) -> set[Any]:
    """Return functions of time, their rates, and symbols in the expressions."""
    sympy = sympy_package()
    time = sympy.physics.mechanics.dynamicsymbols._t
    found: set[Any] = set()
    for expression in map(sympy.sympify, expressions):
        found |= (
            expression.atoms(sympy.core.function.AppliedUndef, sympy.Derivative) | expression.free_symbols
        )
    return {x for x in found if x.args == (time,) or x.is_Symbol or isinstance(x, sympy.Derivative)}


def sampled(
    system: MechanicalSystem, lists: Mapping[str, Iterable[Any]], rows: Iterable[Any] = ()
) -> list[Sample]:
    """Return the first random states at which all expressions are finite. Random speeds are projected onto
    the constraints `rows`, which are affine in the speeds.

    Constants with given numbers have these. Raises ValueError, with the name of a list, if there are too few
    such states.
    """
    named: dict[Any, list] = {name: list(expressions) for name, expressions in lists.items()}
    named[""] = [system.rates[q.diff(system.time)] for q in system.coordinates]
    kept = [system.resolved(row) for row in rows]
    expressions = [*kept, *(e for several in named.values() for e in several)]
    symbols = sorted(symbols_in(expressions) | {*system.coordinates, *system.speeds, system.time}, key=str)
    formulas, held = Formulas(named, symbols), Formulas({"rows": kept}, symbols)
    generator = np.random.default_rng(0)
    found: list[Sample] = []
    worst = ""
    for _ in range(_TRIES):
        drawn = generator.uniform(0.1, 0.9, len(symbols)) * generator.choice([-1.0, 1.0], len(symbols))
        leaves = {
            x: system.given.get(str(x), float(number)) for x, number in zip(symbols, drawn, strict=True)
        }
        if kept:
            leaves |= _meeting(
                affine(lambda at: held.numbers(at)["rows"], leaves, system.speeds), leaves, system.speeds
            )
        values = formulas.numbers(leaves)
        ahead, behind = (
            formulas.numbers(
                leaves
                | {q: leaves[q] + step * rate for q, rate in zip(system.coordinates, values[""], strict=True)}
                | {system.time: leaves[system.time] + step}
            )
            for step in (_STEP, -_STEP)
        )
        rates = {name: (ahead[name] - behind[name]) / (2 * _STEP) for name in values}
        infinite = [name for name in values if not all_finite([values[name], rates[name]])]
        if infinite:
            worst = infinite[0] or "rate of a coordinate"
            continue
        found.append(Sample(leaves, values, rates))
        if len(found) == _STATES:
            return found
    raise ValueError(
        f"the {worst} has no finite value at {_TRIES - _STATES + 1} of {_TRIES} random states; check its "
        "expressions and the values of its constants"
    )


def affine(
    values: Callable[[dict], np.ndarray], leaves: dict[Any, float], speeds: Sequence[Any]
) -> Float[np.ndarray, "rows columns"]:
    """Return `[A b]` of the affine function A u + b, computed by `values(leaves)` at rest and at a unit of
    each speed.
    """
    rest = leaves | dict.fromkeys(speeds, 0.0)
    b = values(rest)
    return np.stack([*(values(rest | {speed: 1.0}) - b for speed in speeds), b], axis=1)


def _meeting(
    both: Float[np.ndarray, "rows columns"], leaves: dict[Any, float], speeds: Sequence[Any]
) -> dict[Any, float]:
    """Return the nearest speeds that satisfy the constraints `both`; NaN if these are NaN."""
    u = np.array([leaves[speed] for speed in speeds])
    u = (
        u - np.linalg.pinv(both[:, :-1]) @ (both[:, :-1] @ u + both[:, -1])
        if all_finite(both)
        else u * np.nan
    )
    return dict(zip(speeds, map(float, u), strict=True))
