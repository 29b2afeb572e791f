"""Numbers u in (0, 1) for the samples of a study. The numbers of sample k depend only on the seed and k.

    random           words of the counter-based generator Philox 4x64 (Salmon et al. 2011), with counter k
    latin-hypercube  one sample in each of N strata of each variable (McKay, Beckman and Conover 1979):
                     u = (pi(k) + v) / N. The permutation pi is a Feistel network of mixed words on the next
                     power of four, repeated until its value is below N (Black and Rogaway 2002)
    sobol            Sobol's sequence with Owen's linear scrambling and a digital shift, from scipy.stats.qmc,
                     moved by half a cell off the edge
    saltelli         for Sobol' indices of d variables: points (A_j, B_j) of that sequence in 2 d dimensions;
                     samples j (d + 2) + i are A_j, then A_j with the entry of one variable from B_j, for
                     each variable, then B_j (Saltelli et al. 2010)

Each sampler is a function of an ordered array of integers k, in NumPy or in JAX on a device. Both give
identical bits, since they compute with words.

The functions of doubles have results with the same bits in NumPy on the host and in JAX on a device: both run
the same source, with every operation rounded separately.

Sums, quotients and roots are rounded identically everywhere. On some machines, however, compilers fuse a
product and a sum into one operation with one rounding; `product` prevents this. The normal distribution and
its inverse are from Cephes, as in SciPy. The exponential and the logarithm are from fdlibm, with errors of at
most one unit in the last place. The inverse uses one pair of polynomials in each tail (accurate to 3e-15 for
u > 1e-16, to 1e-13 for u > 1e-22).
"""

from functools import lru_cache

import jax
import jax.numpy as jnp
import numpy as np

from jourdain_jax.calculus.lazy_imports import module_on_first_use

# log 2 in two parts; the product of the first and an integer is exact
_LN2, _LN2_REST = 6.93147180369123816490e-01, 1.90821492927058770002e-10  # numerics
_LOG = (  # numerics
    1.479819860511658591e-01, 1.531383769920937332e-01, 1.818357216161805012e-01, 2.222219843214978396e-01,
    2.857142874366239149e-01,
    3.999999999940941908e-01, 6.666666666666735130e-01,
)  # fmt: skip
_EXP = (  # numerics
    4.13813679705723846039e-08, -1.65339022054652515390e-06, 6.61375632143793436117e-05,
    -2.77777777770155933842e-03, 1.66666666666666019037e-01,
)  # fmt: skip
_TAIL, _ROOT = 0.13533528323661269189, 2.50662827463100050242  # numerics: exp(-2), sqrt(2 pi)
_MIDDLE = (
    (-5.99633501014107895267e1, 9.80010754185999661536e1, -5.66762857469070293439e1,
     1.39312609387279679503e1, -1.23916583867381258016e0),
    (1.0, 1.95448858338141759834e0, 4.67627912898881538453e0, 8.63602421390890590575e1,
     -2.25462687854119370527e2, 2.00260212380060660359e2,
     -8.20372256168333339912e1, 1.59056225126211695515e1, -1.18331621121330003142e0),
)  # fmt: skip
_OUTER = (
    (4.05544892305962419923e0, 3.15251094599893866154e1, 5.71628192246421288162e1,
     4.40805073893200834700e1, 1.46849561928858024014e1,
     2.18663306850790267539e0, -1.40256079171354495875e-1, -3.50424626827848203418e-2,
     -8.57456785154685413611e-4),
    (1.0, 1.57799883256466749731e1, 4.53907635128879210584e1, 4.13172038254672030440e1,
     1.50425385692907503408e1, 2.50464946208309415979e0,
     -1.42182922854787788574e-1, -3.80806407691578277194e-2, -9.33259480895457427372e-4),
)  # fmt: skip

_ERROR = (
    (9.60497373987051638749e0, 9.00260197203842689217e1, 2.23200534594684319226e3, 7.00332514112805075473e3,
     5.55923013010394962768e4),
    (1.0, 3.35617141647503099647e1, 5.21357949780152679795e2, 4.59432382970980127987e3,
     2.26290000613890934246e4,
     4.92673942608635921086e4),
)  # fmt: skip
_FAR = (
    (2.46196981473530512524e-10, 5.64189564831068821977e-1, 7.46321056442269912687e0,
     4.86371970985681366614e1,
     1.96520832956077098242e2, 5.26445194995477358631e2, 9.34528527171957607540e2, 1.02755188689515710272e3,
     5.57535335369399327526e2),
    (1.0, 1.32281951154744992508e1, 8.67072140885989742329e1, 3.54937778887819891062e2,
     9.75708501743205489753e2,
     1.82390916687909736289e3, 2.24633760818710981792e3, 1.65666309194161350182e3, 5.57535340817727675546e2),
)  # fmt: skip
_FARTHER = (
    (5.64189583547755073984e-1, 1.27536670759978104416e0, 5.01905042251180477414e0, 6.16021097993053585195e0,
     7.40974269950448939160e0, 2.97886665372100240670e0),
    (1.0, 2.26052863220117276590e0, 9.39603524938001434673e0, 1.20489539808096656605e1,
     1.70814450747565897222e1,
     9.60896809063285878198e0, 3.36907645100081516050e0),
)  # fmt: skip


def library(x):
    """Return the library of the array `x`: NumPy or JAX's."""
    return jnp if isinstance(x, jax.Array) else np


def apart(x, u):
    """Return x unchanged, in a form that a compiler cannot fuse with other operations.

    `u`: a positive argument of the program. Its sign bit, unknown to the compiler, is combined with x.
    """
    if not isinstance(u, jax.Array):
        return x
    bits = jax.lax.bitcast_convert_type
    return bits(bits(jnp.asarray(x), jnp.uint64) ^ (bits(u, jnp.uint64) >> 63), u.dtype)


def product(a, b, u):
    """Return a b, rounded separately; `u` as in `apart`."""
    return apart(a * b, u)


def _polynomial(coefficients, x, u):
    found = coefficients[0]
    for coefficient in coefficients[1:]:
        found = product(found, x, u) + coefficient
    return found


def _logarithm(x, u):
    """Return log x, for finite x > 0; `u` as in `product`."""
    xp = library(x)
    m, k = xp.frexp(x)
    small = m < 0.5**0.5
    f, k = xp.where(small, 2.0 * m, m) - 1.0, (k - small).astype(float)
    s = f / (2.0 + f)
    z, half = s * s, product(0.5 * f, f, u)
    rest = product(s, half + product(z, _polynomial(_LOG, z, u), u), u) + product(k, _LN2_REST, u)
    return product(k, _LN2, u) - ((half - rest) - f)


def exponential(x, u):
    """Return `e^x`; complex x only on the host."""
    if np.iscomplexobj(x):
        return exponential(x.real, u) * np.exp(1j * x.imag)
    xp = library(x)
    x = xp.clip(x, -800.0, 800.0)
    k = xp.rint(x * (1.0 / float(np.log(2.0))))
    high, low = x - product(k, _LN2, u), product(k, _LN2_REST, u)
    r = high - low
    rr = r * r
    c = r - product(rr, _polynomial(_EXP, rr, u), u)
    return xp.ldexp(1.0 - ((low - r * c / (2.0 - c)) - high), k.astype(int))


def normal_probability(x, u):
    """Return the probability that a standard normal number is below x; `u` as in `apart`, with the shape of
    x.
    """
    xp = library(x)
    z = xp.abs(x) * 0.5**0.5
    near = xp.minimum(z, 1.0)
    zz = near * near
    top, bottom = (_polynomial(of, zz, u) for of in _ERROR)
    middle = 0.5 * near * top / bottom
    far, farther = ([_polynomial(of, z, u) for of in each] for each in (_FAR, _FARTHER))
    z = xp.where(z < 8.0, far[0] / far[1], farther[0] / farther[1]) * exponential(-(z * z), u)
    tail = xp.where(xp.abs(x) * 0.5**0.5 < 1.0, 0.5 - middle, 0.5 * z)
    return xp.where(x > 0.0, 1.0 - tail, tail)


def correlated(factor, u):
    """Return probabilities of correlated quantities from probabilities of independent ones, (samples,
    variables).

    Normal numbers with these probabilities are multiplied by the rows of `factor` in sequence, since a matrix
    product may round differently.
    """
    xp, z, rows = library(u), normal_quantile(u), []
    for row in range(u.shape[1]):
        total = product(factor[row, 0], z[:, 0], u[:, 0])
        for k in range(1, row + 1):
            total = total + product(factor[row, k], z[:, k], u[:, 0])
        rows.append(normal_probability(total, u[:, 0]))
    return xp.stack(rows, axis=1)


def _outer_quantile(y, u):
    """Return the quantile of 1 - y, for y <= exp(-2)."""
    x = library(y).sqrt(-2.0 * _logarithm(y, u))
    z = 1.0 / x
    top, bottom = (_polynomial(of, z, u) for of in _OUTER)
    return (x - _logarithm(x, u) / x) - z * top / bottom


def normal_quantile(u):
    """Return the value below which a standard normal number lies with probability u, 0 < u < 1. In a compiled
    program, u must be an argument.
    """
    xp = library(u)
    upper = u > 1.0 - _TAIL
    y = xp.where(upper, 1.0 - u, u)
    d = y - 0.5
    dd = d * d
    top, bottom = (_polynomial(of, dd, u) for of in _MIDDLE)
    middle, outer = (d + product(d, dd * top / bottom, u)) * _ROOT, y <= _TAIL
    tail = _outer_quantile(xp.minimum(y, _TAIL), u)
    return xp.where(outer, xp.where(upper, tail, -tail), middle)


qmc = module_on_first_use("scipy.stats.qmc")
MOST_SOBOL = 2**30  # numerics: points of the 30-bit sequence
_M1, _M2, _GOLDEN = (np.uint64(x) for x in (0xBF58476D1CE4E5B9, 0x94D049BB133111EB, 0x9E3779B97F4A7C15))
# factors of Philox, and increments of its key after each round
_F1, _F2 = np.uint64(0xD2E7470EE14C6C93), np.uint64(0xCA5A826395121157)
_STEPS = 0x9E3779B97F4A7C15, 0xBB67AE8584CAA73B  # numerics


def _mixed(x):
    """Return a hash of x in which each bit depends on all bits of x (splitmix64; Steele, Lea and
    Flood 2014).
    """
    x = (x ^ (x >> np.uint64(30))) * _M1
    x = (x ^ (x >> np.uint64(27))) * _M2
    return x ^ (x >> np.uint64(31))


def _philox(counter, key: int):
    """Return the four words of Philox 4x64-10 for each of the counters, whose upper words are 0."""
    zero = counter ^ counter
    a, b, c, d = counter, zero, zero, zero
    for turn in range(10):
        first, second = (np.uint64(((key >> 64 * i) + turn * step) % 2**64) for i, step in enumerate(_STEPS))
        a, b, c, d = jax.lax.mulhi(c, _F2) ^ b ^ first, c * _F2, jax.lax.mulhi(a, _F1) ^ d ^ second, a * _F1
    return a, b, c, d


def random(seed: int, index, variables: int, samples: int):
    """Return independent samples with these indices, shape (len(index), variables). They are midpoints of
    2^53 cells.
    """
    groups = -(-variables // 4)  # one counter gives four words
    if isinstance(index, jax.Array):
        words = [
            word
            for group in range(groups)
            for word in _philox((index * groups + (1 + group)).astype(np.uint64), seed)
        ]
        words = jnp.stack(words, axis=1)
    else:  # the same words from NumPy's generator, for indices in order
        first, last = int(index[:1].sum()), int(index[-1:].sum())
        words = np.random.Philox(key=seed).advance(first * groups).random_raw((last + 1 - first) * 4 * groups)
        words = words.reshape(-1, 4 * groups)[index - first]
    words = words[:, :variables]
    return ((words >> np.uint64(11)).astype(float) + 0.5) * 2.0**-53


def permuted(seed: int, number: int, index, count: int):
    """Return the image of `index` under the permutation `number` of 0 to count - 1."""
    half = np.uint64(max(1, (max(count - 1, 1).bit_length() + 1) // 2))
    mask = np.uint64((1 << int(half)) - 1)
    keys = _mixed(np.random.Philox(key=seed + (1 << 64)).advance(number * 2).random_raw(6) * _GOLDEN)

    def walked(place):
        left, right = place >> half, place & mask
        for key in keys:
            left, right = right, left ^ (_mixed(right * _GOLDEN + key) & mask)
        return (left << half) | right

    found, end = walked(index.astype(np.uint64)), np.uint64(count)
    if isinstance(index, jax.Array):
        found = jax.lax.while_loop(
            lambda x: jnp.any(x >= end), lambda x: jnp.where(x >= end, walked(x), x), found
        )
    else:
        while (outside := found >= end).any():
            found[outside] = walked(found[outside])
    return found.astype(np.int64)


def latin_hypercube(seed: int, index, variables: int, samples: int):
    """Return the samples with these indices of a Latin hypercube with `samples` strata, shape (len(index),
    variables).
    """
    strata = library(index).stack(
        [permuted(seed, number, index, samples) for number in range(variables)], axis=1
    )
    share = random(seed, index, variables, samples)
    # `apart` keeps a compiler from replacing the division by a constant
    return (strata + share) / apart(float(samples), share)


@lru_cache(maxsize=16)
def _directions(seed: int, variables: int, bits: int) -> np.ndarray:
    """Return the words of a scrambled Sobol sequence: the word of its first point, and the word that each bit
    of the Gray code of k adds.
    """
    engine = qmc.Sobol(variables, scramble=True, rng=np.random.default_rng(seed))
    points = []
    for bit in range(bits + 1):  # the Gray code of 2^b - 1 is 2^(b - 1)
        if bit > 1:
            engine.fast_forward(2 ** (bit - 1) - 1)
        points.append(engine.random(1)[0])
    words = (np.array(points) * 2**30).astype(int)
    words[1:] ^= words[0]
    return words


def sobol(seed: int, index, variables: int, samples: int):
    """Return the points with these indices of a scrambled Sobol sequence, shape (len(index), variables)."""
    first, *added = _directions(seed, variables, max(1, (samples - 1).bit_length()))
    gray, words = (index ^ (index >> 1))[:, None], first
    for bit, word in enumerate(added):
        words = words ^ ((gray >> bit) & 1) * word
    return words.astype(float) * 2.0**-30 + 2.0**-31


def saltelli(seed: int, index, variables: int, samples: int):
    """Return the samples with these indices of Saltelli's design, shape (len(index), variables)."""
    xp, group = library(index), variables + 2
    points, place = sobol(seed, index // group, 2 * variables, -(-samples // group)), (index % group)[:, None]
    return xp.where(
        (place == xp.arange(1, variables + 1)) | (place == group - 1),
        points[:, variables:],
        points[:, :variables],
    )


SAMPLERS = {"random": random, "latin-hypercube": latin_hypercube, "sobol": sobol, "saltelli": saltelli}
