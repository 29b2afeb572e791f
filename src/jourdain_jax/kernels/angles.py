"""Sine, cosine, tangent and their inverses for vectors of doubles, by polynomials and
double-double arithmetic.

Whole quarter turns are subtracted from an angle, with pi/2 in the three parts of `program/emit.py`; the
remainder has two parts. The reduction is exact while the multiple of pi/2 has 20 bits. Larger angles are
multiplied by the relevant bits of 2/pi (M. Payne and R. Hanek, ACM SIGNUM Newsletter 18 (1983) 19). Sine and
cosine use the minimax polynomials of `program/emit.py`. Arcs use Chebyshev polynomials P of 12 and 13 terms,
from mpmath's `chebyfit`, which a test reproduces:

    atan q = q + q^3 P(q^2) for |q| < tan(pi/8),   otherwise   atan(a/b) = pi/4 + atan((a - b)/(a + b))
    asin s = s + s^3 P(s^2) for |s| < 1/2,         otherwise   asin s = pi/2 - 2 asin sqrt((1 - s)/2)

Errors are below 0.9 ulp. In a double-double number, the low part holds the round-off of the head. Sources: T.
J. Dekker, Numerische Mathematik 18 (1971) 224; J.-M. Muller et al., Handbook of Floating-Point Arithmetic
(2018), chapter 4.
"""

import math
from collections.abc import Callable, Sequence

from jourdain_jax.kernels.ir import Value, Writer
from jourdain_jax.program.emit import COSINE, HALF_PI, SINE

DoubleDouble = tuple[Value, Value]  # head and low part

Triple = tuple[Value, Value, Value]


def polynomial(w: Writer, coefficients: Sequence[float], x: Value) -> Value:
    """Return a polynomial by Horner's rule; coefficients of the highest powers come first. Long polynomials
    evaluate even and odd powers separately.
    """
    if len(coefficients) > 7:
        square, odd = x * x, 1 - len(coefficients) % 2
        return w.fma(
            polynomial(w, coefficients[1 - odd :: 2], square), x, polynomial(w, coefficients[odd::2], square)
        )
    total = w.number(coefficients[0])
    for c in coefficients[1:]:
        total = w.fma(total, x, c)
    return total


def two_sum(a: Value | float, b: Value) -> DoubleDouble:
    """Return a + b exactly, if a is zero or |a| >= |b|."""
    head = a + b
    return head, (a - head) + b


def two_product(w: Writer, a: Value, b: Value) -> DoubleDouble:
    """Return a b exactly."""
    head = a * b
    return head, product_less(w, a, b, head)


def product_less(w: Writer, a: Value, b: Value, c: Value) -> Value:
    """Return a b - c without round-off, for c close to the product."""
    if w.fused:
        return w.fma(a, b, -c)
    (a_high, a_low), (b_high, b_low) = _halves(w, a), _halves(w, b)
    return (((a_high * b_high - c) + a_high * b_low) + a_low * b_high) + a_low * b_low


def _halves(w: Writer, a: Value) -> DoubleDouble:
    """Return two numbers of 26 and 27 bits whose sum is a."""
    high = w.converted("bitcast", w.converted("bitcast", a, w.whole) & -(2**27), w.real)
    return high, a - high


def quotient(w: Writer, a: DoubleDouble, b: DoubleDouble) -> DoubleDouble:
    """Return q and d, where q - d is the quotient of two double-double numbers. A zero keeps its sign."""
    inverse = 1.0 / b[0]
    q = a[0] * inverse
    return q, (product_less(w, q, b[0], a[0]) + (q * b[1] - a[1])) * inverse


WHOLE = 1.5 * 2.0**52  # numerics: adding this rounds to an integer, held in the last bits of the sum
# numerics, rad; products of a part of 33 bits and a multiple of pi/2 below 2^20 are exact
LARGEST_ANGLE = 5e5
_HALF_PI = (1.5707963267948966, 6.123233995736766e-17)  # numerics
_LESS_SINE = tuple(-c for c in SINE)
# numerics: the head has 50 bits, so 1/4, 1/2 and 3/4 of it are exact
_PI = (3.1415926535897896, 3.675178358715236e-15)
ATAN = (  # numerics
    0.016285756855221028,
    -0.034570561981427744,
    0.04551593220626549,
    -0.05230454270650244,
    0.05878928997834775,
    -0.06666424885738255,
    0.07692296375032143,
    -0.09090908753500877,
    0.11111111105155447,
    -0.14285714285659828,
    0.19999999999999804,
    -0.3333333333333333,
)
ASIN = (  # numerics
    0.028757851367421566,
    -0.014851887071247204,
    0.01740087944269402,
    0.005457506718640358,
    0.01032281435018578,
    0.011479177415184906,
    0.013971212973552933,
    0.017352392720869973,
    0.02237217294214989,
    0.030381944138531247,
    0.04464285714635543,
    0.07499999999998433,
    0.16666666666666669,
)


def sine_and_cosine(w: Writer, x: Value) -> DoubleDouble:
    """Return (sin x, cos x)."""
    s, c = _or_far(w, x, _sine_and_cosine(w, _reduced(w, x)), _FAR_SINE_AND_COSINE)
    return s, c


def tangent(w: Writer, x: Value) -> Value:
    """Return tan x."""
    return _or_far(w, x, [_tangent(w, _reduced(w, x))], _FAR_TANGENT)[0]


def _or_far(w: Writer, x: Value, quick: Sequence[Value], far_ones: dict[str, Callable]) -> list[Value]:
    """Return the `quick` values, or in lanes with large angles the results of `far_ones`: name -> function.
    Most calls skip these functions, so they are not inlined.
    """
    far, places = w.magnitude(x) > LARGEST_ANGLE, [w.room() for _ in quick]
    for value, place in zip(quick, places, strict=True):
        w.store(value, place)
    with w.when(w.any(far)):
        for value, place, (name, function) in zip(quick, places, far_ones.items(), strict=True):
            found = w.shared(name, lambda w, x, function=function: function(w, _reduced_far(w, x)), x)
            w.store(w.where(far, found, value), place)
    return [w.load(place) for place in places]


def _sine_and_cosine(w: Writer, angle: Triple) -> DoubleDouble:
    (r, less), (most, more), quadrant = _waves(w, *angle)
    sine, cosine, odd = r - less, most + more, (quadrant & 1).differs(0)
    across, along = w.where(odd, cosine, sine), w.where(odd, sine, cosine)
    return _turned(w, across, quadrant), _turned(w, along, quadrant + 1)


def _tangent(w: Writer, angle: Triple) -> Value:
    (r, less), (most, more), quadrant = _waves(w, *angle)
    sine, sine_rest = two_sum(r, -less)
    cosine, cosine_rest = two_sum(most, more - 0.5 * product_less(w, r, r, r * r))
    odd = (quadrant & 1).differs(0)
    across = w.where(odd, -cosine, sine), w.where(odd, -cosine_rest, sine_rest)
    head, over = quotient(w, across, (w.where(odd, sine, cosine), w.where(odd, sine_rest, cosine_rest)))
    return head - over


_FAR_SINE_AND_COSINE = {
    "far_sine": lambda w, angle: _sine_and_cosine(w, angle)[0],
    "far_cosine": lambda w, angle: _sine_and_cosine(w, angle)[1],
}
_FAR_TANGENT = {"far_tangent": _tangent}


def _reduced(w: Writer, x: Value) -> Triple:
    """Return the remainder of an angle after whole quarter turns, its low part, and the number of quarter
    turns.
    """
    shifted = w.fma(x, 2 / math.pi, WHOLE)
    turns, quadrant = shifted - WHOLE, w.converted("bitcast", shifted, w.whole)
    near = w.fma(-turns, HALF_PI[0], x)  # exact
    r = w.fma(-turns, HALF_PI[1], near)
    return r, w.fma(turns, HALF_PI[2], w.fma(turns, HALF_PI[1], r - near)), quadrant


def _waves(w: Writer, r: Value, over: Value, quadrant: Value) -> tuple[DoubleDouble, DoubleDouble, Value]:
    """Return (r, s), (m, c) and k for an angle of k quarter turns plus a remainder with sine r - s and cosine
    m + c. A zero sine keeps its sign.
    """
    square = r * r
    half = 0.5 * square
    most = 1.0 - half
    less = w.fma(r, square * polynomial(w, _LESS_SINE, square), over * most)
    more = ((1.0 - most) - half) + w.fma(square * square, polynomial(w, COSINE, square), (r - less) * over)
    return (r, less), (most, more), quadrant


def _reduced_far(w: Writer, x: Value) -> Triple:
    """Return the results of `_reduced` for large angles, and NaN for small ones.

    x = m 2^e with an integer m of 53 bits. Only 192 bits of 2/pi matter: the others contribute whole turns,
    or less than about 2^-126, when multiplied by m.
    """
    bits = (  # the first 1,216 bits of 2/pi, 64 per word
        0xA2F9836E4E441529,
        0xFC2757D1F534DDC0,
        0xDB6295993C439041,
        0xFE5163ABDEBBC561,
        0xB7246E3A424DD2E0,
        0x06492EEA09D1921C,
        0xFE1DEB1CB129A73E,
        0xE88235F52EBB4484,
        0xE99C7026B45F7E41,
        0x3991D639835339F4,
        0x9C845F8BBDF9283B,
        0x1FF897FFDE05980F,
        0xEF2F118B5A0A6D1F,
        0x6D367ECF27CB09B7,
        0x4F463F669E5FEA2D,
        0x7527BAC7EBE5F17B,
        0x3D0739F78A5292EA,
        0x6BFB5FB11F8D5D08,
        0x56033046FC7B6BAB,
    )
    w.constants("two_over_pi", (0, *(word - 2**64 * (word >> 63) for word in bits)), "i64")
    w.once("far_angle", "void", dict.fromkeys(("x", "r", "over", "quadrant"), "ptr"), _write_far_angle)
    given, r, over, quadrant = w.room(), w.room(), w.room(), w.room(type=w.whole)
    w.store(x, given)
    w.store(math.nan, r)
    w.store(0.0, over)
    w.store(w.literal(0, w.whole), quadrant)
    with w.each_lane() as lane:
        one = w.intrinsic("fabs", w.load(given, lane, "double"))
        with w.when((one > LARGEST_ANGLE) & (one < math.inf)):
            w.run("far_angle", *(w.at(place, lane, "double") for place in (given, r, over, quadrant)))
    return w.load(r), w.load(over), w.load(quadrant, type=w.whole)


def _write_far_angle(w: Writer, x: Value, r: Value, over: Value, quadrant: Value) -> None:
    # without this barrier LLVM keeps rates of earlier stages on the stack across sines, which is slower than
    # loading them: by 8 % for a step back of a disc, by 4 % for a step
    w.barrier()
    bits = w.load(x, type="i64")
    m = w.converted("zext", (bits & (2**52 - 1)) | 2**52, "i128")
    # index into the bits of 2/pi, after a word of zeros
    start = (w.binary("lshr", bits, 52) & 2047) - (1077 - 64)
    word, shift = w.binary("ashr", start, 6), start & 63

    def digits(k: int) -> Value:
        """Return 64 bits of 2/pi."""
        table = Value(w, "ptr", "@two_over_pi")
        both = w.binary("shl", w.converted("zext", w.load(table, word + k, "i64"), "i128"), 64) | w.converted(
            "zext", w.load(table, word + (k + 1), "i64"), "i128"
        )
        return w.binary("lshr", w.binary("shl", both, w.converted("zext", shift, "i128")), 64)

    # in units of 2^-126 quarter turns, without whole turns
    product = w.binary("shl", m * digits(0), 64) + m * digits(1) + w.binary("lshr", m * digits(2), 64)
    turns = w.binary("lshr", product + 2**125, 126)
    left = product - w.binary("shl", turns, 126)
    # three parts of 43 bits, each exact
    parts = []
    for low in (86, 43, 0):
        part = w.binary("ashr", left, low)
        parts.append(w.converted("sitofp", w.converted("trunc", part, "i64"), "double") * 2.0 ** (low - 126))
        left = left - w.binary("shl", part, low)
    head, rest = two_sum(parts[0], parts[1])
    head, more = two_sum(head, parts[2] + rest)
    angle = head * _HALF_PI[0]
    less = w.intrinsic("fma", head, _HALF_PI[0], -angle) + (head * _HALF_PI[1] + more * _HALF_PI[0])
    near = angle + less
    negative = bits < 0
    w.store(w.where(negative, -near, near), r)
    beyond = (near - angle) - less
    w.store(w.where(negative, -beyond, beyond), over)
    count = w.converted("trunc", turns, "i64")
    w.store(w.where(negative, w.literal(0, "i64") - count, count), quadrant)
    w.give()


def _turned(w: Writer, x: Value, quadrant: Value) -> Value:
    """Return x with the opposite sign in the third and fourth quadrants (numbers 2 and 3)."""
    sign = w.binary("shl", quadrant & 2, 62)
    return w.converted("bitcast", w.binary("xor", w.converted("bitcast", x, w.whole), sign), w.real)


def arctangent(w: Writer, x: Value) -> Value:
    """Return atan x."""
    a = w.magnitude(x)
    return w.intrinsic("copysign", _direction(w, w.where(a > 2.0**100, 2.0**100, a), w.number(1.0)), x)


def arctangent_of_two(w: Writer, y: Value, x: Value) -> Value:
    """Return atan2(y, x); tiny and huge numbers are scaled."""
    a, b = w.magnitude(y), w.magnitude(x)
    huge, place = ~(a + b < 2.0**60), w.room()
    w.store(_direction(w, a, x), place)
    far = huge | _tiny(a) | _tiny(b)
    with w.when(w.any(far)):
        endless, scale = a.equals(math.inf) | b.equals(math.inf), w.where(huge, 2.0**-600, w.number(2.0**600))
        near_a, near_b = (
            w.where(c.equals(math.inf), 1.0, w.where(endless, c - c, c * scale)) for c in (a, b)
        )
        found = _direction(w, near_a, w.intrinsic("copysign", near_b, x))
        flat = ~(w.converted("bitcast", x, w.whole) < 0) & (near_a < 2.0**-900) & (near_b > 2.0**-600)
        w.store(w.where(far, w.where(flat, a / b, found), w.load(place)), place)
    return w.intrinsic("copysign", w.load(place), y)


def _tiny(a: Value) -> Value:
    return (a < 2.0**-900) & (a > 0.0)


def _direction(w: Writer, across: Value, x: Value) -> Value:
    """Return the angle, 0 to pi, of a point with coordinates x and `across` >= 0."""
    along = w.magnitude(x)
    steep = across > along
    a, b = w.where(steep, along, across), w.where(steep, across, along)
    b = w.where(b.equals(0.0), 1.0, b)
    middle = a > math.tan(math.pi / 8) * b
    difference, total = a - b, a + b
    q, over = quotient(
        w,
        (w.where(middle, difference, a), w.where(middle, a - (difference + b), 0.0)),
        (w.where(middle, total, b), w.where(middle, a - (total - b), 0.0)),
    )
    square = q * q
    rest = w.fma(q * square, polynomial(w, ATAN, square), w.fma(over, square, -over))
    # the angle is n pi/4 plus or minus this arc
    back = w.converted("bitcast", x, w.whole) < 0
    n = w.where(middle, 1.0, 0.0)
    n = w.where(steep, 2.0 - n, n)
    n = w.where(back, 4.0 - n, n)
    way = w.where(w.binary("xor", steep, back), -1.0, w.number(1.0))
    return _arc(w, 0.25 * n, way, q, rest)


def _arc(w: Writer, halves: Value, way: Value, s: Value, rest: Value) -> Value:
    """Return `halves` pi + `way` (s + rest)."""
    head, less = two_sum(halves * _PI[0], way * s)
    return head + (less + w.fma(halves, _PI[1], way * rest))


def arcsine(w: Writer, x: Value) -> Value:
    """Return asin x."""
    large, s, rest = _of_half(w, x)
    return w.intrinsic(
        "copysign",
        _arc(w, w.where(large, 0.5, w.number(0.0)), w.where(large, -2.0, w.number(1.0)), s, rest),
        x,
    )


def arccosine(w: Writer, x: Value) -> Value:
    """Return acos x."""
    large, s, rest = _of_half(w, x)
    negative = x < 0.0
    halves = w.where(large, w.where(negative, 1.0, 0.0), 0.5)
    return _arc(
        w, halves, w.where(large, 2.0, w.number(-1.0)) * w.where(negative, -1.0, w.number(1.0)), s, rest
    )


def _of_half(w: Writer, x: Value) -> Triple:
    """Return whether |x| > 1/2, and an arc in two parts: asin sqrt((1 - |x|)/2) if it is,
    otherwise asin |x|.
    """
    a = w.magnitude(x)
    large = a > 0.5
    square = w.where(large, 0.5 - 0.5 * a, a * a)
    root = w.root(square)
    s = w.where(large, root, a)
    over = w.where(large & (root > 0.0), product_less(w, root, root, square) / (root + root), 0.0)
    return large, s, w.fma(s * square, polynomial(w, ASIN, square), -over)
