"""Numbers u in (0, 1) for the samples of a study. Those of sample k follow from the seed and k alone, whatever else is computed and in whatever order.

random           words of the counter-based generator Philox 4x64 (Salmon et al. 2011), whose counter is k
latin-hypercube  one sample in each of N strata of each variable (McKay, Beckman and Conover 1979): u = (pi(k) + v) / N. The permutation pi is a Feistel
                 network of mixed words on the next power of four, walked until it is below N (Black and Rogaway 2002): nothing of size N is kept
sobol            Sobol's sequence with Owen's linear scrambling and a digital shift, from scipy.stats.qmc, half a cell from the edge
saltelli         for Sobol' indices of d variables: points (A_j, B_j) of that sequence in 2 d dimensions; samples j (d + 2) + i are A_j,
                 then A_j with the entry of one variable from B_j, one after another, then B_j (Saltelli et al. 2010)
"""

import warnings

import numpy as np

from jourdain_jax.calculus.on_first_use import module_on_first_use

qmc = module_on_first_use("scipy.stats.qmc")
MOST_SOBOL = 2**30  # points of the sequence, of 30 bits
_M1, _M2, _GOLDEN = (np.uint64(x) for x in (0xBF58476D1CE4E5B9, 0x94D049BB133111EB, 0x9E3779B97F4A7C15))


def _mixed(x: np.ndarray) -> np.ndarray:
    """Words whose bits each depend on all bits of x (splitmix64; Steele, Lea and Flood 2014)."""
    x = (x ^ (x >> np.uint64(30))) * _M1
    x = (x ^ (x >> np.uint64(27))) * _M2
    return x ^ (x >> np.uint64(31))


def _even(words: np.ndarray) -> np.ndarray:
    """Words of 64 bits as numbers in (0, 1): the middles of 2^53 cells."""
    return ((words >> np.uint64(11)).astype(float) + 0.5) * 2.0**-53


def random(seed: int, first: int, last: int, variables: int, samples: int) -> np.ndarray:
    """Samples first to last - 1, independent of each other, shape (last - first, variables)."""
    blocks = -(-variables // 4)  # one step of the counter gives four words
    generator = np.random.Philox(key=seed).advance(first * blocks)
    return _even(generator.random_raw((last - first) * 4 * blocks).reshape(-1, 4 * blocks)[:, :variables])


def permuted(seed: int, number: int, index: np.ndarray, count: int) -> np.ndarray:
    """Where the permutation `number` of 0 to count - 1 sends `index`."""
    half = np.uint64(max(1, (max(count - 1, 1).bit_length() + 1) // 2))
    mask = np.uint64((1 << int(half)) - 1)
    keys = _mixed(np.random.Philox(key=seed + (1 << 64)).advance(number * 2).random_raw(6) * _GOLDEN)
    found, walking = index.astype(np.uint64), np.ones(index.shape, bool)
    while walking.any():
        left, right = found[walking] >> half, found[walking] & mask
        for key in keys:
            left, right = right, left ^ (_mixed(right * _GOLDEN + key) & mask)
        found[walking] = (left << half) | right
        walking &= found >= count
    return found.astype(np.int64)


def latin_hypercube(seed: int, first: int, last: int, variables: int, samples: int) -> np.ndarray:
    """Samples first to last - 1 of a Latin hypercube of `samples` strata, shape (last - first, variables)."""
    inside = random(seed, first, last, variables, samples)
    strata = np.stack([permuted(seed, number, np.arange(first, last), samples) for number in range(variables)], axis=1)
    return (strata + inside) / samples


def sobol(seed: int, first: int, last: int, variables: int, samples: int) -> np.ndarray:
    """Points first to last - 1 of a scrambled Sobol sequence, shape (last - first, variables)."""
    engine = qmc.Sobol(variables, scramble=True, rng=np.random.default_rng(seed))
    with warnings.catch_warnings():  # pieces of a sequence need not be powers of two
        warnings.simplefilter("ignore", UserWarning)
        if first:
            engine.fast_forward(first)
        return engine.random(last - first) + 2.0**-31


def saltelli(seed: int, first: int, last: int, variables: int, samples: int) -> np.ndarray:
    """Samples first to last - 1 of Saltelli's design, shape (last - first, variables)."""
    group = variables + 2
    begin, end = first // group, -(-last // group)
    a, b = np.split(sobol(seed, begin, end, 2 * variables, samples), 2, axis=1)
    mixed = np.repeat(a[:, None], group, axis=1)
    for i in range(variables):
        mixed[:, 1 + i, i] = b[:, i]
    mixed[:, -1] = b
    return mixed.reshape(-1, variables)[first - begin * group : last - begin * group]


SAMPLERS = {"random": random, "latin-hypercube": latin_hypercube, "sobol": sobol, "saltelli": saltelli}
