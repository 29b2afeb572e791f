"""Functions of the table in as many digits as one likes, and what the round-off of their arguments makes of
them.
"""

import operator
from collections.abc import Callable
from typing import NamedTuple

import mpmath

EPS = 2.0**-52
COMPARED = {name: getattr(operator, name) for name in ("lt", "le", "gt", "ge", "eq", "ne")}
TRUTHS = {"and": lambda a, b: a and b, "or": lambda a, b: a or b, "not": lambda a: not a}
STEPS = ("sign", "floor", "ceil", "round")
NUMBERS: dict[str, Callable] = {
    **{name: getattr(operator, name) for name in ("neg", "add", "sub", "mul", "pow")},
    "div": operator.truediv,
    "abs": abs,
    "exp2": lambda a: mpmath.power(2, a),
    "cbrt": lambda a: mpmath.sign(a) * mpmath.cbrt(abs(a)),
    "logistic": lambda a: 1 / (1 + mpmath.exp(-a)),
    "round": mpmath.nint,
    "rem": lambda a, b: a - b * (mpmath.floor(a / b) if a / b > 0 else mpmath.ceil(a / b)),
    "max": max,
    "min": min,
}


def in_mpmath(op):
    """A function of numbers, by its name in the table."""
    return NUMBERS.get(op) or getattr(mpmath, op)


class Known(NamedTuple):
    """A value, and by how much one that is worked out in doubles may differ from it."""

    value: mpmath.mpf
    error: mpmath.mpf


def found(op, arguments, round_off):
    """What an operation makes of numbers that are known so well, given its own round-off, relative; None
    where that is not settled.

    Nothing is settled by an argument that is not, near a jump or a bound of the domain, or where a number is
    no usual one.
    """
    if op == "select":
        condition, otherwise, value = arguments
        return None if condition is None else value if condition else otherwise
    if any(a is None for a in arguments):
        return None
    if op in TRUTHS:
        return TRUTHS[op](*arguments)
    if op == "is_finite":
        return True
    if op in COMPARED:
        a, b = arguments
        apart = abs(a.value - b.value) > a.error + b.error or a.error == b.error == 0
        return COMPARED[op](a.value, b.value) if apart else None
    function, values = in_mpmath(op), [a.value for a in arguments]
    try:
        value = function(*values)
        nearby = [
            function(*values[:i], a.value + way * a.error, *values[i + 1 :])
            for i, a in enumerate(arguments)
            for way in (-1, 1)
        ]
    except (ZeroDivisionError, OverflowError, ValueError):
        return None
    if any(isinstance(x, mpmath.mpc) or not mpmath.isfinite(x) for x in (value, *nearby)):
        return None
    error = 2 * sum(abs(x - value) for x in nearby) + round_off * abs(value)
    usual = value == 0 or 1e-150 < abs(value) < 1e150
    return (
        Known(value, error)
        if usual and error <= 1e-8 * abs(value) + (1e-12 if op not in STEPS else 0)
        else None
    )
