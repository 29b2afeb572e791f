"""Functions of vectors of doubles: polynomials where these are short, otherwise libm for each lane.

Sine and cosine have the numbers of `program/emit.py` (pi/2 in three parts, minimax polynomials), and here the angle that is left a second part, by which
it is short: errors are below 1 ulp while the multiple of pi/2 has 20 bits. Lanes beyond go through libm. Exponential and logarithm are those of FreeBSD's
libm, whose errors are below 1 ulp.
"""

import math
from collections.abc import Callable, Sequence
from functools import partial

from jourdain_jax.calculus.scalar_operations import COMPARISONS, TABLE
from jourdain_jax.native.ir import Value, Writer
from jourdain_jax.program.emit import COSINE, HALF_PI, SINE

WHOLE = 1.5 * 2.0**52  # a number to which this is added is rounded to a whole one, whose last bits are the last of the sum
LARGEST_ANGLE = 5e5  # rad; multiples of pi/2 below 2^20 times a part of 33 bits are exact
_EXP = (4.13813679705723846039e-08, -1.65339022054652515390e-06, 6.61375632143793436117e-05, -2.77777777770155933842e-03, 1.66666666666666019037e-01)
_LOG = (
    1.479819860511658591e-01,
    1.531383769920937332e-01,
    1.818357216161805012e-01,
    2.222219843214978396e-01,
    2.857142874366239149e-01,
    3.999999999940941908e-01,
    6.666666666666735130e-01,
)
_LN2 = (6.93147180369123816490e-01, 1.90821492927058770002e-10)  # the first has 32 bits
PREFIX = "jourdain_libm_"  # of libm's functions in a module


def polynomial(w: Writer, coefficients: Sequence[float], x: Value) -> Value:
    """A polynomial by Horner's rule, highest power first."""
    total = w.number(coefficients[0])
    for c in coefficients[1:]:
        total = w.fma(total, x, c)
    return total


def sine_and_cosine(w: Writer, x: Value) -> tuple[Value, Value]:
    """(sin x, cos x)"""
    s, c = _by_libm_where(w, ~(w.magnitude(x) <= LARGEST_ANGLE), x, _quick_waves(w, x), ("sin", "cos"))
    return s, c


def _quick_waves(w: Writer, x: Value) -> tuple[Value, Value]:
    shifted = w.fma(x, 2 / math.pi, WHOLE)
    turns, quadrant = shifted - WHOLE, w.converted("bitcast", shifted, w.whole)
    near = w.fma(-turns, HALF_PI[0], x)  # exact
    r = w.fma(-turns, HALF_PI[1], near)
    rest = w.fma(-turns, HALF_PI[2], w.fma(-turns, HALF_PI[1], near - r))  # by which r is short
    square = r * r
    half = 0.5 * square
    most = 1.0 - half
    sine = r + w.fma(r, square * polynomial(w, SINE, square), rest * most)
    cosine = most + (((1.0 - most) - half) + w.fma(square * square, polynomial(w, COSINE, square), -(sine * rest)))
    odd = (quadrant & 1).differs(0)
    s, c = w.where(odd, cosine, sine), w.where(odd, sine, cosine)
    return _turned(w, s, quadrant), _turned(w, c, quadrant + 1)


def _turned(w: Writer, x: Value, quadrant: Value) -> Value:
    """x, with the other sign in the third and fourth quadrant, which have the numbers 2 and 3."""
    sign = w.bitwise("shl", quadrant & 2, 62)
    return w.converted("bitcast", w.bitwise("xor", w.converted("bitcast", x, w.whole), sign), w.real)


def _by_libm_where(w: Writer, far: Value, x: Value, quick: Sequence[Value], names: Sequence[str]) -> list[Value]:
    """The quick values, but libm's in the lanes that are far."""
    found = [w.room(w.real) for _ in quick]
    for value, place in zip(quick, found, strict=True):
        w.store(value, place)
    with w.when(w.any(far)):
        for value, place, name in zip(quick, found, names, strict=True):
            w.store(w.where(far, by_libm(name, w, x), value), place)
    return [w.load(w.real, place) for place in found]


def by_libm(name: str, w: Writer, *args: Value) -> Value:
    """A function of libm, lane by lane."""
    result = w.number(math.nan)
    for lane in range(w.lanes):
        ones = [w.instruction("double", f"extractelement {a.type} {a.name}, i64 {lane}") for a in args]
        one = w.external(PREFIX + name, "double", *ones)
        result = w.instruction(result.type, f"insertelement {result.type} {result.name}, double {one.name}, i64 {lane}")
    return result


def exponential(w: Writer, x: Value) -> Value:
    """e^x"""
    near = w.smaller(w.larger(x, -800.0), 800.0)
    k = w.intrinsic("roundeven", near * (1 / math.log(2.0)))
    high = w.fma(-k, _LN2[0], near)
    low = k * _LN2[1]
    r = high - low
    square = r * r
    c = w.fma(-square, polynomial(w, _EXP, square), r)
    value = 1.0 - ((low - r * c / (2.0 - c)) - high)
    # 2^k in two factors, neither of which overflows
    whole = w.converted("fptosi", w.where(k.equals(k), k, 0.0), w.whole)
    half = w.bitwise("ashr", whole, 1)
    return value * _power_of_two(w, half) * _power_of_two(w, whole - half)


def _power_of_two(w: Writer, k: Value) -> Value:
    return w.converted("bitcast", w.bitwise("shl", k + 1023, 52), w.real)


def logarithm(w: Writer, x: Value) -> Value:
    """log x"""
    small = x < 2.0**-1022
    bits = w.converted("bitcast", w.where(small, x * 2.0**54, x), w.whole)
    # x = 2^k m with m from sqrt(1/2) to sqrt(2)
    shifted = bits - 0x3FE6A09E667F3BCD
    whole = w.bitwise("ashr", shifted, 52)
    m = w.converted("bitcast", bits - w.bitwise("shl", whole, 52), w.real)
    k = w.converted("sitofp", whole, w.real) - w.where(small, 54.0, w.number(0.0))
    f = m - 1.0
    s = f / (f + 2.0)
    square = s * s
    rest = square * polynomial(w, _LOG, square)
    half = 0.5 * f * f
    value = k * _LN2[0] - ((half - w.fma(s, half + rest, k * _LN2[1])) - f)
    value = w.where(x.equals(math.inf), math.inf, value)
    value = w.where(x.equals(0.0), -math.inf, value)
    return w.where(x >= 0.0, value, math.nan)


def power(w: Writer, x: Value, exponent: float) -> Value:
    """x^exponent for x > 0, to some 1e-14: for the control of steps."""
    return exponential(w, logarithm(w, x) * exponent)


def _sign(w: Writer, x: Value) -> Value:
    return w.where(x > 0.0, 1.0, w.where(x < 0.0, -1.0, 0.0 * x))  # NaN stays; what compares as zero is zero


_OF_VECTORS: dict[str, Callable[..., Value]] = {
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
    "exp": exponential,
    "log": logarithm,
    "logistic": lambda w, a: 1.0 / (1.0 + exponential(w, -a)),
    "is_finite": lambda w, a: w.magnitude(a) < math.inf,
    **{name: lambda w, a, b, name=name: w.compared(name, a, b) for name in COMPARISONS},
}
# All others are those of C's library, by the names that they have there; sine and cosine too, beyond `LARGEST_ANGLE`.
LIBM = {name: operation.c or name for name, operation in TABLE.items() if operation.is_number and name not in _OF_VECTORS and "{" not in operation.c}
FUNCTIONS = _OF_VECTORS | {name: partial(by_libm, in_c) for name, in_c in LIBM.items()}
