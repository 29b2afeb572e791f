"""Exponentials, logarithms, powers and hyperbolic functions of vectors of doubles, named as in
`calculus/scalar_operations.py`.

    e^x        = 2^k (1 + p)                            k = round(x/ln 2),  p = r + r^2 P(r),  r = x - k ln 2
    log x      = k ln 2 + log m                         x = 2^k m,  sqrt(1/2) < m < sqrt(2)
    log m      = 2 s (1 + z/3 + z^2/5 + z^3 P(z))       s = (m - 1)/(m + 1),  z = s^2
    x^y        = e^(y log x)
    tanh x     = -d/(2 + d)                             d = e^(-2x) - 1
    sinh x     = (d + d/(1 + d))/2                      d = e^x - 1
    cosh x     = (e^x + e^-x)/2,                        logistic x = e^x/(1 + e^x)

Powers need p and log x to about 70 bits, so each is in two parts. The polynomials P have 11 and 7 terms of
mpmath's `chebyfit`, which a test reproduces. Errors are below 0.9 ulp.
"""

import math
import struct
from collections.abc import Callable
from functools import partial

from jourdain_jax.calculus.scalar_operations import COMPARISONS
from jourdain_jax.kernels import angles
from jourdain_jax.kernels.angles import WHOLE, polynomial, product_less, quotient, two_product, two_sum
from jourdain_jax.kernels.ir import Value, Writer

DoubleDouble = angles.DoubleDouble
_LN2 = (0.6931471803691238, 1.9082149292705877e-10)  # numerics: the first has 32 bits
_THIRD = (1 / 3, 1.850371707708594e-17)  # numerics
EXP = (  # numerics
    2.0914679376583935e-09,
    2.510520637395701e-08,
    2.7557273661348637e-07,
    2.7557255425746435e-06,
    2.4801587325533363e-05,
    0.00019841269874800493,
    0.0013888888888883752,
    0.008333333333326141,
    0.04166666666666667,
    0.1666666666666667,
    0.5,
)
LOG = (  # numerics
    0.057831251398003526,
    0.058609104507519154,
    0.0666710089052775,
    0.07692303196370495,
    0.09090909113029018,
    0.11111111111070357,
    0.142857142857143,
)


def _bits(x: float) -> int:
    return struct.unpack(">q", struct.pack(">d", x))[0]


def _power_of_two(w: Writer, k: Value) -> Value:
    return w.converted("bitcast", w.binary("shl", k + 1023, 52), w.real)


def _scaled(w: Writer, x: Value, k: Value) -> Value:
    """Return 2^k x by two factors that do not overflow."""
    half = w.binary("ashr", k, 1)
    return x * _power_of_two(w, half) * _power_of_two(w, k - half)


def _within(w: Writer, x: Value, low: float, high: float) -> Value:
    """Clip x to the bounds; NaN stays."""
    x = w.where(x < low, low, x)
    return w.where(x > high, high, x)


def _less_one(w: Writer, x: Value, more: Value | float = 0.0) -> tuple[Value, Value, Value]:
    """Return k and the two parts of p for `e^(x + more) = 2^k (1 + p)`. `more` is small relative to x,
    and |x| < 2000.
    """
    shifted = w.fma(x, 1 / math.log(2.0), WHOLE)
    turns, k = shifted - WHOLE, w.converted("bitcast", shifted, w.whole) - _bits(WHOLE)
    near = w.fma(-turns, _LN2[0], x)  # exact
    r, less = two_sum(near, more - turns * _LN2[1])
    square = r * r
    head, rest = two_sum(
        r, w.fma(square * r, polynomial(w, EXP[:-1], r), w.fma(square, EXP[-1], w.fma(less, r, less)))
    )
    return k, head, rest


def _exponential(w: Writer, x: Value, more: Value | float = 0.0) -> Value:
    """Return `e^(x + more)`."""
    k, p, rest = _less_one(w, x, more)
    head, less = two_sum(1.0, p)
    return _scaled(w, head + (less + rest), k)


def exponential(w: Writer, x: Value) -> Value:
    """Return `e^x`."""
    return _exponential(w, _within(w, x, -800.0, 800.0))


def _mantissa(w: Writer, x: Value) -> DoubleDouble:
    """Return k and m of `x = 2^k m` with m from sqrt(1/2) to sqrt(2), for positive finite x."""
    small = x < 2.0**-1022
    bits = w.converted("bitcast", w.where(small, x * 2.0**54, x), w.whole)
    biased = w.binary("lshr", bits + (_bits(1.0) - _bits(math.sqrt(0.5))), 52)  # k + 1023
    m = w.converted("bitcast", bits - w.binary("shl", biased, 52) + _bits(1.0), w.real)
    k = w.converted("bitcast", biased | _bits(2.0**52), w.real) - w.where(
        small, 2.0**52 + 1077, w.number(2.0**52 + 1023)
    )
    return k, m


def _logarithm(w: Writer, x: Value) -> DoubleDouble:
    """Return log x in two parts, for x >= 0 or NaN."""
    k, m = _mantissa(w, x)
    f, d = m - 1.0, 1.0 + m
    s, over = quotient(w, (f, w.number(0.0)), (d, (1.0 - d) + m))
    z, z_less = two_product(w, s, s)
    z_less = z_less - 2.0 * s * over
    # c = z (1/3 + z (1/5 + z P))
    a, a_less = two_sum(_THIRD[0], z * polynomial(w, (*LOG, 1 / 5), z))
    c, c_less = two_product(w, z, a)
    c_less = c_less + w.fma(z, a_less + _THIRD[1], z_less * a)
    # 2 s (1 + c) + k ln 2
    twice, twice_less = s + s, -(over + over)
    d, d_less = two_product(w, twice, c)
    d_less = d_less + w.fma(twice, c_less, twice_less * c)
    head, less = two_sum(twice, d)
    total, total_less = two_sum(k * _LN2[0], head)
    head, less = two_sum(total, w.fma(k, _LN2[1], total_less + (less + (twice_less + d_less))))
    head = w.where(x < math.inf, head, x)
    return w.where(x.equals(0.0), -math.inf, head), less


def logarithm(w: Writer, x: Value) -> Value:
    """Return log x."""
    k, m = _mantissa(w, x)
    f = m - 1.0
    s = f / (f + 2.0)
    square = s * s
    half = 0.5 * f * f
    # log m = 2 s (1 + z/3 + ..) = f - (f^2/2 - s (f^2/2 + 2 (z/3 + ..)))
    rest = (square + square) * polynomial(w, (*LOG, 1 / 5, 1 / 3), square)
    value = k * _LN2[0] - ((half - w.fma(s, half + rest, k * _LN2[1])) - f)
    value = w.where(x < math.inf, value, x)
    value = w.where(x.equals(0.0), -math.inf, value)
    return w.where(x >= 0.0, value, math.nan)


def _logarithm_of_more(w: Writer, x: Value, more: Value | float = 0.0, plus: Value | float = 0.0) -> Value:
    """Return log(1 + x + more) + plus, for `more` small relative to x and `plus` at most as large as the
    logarithm.
    """
    near = 1.0 + x
    head, less = _logarithm(w, near)
    found = head + ((less + (w.where(x < 1.0, (1.0 - near) + x, (x - near) + 1.0) + more) / near) + plus)
    found = w.where((near > 0.0) & (near < math.inf), found, head)
    return w.where(near >= 0.0, found, math.nan)


def logarithm_of_more_than_one(w: Writer, x: Value) -> Value:
    """Return log(1 + x)."""
    return w.where(w.magnitude(x) < 2.0**-54, x, _logarithm_of_more(w, x))


def _sum(w: Writer, a: Value, b: Value | float) -> DoubleDouble:
    """Return a + b exactly, for non-negative a and b in either order of size."""
    return two_sum(w.larger(a, w.literal(b, a.type)), w.smaller(a, w.literal(b, a.type)))


def _root(w: Writer, head: Value, less: Value) -> DoubleDouble:
    root = w.root(head)
    return root, w.where(root > 0.0, 0.5 * (less - product_less(w, root, root, head)) / root, 0.0)


def _logarithm_with(w: Writer, a: Value, x: Value, more: Value) -> Value:
    """Return log(1 + x + more), or log 2a if a is large."""
    large = a > 2.0**30
    return _logarithm_of_more(
        w, w.where(large, a - 1.0, x), w.where(large, 0.0, more), w.where(large, math.log(2.0), w.number(0.0))
    )


def hyperbolic_arcsine(w: Writer, x: Value) -> Value:
    """Return `asinh x = log(1 + a + a^2/(1 + sqrt(1 + a^2)))`, where `a = |x|`."""
    a = w.magnitude(x)
    square, less = two_product(w, a, a)
    total, rest = _sum(w, square, 1.0)
    q, over = quotient(w, (square, less), _plus(1.0, *_root(w, total, rest + less)))
    head, rest = two_sum(a, q)
    return w.where(a < 2.0**-28, x, w.intrinsic("copysign", _logarithm_with(w, a, head, rest - over), x))


def hyperbolic_arccosine(w: Writer, x: Value) -> Value:
    """Return `acosh x = log(1 + t + sqrt(t^2 + 2t))`, where `t = x - 1`."""
    t = x - 1.0
    square, less = two_product(w, t, t)
    total, rest = _sum(w, square, t + t)
    root, more = _root(w, total, rest + less)
    head, rest = two_sum(root, t)
    return w.where(x >= 1.0, _logarithm_with(w, x, head, rest + more), math.nan)


def hyperbolic_arctangent(w: Writer, x: Value) -> Value:
    """Return `atanh x = log(1 + 2a/(1 - a))/2`, where `a = |x|`."""
    a = w.magnitude(x)
    q, over = quotient(w, (a + a, w.number(0.0)), two_sum(1.0, -a))
    return w.where(a < 2.0**-28, x, w.intrinsic("copysign", 0.5 * _logarithm_of_more(w, q, -over), x))


def cube_root(w: Writer, x: Value) -> Value:
    """Return `x^(1/3)`."""
    return w.intrinsic("copysign", _raised(w, w.magnitude(x), w.number(_THIRD[0]), _THIRD[1]), x)


def remainder(w: Writer, x: Value, y: Value) -> Value:
    """Return the remainder of x for division by y rounded towards zero. It is exact: 50 bits of the quotient
    are subtracted at a time.
    """
    a, b = w.room(), w.magnitude(y)
    w.store(w.magnitude(x), a)
    right = (b > 0.0) & (w.load(a) < math.inf)
    with w.repeated() as leave:
        left = w.load(a)
        more = right & (left >= b)
        leave(~w.any(more))
        shift = w.larger(_mantissa(w, left)[0] - _mantissa(w, b)[0] - 50.0, w.number(0.0))
        part = _scaled(w, b, w.converted("fptosi", w.where(more, shift, 0.0), w.whole))
        rest = -product_less(w, w.intrinsic("floor", left / part), part, left)
        w.store(w.where(more, w.where(rest < 0.0, rest + part, rest), left), a)
    return w.where(right, w.intrinsic("copysign", w.load(a), x), math.nan)


def half_power(w: Writer, x: Value) -> Value:
    """Return `x^(1/2)`; unlike the square root, it is infinite for -inf and 0 for -0."""
    return w.where(x.equals(-math.inf), math.inf, w.root(x) + 0.0)


def three_halves_power(w: Writer, x: Value) -> Value:
    """Return `x^(3/2) = x sqrt(x)`, correctly rounded, for Hertz contact forces."""
    root = w.root(x)
    head = x * root
    # x (root - sqrt(x)) = x (root^2 - x)/(root + sqrt(x)) = root (root^2 - x)/2
    rest = product_less(w, x, root, head) - 0.5 * root * product_less(w, root, root, x)
    inside = (x < 2.0**650) & (x > 2.0**-600)  # otherwise the low part over- or underflows
    return w.where(inside, head + rest, w.where(x.equals(-math.inf), math.inf, head))


def _raised(w: Writer, a: Value, exponent: Value, more: float = 0.0) -> Value:
    """Return `a^(exponent + more)` for a >= 0."""
    log, less = _logarithm(w, a)
    head = exponent * log
    rest = w.fma(exponent, less, product_less(w, exponent, log, head)) + more * log
    return _exponential(w, _within(w, head, -800.0, 800.0), w.where(w.magnitude(head) < 800.0, rest, 0.0))


def real_power(w: Writer, x: Value, y: Value) -> Value:
    """Return `x^y`."""
    found = _raised(w, w.magnitude(x), _within(w, y, -(2.0**100), 2.0**100))
    whole, half = w.intrinsic("roundeven", y).equals(y), 0.5 * y
    odd = whole & w.intrinsic("roundeven", half).differs(half)
    found = w.where(odd, w.intrinsic("copysign", found, x), found)
    found = w.where((x < 0.0) & (x > -math.inf) & ~whole, math.nan, found)
    return w.where(x.equals(1.0) | y.equals(0.0), 1.0, found)


def exponential_of_base_two(w: Writer, x: Value) -> Value:
    """Return 2^x."""
    return real_power(w, w.number(2.0), x)


def power(w: Writer, x: Value, exponent: float) -> Value:
    """Return `x^exponent` for x > 0, to about 1e-14, for step-size control."""
    return exponential(w, logarithm(w, x) * exponent)


def _quarter_less_one(w: Writer, x: Value) -> DoubleDouble:
    """Return `(e^x - 1)/4`."""
    k, p, rest = _less_one(w, x)
    quarter = _power_of_two(w, k - 2)
    most, more = two_sum(quarter, w.number(-0.25))
    head, less = two_sum(most, quarter * p)
    return head, w.fma(quarter, rest, less + more)


def _plus(a: float, head: Value, rest: Value) -> DoubleDouble:
    """Return `a + (head + rest)`, if |a| >= |head| or the sum is far larger than a."""
    total, less = two_sum(a, head)
    return total, less + rest


def exponential_less_one(w: Writer, x: Value) -> Value:
    """Return `e^x - 1`."""
    head, less = _quarter_less_one(w, _within(w, x, -50.0, 710.0))
    return w.where(w.magnitude(x) < 2.0**-54, x, 4.0 * (head + less))


def hyperbolic_sine(w: Writer, x: Value) -> Value:
    """Return sinh x."""
    a = w.magnitude(x)
    head, less = _quarter_less_one(w, _within(w, a, 0.0, 710.5))
    q, over = quotient(w, (head, less), _plus(0.25, head, less))  # d/(1 + d)
    total, rest = two_sum(head, 0.25 * q)
    return w.where(
        a < 2.0**-28, x, w.intrinsic("copysign", 2.0 * (total + (rest + w.fma(over, -0.25, less))), x)
    )


def hyperbolic_cosine(w: Writer, x: Value) -> Value:
    """Return cosh x."""
    k, p, rest = _less_one(w, _within(w, w.magnitude(x), 0.0, 710.5))
    head, less = two_sum(1.0, p)
    quarter = _power_of_two(w, k - 2)
    return 2.0 * w.fma(quarter, head, w.fma(quarter, less + rest, 0.0625 / (quarter * head)))


def hyperbolic_tangent(w: Writer, x: Value) -> Value:
    """Return tanh x."""
    a = w.magnitude(x)
    k, p, rest = _less_one(w, _within(w, -2.0 * a, -44.0, 0.0))
    scale = _power_of_two(w, k)
    most, more = two_sum(-1.0, scale)
    d, less = two_sum(most, scale * p)
    less = w.fma(scale, rest, less + more)
    q, over = quotient(w, (-d, -less), _plus(2.0, d, less))
    return w.where(a < 2.0**-28, x, w.intrinsic("copysign", q - over, x))


def logistic(w: Writer, x: Value) -> Value:
    """Return `1/(1 + e^-x)`."""
    k, p, rest = _less_one(w, _within(w, -w.magnitude(x), -800.0, 0.0))
    head, less = two_sum(1.0, p)
    head, less = _scaled(w, head, k), _scaled(w, less + rest, k)
    negative = x < 0.0
    q, over = quotient(
        w, (w.where(negative, head, 1.0), w.where(negative, less, 0.0)), _plus(1.0, head, less)
    )
    return q - over


def _sign(w: Writer, x: Value) -> Value:
    return w.where(x > 0.0, 1.0, w.where(x < 0.0, -1.0, 0.0 * x))  # NaN stays; -0 counts as zero


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
    "exp": exponential,
    "exp2": exponential_of_base_two,
    "expm1": exponential_less_one,
    "log": logarithm,
    "log1p": logarithm_of_more_than_one,
    "pow": real_power,
    "sinh": hyperbolic_sine,
    "cosh": hyperbolic_cosine,
    "tanh": hyperbolic_tangent,
    "logistic": logistic,
    "asinh": hyperbolic_arcsine,
    "acosh": hyperbolic_arccosine,
    "atanh": hyperbolic_arctangent,
    "cbrt": cube_root,
    "rem": remainder,
}


def _shared(name: str, w: Writer, *args: Value) -> Value:
    return w.shared(name, BY_POLYNOMIALS[name], *args)


def _power(w: Writer, x: Value, y: Value) -> Value:
    for exponent, root in ((0.5, half_power), (1.5, three_halves_power)):
        if y.name == w.number(exponent).name:
            return root(w, x)
    return _shared("pow", w, x, y)


FUNCTIONS: dict[str, Callable[..., Value]] = (
    {name: partial(_shared, name) for name in BY_POLYNOMIALS} | {"pow": _power} | _BY_INSTRUCTIONS
)
