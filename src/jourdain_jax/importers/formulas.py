"""Evaluation of SymPy expressions on JAX or NumPy, with common subexpressions evaluated once."""

from collections.abc import Mapping, Sequence
from functools import reduce
from types import ModuleType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jourdain_jax.calculus.files import shortened
from jourdain_jax.calculus.lazy_imports import needed

_FUNCTIONS = {
    **{name: name for name in ("sin", "cos", "tan", "sinh", "cosh", "tanh", "exp", "log", "sign", "floor")},
    **{f"a{name}": f"arc{name}" for name in ("sin", "cos", "tan", "sinh", "cosh", "tanh")},
    **{"Abs": "abs", "atan2": "arctan2", "ceiling": "ceil", "Heaviside": "heaviside", "Not": "logical_not"},
    **{"Equality": "equal", "Unequality": "not_equal", "StrictLessThan": "less", "LessThan": "less_equal"},
    **{"StrictGreaterThan": "greater", "GreaterThan": "greater_equal"},
}
_OF_MANY = {
    "Add": "add",
    "Mul": "multiply",
    "Min": "minimum",
    "Max": "maximum",
    "And": "logical_and",
    "Or": "logical_or",
}
_KNOWN = {
    *_FUNCTIONS,
    *_OF_MANY,
    "Pow",
    "Piecewise",
    "ExprCondPair",
    "sinc",
    "erf",
    "BooleanTrue",
    "BooleanFalse",
}


def sympy_package() -> Any:
    """Return the package `sympy`. Raises ImportError with the command that installs it if it is missing."""
    needed("sympy.physics.mechanics", "a scene from SymPy")
    return needed("sympy", "a scene from SymPy")


class Formulas:
    """Named lists of expressions, evaluated together as a function of the values of their symbols."""

    def __init__(self, lists: Mapping[Any, Any], leaves: Sequence[Any]):
        """Prepare the `lists` (or matrices) of expressions in the symbols `leaves`. Raises ValueError for a
        function that JAX lacks.
        """
        sympy = sympy_package()
        self._lengths = {name: len(expressions) for name, expressions in lists.items()}
        flat = [sympy.sympify(e) for expressions in lists.values() for e in expressions]
        for expression in flat:
            check_functions(expression, set(leaves))
        self._steps, self._results = sympy.cse(flat, symbols=sympy.numbered_symbols("s", cls=sympy.Dummy))

    def values(self, leaves: Mapping[Any, Any], on: ModuleType = jnp) -> dict[Any, list]:
        """Return the values of all lists for these `leaves`, computed by `on`: `jax.numpy` or `numpy`."""
        known = dict(leaves)
        for symbol, expression in self._steps:
            known[symbol] = _value(expression, known, on)
        flat = iter([_value(expression, known, on) for expression in self._results])
        return {name: [next(flat) for _ in range(length)] for name, length in self._lengths.items()}

    def numbers(self, leaves: Mapping[Any, float]) -> dict[Any, np.ndarray]:
        """Return the values of all lists as NumPy arrays, in double precision."""
        with np.errstate(all="ignore"):
            found = self.values({symbol: np.float64(x) for symbol, x in leaves.items()}, np)
        return {name: np.array(values, np.float64) for name, values in found.items()}


def check_functions(expression, leaves) -> None:
    """Raise ValueError for a function in the expression that JAX lacks, and for a number that is not real.
    The symbols `leaves` are not examined.
    """
    if expression.is_Atom and expression.is_number and not expression.is_extended_real:
        raise ValueError(f"`{expression}` is not a real number; check the expressions that contain it")
    if expression in leaves or expression.is_Atom:
        return
    name = type(expression).__name__
    if name not in _KNOWN:
        raise ValueError(
            f"the function `{name}` in `{shortened(expression)}` has no counterpart in JAX; write it in "
            "elementary functions, or make it an input"
        )
    for argument in expression.args:
        check_functions(argument, leaves)


def _value(expression, known: dict, on: ModuleType):
    """Return the value of one expression."""
    if expression in known:
        return known[expression]
    name = type(expression).__name__
    if name in ("BooleanTrue", "BooleanFalse"):
        return name == "BooleanTrue"
    if expression.is_Atom:
        return float(expression)
    if name == "Pow":
        return _power(expression, known, on)
    values = [_value(argument, known, on) for argument in expression.args]
    if name in _OF_MANY:
        return reduce(getattr(on, _OF_MANY[name]), values)
    if name == "ExprCondPair":
        return tuple(values)
    if name == "Piecewise":
        return reduce(lambda otherwise, pair: on.where(pair[1], pair[0], otherwise), reversed(values), on.nan)
    if name == "sinc":
        return on.sinc(values[0] / on.pi)  # SymPy's is sin(x)/x
    if name == "erf":
        return jax.scipy.special.erf(values[0])
    return getattr(on, _FUNCTIONS[name])(*values)


def _power(expression, known: dict, on: ModuleType):
    base, exponent = expression.args
    if base.is_NumberSymbol and str(base) == "E":
        return on.exp(_value(exponent, known, on))
    value = _value(base, known, on)
    if exponent.is_Integer:
        return value ** int(exponent)
    if exponent.is_Rational and exponent.q == 2:
        return on.sqrt(value) ** int(exponent.p)
    return value ** _value(exponent, known, on)
