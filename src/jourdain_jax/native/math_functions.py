"""Functions of vectors of doubles by their names in the table of operations, `calculus/scalar_operations.py`."""

import math
from collections.abc import Callable
from functools import partial

from jourdain_jax.native import angles, exponentials
from jourdain_jax.native.ir import Value, Writer
from jourdain_jax.native.libm import by_libm


def _sign(w: Writer, x: Value) -> Value:
    return w.where(x > 0.0, 1.0, w.where(x < 0.0, -1.0, 0.0 * x))  # NaN stays; what compares as zero is zero


BY_POLYNOMIALS: dict[str, Callable[..., Value]] = {
    "tan": angles.tangent,
    "asin": angles.arcsine,
    "acos": angles.arccosine,
    "atan": angles.arctangent,
    "atan2": angles.arctangent_of_two,
    "exp": exponentials.exponential,
    "exp2": exponentials.exponential_of_base_two,
    "expm1": exponentials.exponential_less_one,
    "log": exponentials.logarithm,
    "log1p": exponentials.logarithm_of_more_than_one,
    "sinh": exponentials.hyperbolic_sine,
    "cosh": exponentials.hyperbolic_cosine,
    "tanh": exponentials.hyperbolic_tangent,
    "logistic": exponentials.logistic,
}


def _shared(name: str, w: Writer, *args: Value) -> Value:
    return w.shared(name, BY_POLYNOMIALS[name], *args)


def _power(w: Writer, x: Value, y: Value) -> Value:
    if y.name == w.number(0.5).name:
        return exponentials.half_power(w, x)
    if y.name == w.number(1.5).name:
        return exponentials.three_halves_power(w, x)
    return w.shared("pow", exponentials.real_power, x, y)


def _by_libm(name: str, w: Writer, *args: Value) -> Value:
    return by_libm(w, name, *args)


FUNCTIONS: dict[str, Callable[..., Value]] = {
    "add": lambda w, a, b: a + b,
    "sub": lambda w, a, b: a - b,
    "mul": lambda w, a, b: a * b,
    "div": lambda w, a, b: a / b,
    "neg": lambda w, a: -a,
    "sqrt": lambda w, a: w.intrinsic("sqrt", a),
    "abs": lambda w, a: w.magnitude(a),
    "max": lambda w, a, b: w.larger(a, b),
    "min": lambda w, a, b: w.smaller(a, b),
    "sign": _sign,
    "floor": lambda w, a: w.intrinsic("floor", a),
    "ceil": lambda w, a: w.intrinsic("ceil", a),
    "round": lambda w, a: w.intrinsic("roundeven", a),
    "rem": partial(_by_libm, "fmod"),
    "is_finite": lambda w, a: w.magnitude(a) < math.inf,
    **{name: lambda w, a, b, name=name: w.compared(name, a, b) for name in ("lt", "le", "gt", "ge", "eq", "ne")},
    **{name: partial(_shared, name) for name in BY_POLYNOMIALS},
    "pow": _power,
    **{name: partial(_by_libm, name) for name in ("asinh", "acosh", "atanh", "cbrt")},
}
