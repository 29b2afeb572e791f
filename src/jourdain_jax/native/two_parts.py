"""Numbers in two doubles, a head and a rest that is small beside it: what round-off takes from the head is in the rest.

Sources: T. J. Dekker, Numerische Mathematik 18 (1971) 224; J.-M. Muller et al., Handbook of Floating-Point Arithmetic (2018), chapter 4.
"""

from collections.abc import Sequence

from jourdain_jax.native.ir import Value, Writer


def polynomial(w: Writer, coefficients: Sequence[float], x: Value) -> Value:
    """A polynomial by Horner's rule, highest power first; of a long one, even and odd powers side by side."""
    if len(coefficients) > 7:
        square, odd = x * x, 1 - len(coefficients) % 2
        return w.fma(polynomial(w, coefficients[1 - odd :: 2], square), x, polynomial(w, coefficients[odd::2], square))
    total = w.number(coefficients[0])
    for c in coefficients[1:]:
        total = w.fma(total, x, c)
    return total


def two_sum(a: Value | float, b: Value) -> tuple[Value, Value]:
    """a + b, for an a that is zero or no smaller than b."""
    head = a + b
    return head, (a - head) + b


def two_product(w: Writer, a: Value, b: Value) -> tuple[Value, Value]:
    """a b"""
    head = a * b
    return head, product_less(w, a, b, head)


def product_less(w: Writer, a: Value, b: Value, c: Value) -> Value:
    """a b - c, for a c that is close to the product: without round-off."""
    if w.fused:
        return w.fma(a, b, -c)
    (a_high, a_low), (b_high, b_low) = _halves(w, a), _halves(w, b)
    return (((a_high * b_high - c) + a_high * b_low) + a_low * b_high) + a_low * b_low


def _halves(w: Writer, a: Value) -> tuple[Value, Value]:
    """Two numbers of 26 and 27 bits, whose sum is a."""
    high = w.converted("bitcast", w.converted("bitcast", a, w.whole) & -(2**27), w.real)
    return high, a - high


def quotient(w: Writer, a: tuple[Value, Value], b: tuple[Value, Value]) -> tuple[Value, Value]:
    """q and d of the quotient q - d of two numbers, each with its rest; of a zero it keeps the sign."""
    inverse = 1.0 / b[0]
    q = a[0] * inverse
    return q, (product_less(w, q, b[0], a[0]) + (q * b[1] - a[1])) * inverse
