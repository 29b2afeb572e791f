"""Functions of doubles that have the same bits in NumPy on the host and by JAX on a device: one text, each operation of which is rounded by itself.

Sums, quotients and roots are rounded alike everywhere. Of a product that is added to something a compiler makes one operation with one rounding, on some
machines: `product` keeps it apart. The inverse of the normal distribution is that of Cephes, as in SciPy, with the logarithm of fdlibm (errors below one unit
in the last place) and one pair of polynomials for all of a tail (right to 3e-15 for u > 1e-16, to 1e-13 for u > 1e-22).
"""

import jax
import jax.numpy as jnp
import numpy as np

_LN2, _LN2_REST = 6.93147180369123816490e-01, 1.90821492927058770002e-10  # in two parts; a whole number times the first is exact
_LOG = (
    1.479819860511658591e-01, 1.531383769920937332e-01, 1.818357216161805012e-01, 2.222219843214978396e-01, 2.857142874366239149e-01,
    3.999999999940941908e-01, 6.666666666666735130e-01,
)  # fmt: skip
_TAIL, _ROOT = 0.13533528323661269189, 2.50662827463100050242  # exp(-2), sqrt(2 pi)
_MIDDLE = (
    (-5.99633501014107895267e1, 9.80010754185999661536e1, -5.66762857469070293439e1, 1.39312609387279679503e1, -1.23916583867381258016e0),
    (1.0, 1.95448858338141759834e0, 4.67627912898881538453e0, 8.63602421390890590575e1, -2.25462687854119370527e2, 2.00260212380060660359e2,
     -8.20372256168333339912e1, 1.59056225126211695515e1, -1.18331621121330003142e0),
)  # fmt: skip
_OUTER = (
    (4.05544892305962419923e0, 3.15251094599893866154e1, 5.71628192246421288162e1, 4.40805073893200834700e1, 1.46849561928858024014e1,
     2.18663306850790267539e0, -1.40256079171354495875e-1, -3.50424626827848203418e-2, -8.57456785154685413611e-4),
    (1.0, 1.57799883256466749731e1, 4.53907635128879210584e1, 4.13172038254672030440e1, 1.50425385692907503408e1, 2.50464946208309415979e0,
     -1.42182922854787788574e-1, -3.80806407691578277194e-2, -9.33259480895457427372e-4),
)  # fmt: skip


def library(x):
    """The library of the array `x`: NumPy, or JAX's."""
    return jnp if isinstance(x, jax.Array) else np


def product(a, b, u):
    """a b, rounded by itself. `u`: an argument of the program, above zero, of which a compiler does not know that: its sign, 0, goes into that of a b."""
    found = a * b
    if not isinstance(found, jax.Array):
        return found
    bits = jax.lax.bitcast_convert_type
    return bits(bits(found, jnp.uint64) ^ (bits(u, jnp.uint64) >> 63), found.dtype)


def _polynomial(coefficients, x, u):
    found = coefficients[0]
    for coefficient in coefficients[1:]:
        found = product(found, x, u) + coefficient
    return found


def _logarithm(x, u):
    """log x, for finite x > 0; `u` as in `product`."""
    xp = library(x)
    m, k = xp.frexp(x)
    small = m < 0.5**0.5
    f, k = xp.where(small, 2.0 * m, m) - 1.0, (k - small).astype(float)
    s = f / (2.0 + f)
    z, half = s * s, product(0.5 * f, f, u)
    rest = product(s, half + product(z, _polynomial(_LOG, z, u), u), u) + product(k, _LN2_REST, u)
    return product(k, _LN2, u) - ((half - rest) - f)


def _outer_quantile(y, u):
    """The quantile of 1 - y, for y <= exp(-2)."""
    x = library(y).sqrt(-2.0 * _logarithm(y, u))
    z = 1.0 / x
    top, bottom = (_polynomial(of, z, u) for of in _OUTER)
    return (x - _logarithm(x, u) / x) - z * top / bottom


def normal_quantile(u):
    """The number below which a standard normal one lies with the probability u, 0 < u < 1; u an argument of the program."""
    xp = library(u)
    upper = u > 1.0 - _TAIL
    y = xp.where(upper, 1.0 - u, u)
    d = y - 0.5
    dd = d * d
    top, bottom = (_polynomial(of, dd, u) for of in _MIDDLE)
    middle, outer = (d + product(d, dd * top / bottom, u)) * _ROOT, y <= _TAIL
    if isinstance(u, jax.Array):
        tail = _outer_quantile(jnp.minimum(y, _TAIL), u)
    else:  # the few that lie there alone
        tail = np.zeros_like(u)
        tail[outer] = _outer_quantile(y[outer], y[outer])
    return xp.where(outer, xp.where(upper, tail, -tail), middle)
