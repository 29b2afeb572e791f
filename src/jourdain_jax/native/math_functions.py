"""Functions of vectors of doubles by their names in the table of operations, `calculus/scalar_operations.py`."""

import math
from collections.abc import Callable
from functools import partial

from jourdain_jax.calculus.scalar_operations import COMPARISONS, TABLE
from jourdain_jax.native import angles, exponentials
from jourdain_jax.native.ir import Value, Writer
from jourdain_jax.native.libm import by_libm


def _sign(w: Writer, x: Value) -> Value:
    return w.where(x > 0.0, 1.0, w.where(x < 0.0, -1.0, 0.0 * x))  # NaN stays; what compares as zero is zero


_BY_INSTRUCTIONS: dict[str, Callable[..., Value]] = {
    "add": lambda w, a, b: a + b,
    "sub": lambda w, a, b: a - b,
    "mul": lambda w, a, b: a * b,
    "div": lambda w, a, b: a / b,
    "neg": lambda w, a: -a,
    "sqrt": lambda w, a: w.root(a),
    "abs": lambda w, a: w.magnitude(a),
    "max": lambda w, a, b: w.larger(a, b),
    "min": lambda w, a, b: w.smaller(a, b),
    "sign": _sign,
    "floor": lambda w, a: w.intrinsic("floor", a),
    "ceil": lambda w, a: w.intrinsic("ceil", a),
    "round": lambda w, a: w.intrinsic("roundeven", a),
    "is_finite": lambda w, a: w.magnitude(a) < math.inf,
    **{name: lambda w, a, b, name=name: w.compared(name, a, b) for name in COMPARISONS},
}
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
    "pow": exponentials.real_power,
    "sinh": exponentials.hyperbolic_sine,
    "cosh": exponentials.hyperbolic_cosine,
    "tanh": exponentials.hyperbolic_tangent,
    "logistic": exponentials.logistic,
}


def _shared(name: str, w: Writer, *args: Value) -> Value:
    return w.shared(name, BY_POLYNOMIALS[name], *args)


def _power(w: Writer, x: Value, y: Value) -> Value:
    for exponent, root in ((0.5, exponentials.half_power), (1.5, exponentials.three_halves_power)):
        if y.name == w.number(exponent).name:
            return root(w, x)
    return _shared("pow", w, x, y)


# Those of C's library, by the names that they have there; of sines, cosines, tangents and arcs beyond the range of the polynomials.
LIBM = {name: operation.c or name for name, operation in TABLE.items() if operation.is_number and name not in _BY_INSTRUCTIONS and "{" not in operation.c}
ONLY_IN_C = frozenset(LIBM) - frozenset(BY_POLYNOMIALS) - {"sin", "cos"}  # which a GPU has not
FUNCTIONS = {name: partial(by_libm, in_c) for name, in_c in LIBM.items()} | {name: partial(_shared, name) for name in BY_POLYNOMIALS}
FUNCTIONS |= {"pow": _power} | _BY_INSTRUCTIONS
