"""Combinations of unknowns that the data tell, but poorly ("sloppy" directions), in words.

C_rel = C_ij / (size_i size_j),      C_rel v = s^2 v:      the unknowns may change together along d theta_i/size_i = s v_i, s being one standard error

The size of an unknown is its magnitude; near zero, its typical change (`Range`). Source: R. N. Gutenkunst et al., PLoS Computational Biology 3 (2007) e189.
"""

import numpy as np
from jaxtyping import Float

WEAK = 0.1  # relative standard error from which a direction is named
CORRELATED = 0.98  # from which a pair is
_PART = 0.1  # of the largest entry of a direction: what is less is left out
_MOST = 400  # unknowns that are looked at


def weak_combinations(
    covariance: Float[np.ndarray, "unknowns unknowns"], values: Float[np.ndarray, "unknowns"], sizes: Float[np.ndarray, "unknowns"], labels: tuple[str, ...]
) -> tuple[str, ...]:
    """The directions with a relative standard error of `WEAK` or more, weakest first, one sentence each.

    They are those of the unknowns that runs share, where there are any.
    """
    some = np.flatnonzero(np.isfinite(np.diagonal(covariance)))[:_MOST]
    shared = [i for i in some if not labels[i].startswith("run ")]
    some = np.array(shared) if shared else some
    if not some.size:
        return ()
    is_relative = np.abs(values[some]) > 1e-3 * np.abs(sizes[some])
    scale = np.abs(sizes[some])
    squares, directions = np.linalg.eigh(covariance[np.ix_(some, some)] / (scale * scale[:, None]))
    found = []
    for k in range(some.size)[::-1]:
        spread = float(np.sqrt(max(squares[k], 0.0)))
        if spread < WEAK:
            break
        change = spread * directions[:, k] * scale / np.where(is_relative, np.abs(values[some]), 1.0)  # d theta / |theta|, or d theta
        parts = np.flatnonzero(np.abs(directions[:, k]) > _PART * np.max(np.abs(directions[:, k])))
        parts = parts[np.argsort(-np.abs(directions[parts, k]))]
        told = [_by(labels[some[i]], change[i] * np.sign(change[parts[0]]), bool(is_relative[i])) for i in parts]
        if len(told) == 1:
            found.append(f"{told[0]} is one standard error: the data tell it poorly")
        else:
            found.append(f"{', '.join(told[:-1])} and {told[-1]} together are one standard error: the data tell this combination poorly")
    return tuple(found)


def _by(name: str, change: float, is_relative: bool) -> str:
    if not is_relative:
        return f"a change of `{name}` by {change:.2g}"
    return f"a change of `{name}` by {100 * change:.2g} %" if abs(change) < 0.995 else f"a change of `{name}` by {change:.2g} times its value"
