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
"""

from functools import lru_cache

import jax
import jax.numpy as jnp
import numpy as np

from jourdain_jax.calculus.lazy_imports import module_on_first_use
from jourdain_jax.studies.rounded_functions import apart, library

qmc = module_on_first_use("scipy.stats.qmc")
MOST_SOBOL = 2**30  # points of the 30-bit sequence
_M1, _M2, _GOLDEN = (np.uint64(x) for x in (0xBF58476D1CE4E5B9, 0x94D049BB133111EB, 0x9E3779B97F4A7C15))
# factors of Philox, and increments of its key after each round
_F1, _F2 = np.uint64(0xD2E7470EE14C6C93), np.uint64(0xCA5A826395121157)
_STEPS = 0x9E3779B97F4A7C15, 0xBB67AE8584CAA73B


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
