"""Sine, cosine and tangent of vectors of doubles, and their inverses, by polynomials.

Angles lose whole quarter turns: pi/2 has the three parts of `program/emit.py`, and the angle that is left a second part, by which it is over. That serves
while the multiple of pi/2 has 20 bits; lanes beyond go through libm. Sine and cosine have the minimax polynomials of `program/emit.py`, arcs those of Chebyshev
(mpmath's `chebyfit` of 12 and 13 terms; a test finds them again):

    atan q = q + q^3 P(q^2) for |q| < tan(pi/8),   otherwise   atan(a/b) = pi/4 + atan((a - b)/(a + b))
    asin s = s + s^3 P(s^2) for |s| < 1/2,         otherwise   asin s = pi/2 - 2 asin sqrt((1 - s)/2)

Errors are below 0.9 ulp.
"""

import math

from jourdain_jax.native.ir import Value, Writer
from jourdain_jax.native.libm import by_libm_where
from jourdain_jax.native.two_parts import polynomial, product_less, quotient, two_sum
from jourdain_jax.program.emit import COSINE, HALF_PI, SINE

WHOLE = 1.5 * 2.0**52  # a number to which this is added is rounded to a whole one, whose last bits are the last of the sum
LARGEST_ANGLE = 5e5  # rad; multiples of pi/2 below 2^20 times a part of 33 bits are exact
_LESS_SINE = tuple(-c for c in SINE)
_PI = (3.1415926535897896, 3.675178358715236e-15)  # the first has 50 bits: 1/4, 1/2 and 3/4 of it are exact
ATAN = (
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
ASIN = (
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


def sine_and_cosine(w: Writer, x: Value) -> tuple[Value, Value]:
    """(sin x, cos x)"""
    (r, less), (most, more), quadrant = _waves(w, x)
    sine, cosine, odd = r - less, most + more, (quadrant & 1).differs(0)
    quick = _turned(w, w.where(odd, cosine, sine), quadrant), _turned(w, w.where(odd, sine, cosine), quadrant + 1)
    s, c = by_libm_where(w, ~(w.magnitude(x) <= LARGEST_ANGLE), [x], quick, ("sin", "cos"))
    return s, c


def tangent(w: Writer, x: Value) -> Value:
    """tan x"""
    (r, less), (most, more), quadrant = _waves(w, x)
    sine, sine_rest = two_sum(r, -less)
    cosine, cosine_rest = two_sum(most, more - 0.5 * product_less(w, r, r, r * r))
    odd = (quadrant & 1).differs(0)
    across = w.where(odd, -cosine, sine), w.where(odd, -cosine_rest, sine_rest)
    head, over = quotient(w, across, (w.where(odd, sine, cosine), w.where(odd, sine_rest, cosine_rest)))
    return by_libm_where(w, ~(w.magnitude(x) <= LARGEST_ANGLE), [x], [head - over], ["tan"])[0]


def _waves(w: Writer, x: Value) -> tuple[tuple[Value, Value], tuple[Value, Value], Value]:
    """(r, s), (m, c) and k: the angle that k quarter turns leave has the sine r - s, in which zeros keep their signs, and the cosine m + c."""
    shifted = w.fma(x, 2 / math.pi, WHOLE)
    turns, quadrant = shifted - WHOLE, w.converted("bitcast", shifted, w.whole)
    near = w.fma(-turns, HALF_PI[0], x)  # exact
    r = w.fma(-turns, HALF_PI[1], near)
    over = w.fma(turns, HALF_PI[2], w.fma(turns, HALF_PI[1], r - near))
    square = r * r
    half = 0.5 * square
    most = 1.0 - half
    less = w.fma(r, square * polynomial(w, _LESS_SINE, square), over * most)
    more = ((1.0 - most) - half) + w.fma(square * square, polynomial(w, COSINE, square), (r - less) * over)
    return (r, less), (most, more), quadrant


def _turned(w: Writer, x: Value, quadrant: Value) -> Value:
    """x, with the other sign in the third and fourth quadrant, which have the numbers 2 and 3."""
    sign = w.bitwise("shl", quadrant & 2, 62)
    return w.converted("bitcast", w.bitwise("xor", w.converted("bitcast", x, w.whole), sign), w.real)


def arctangent(w: Writer, x: Value) -> Value:
    """atan x"""
    a = w.magnitude(x)
    return w.intrinsic("copysign", _direction(w, w.where(a > 2.0**100, 2.0**100, a), w.number(1.0)), x)


def arctangent_of_two(w: Writer, y: Value, x: Value) -> Value:
    """atan2(y, x); lanes with a tiny or a huge number go through libm."""
    a, b = w.magnitude(y), w.magnitude(x)
    far = ~(a + b < 2.0**60) | _tiny(a) | _tiny(b)
    return by_libm_where(w, far, [y, x], [w.intrinsic("copysign", _direction(w, a, x), y)], ["atan2"])[0]


def _tiny(a: Value) -> Value:
    return (a < 2.0**-900) & (a > 0.0)


def _direction(w: Writer, across: Value, x: Value) -> Value:
    """The angle from 0 to pi of a point with the coordinates x, `across`; the second is not negative."""
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
    # the angle is n pi/4 and this arc, or less it
    back = w.converted("bitcast", x, w.whole) < 0
    n = w.where(middle, 1.0, w.number(0.0))
    n = w.where(steep, 2.0 - n, n)
    n = w.where(back, 4.0 - n, n)
    way = w.where(w.bitwise("xor", steep, back), -1.0, w.number(1.0))
    return _arc(w, 0.25 * n, way, q, rest)


def _arc(w: Writer, halves: Value, way: Value, s: Value, rest: Value) -> Value:
    """`halves` pi + `way` (s + rest)"""
    head, less = two_sum(halves * _PI[0], way * s)
    return head + (less + w.fma(halves, _PI[1], way * rest))


def arcsine(w: Writer, x: Value) -> Value:
    """asin x"""
    large, s, rest = _of_half(w, x)
    return w.intrinsic("copysign", _arc(w, w.where(large, 0.5, w.number(0.0)), w.where(large, -2.0, w.number(1.0)), s, rest), x)


def arccosine(w: Writer, x: Value) -> Value:
    """acos x"""
    large, s, rest = _of_half(w, x)
    negative = x < 0.0
    halves = w.where(large, w.where(negative, 1.0, w.number(0.0)), 0.5)
    return _arc(w, halves, w.where(large, 2.0, w.number(-1.0)) * w.where(negative, -1.0, w.number(1.0)), s, rest)


def _of_half(w: Writer, x: Value) -> tuple[Value, Value, Value]:
    """Whether |x| is above 1/2, and the arc whose sine is |x|, or there sqrt((1 - |x|)/2), in two parts."""
    a = w.magnitude(x)
    large = a > 0.5
    square = w.where(large, 0.5 - 0.5 * a, a * a)
    root = w.intrinsic("sqrt", square)
    s = w.where(large, root, a)
    over = w.where(large & (root > 0.0), product_less(w, root, root, square) / (root + root), 0.0)
    return large, s, w.fma(s * square, polynomial(w, ASIN, square), -over)
