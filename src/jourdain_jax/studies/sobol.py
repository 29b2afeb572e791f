"""Sobol' indices: the share of an output's variance due to each varying quantity.

With independent samples A_j, B_j, and AB_j^i equal to A_j except for quantity i, taken from B_j (Saltelli et
al. 2010):

    S_i  = mean_j f(B_j) (f(AB_j^i) - f(A_j)) / V    first order: reduction of V if i is fixed (table 2, b)
    ST_i = mean_j (f(A_j) - f(AB_j^i))^2 / (2 V)     total: remainder if all others are fixed (2, f; Jansen)

V is the variance over all A_j and B_j. The mean of f is subtracted first, which reduces the errors.
Half-widths of intervals are standard errors, from groups of samples drawn again with replacement (Efron's
bootstrap), times the normal quantile of the confidence.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from jourdain_jax.calculus.lazy_imports import module_on_first_use
from jourdain_jax.scene.printing import Printed

special = module_on_first_use("scipy.special")


@dataclass(frozen=True, repr=False)
class SobolIndices(Printed):
    """Sobol' indices of one output for the varying quantities, each as `value +- half-width` at the stated
    confidence.
    """

    names: tuple[str, ...]
    first: np.ndarray  # (quantities,)
    first_half_width: np.ndarray
    total: np.ndarray
    total_half_width: np.ndarray
    confidence: float
    groups: int  # number of groups of samples used
    left_out: int  # number of groups with a sample without a finite value

    def _text(self) -> str:
        width = max(map(len, self.names))
        note = f"; {self.left_out} groups with a missing value are omitted" if self.left_out else ""
        lines = [
            f"Sobol' indices from {self.groups} groups of samples, with limits of "
            f"{100 * self.confidence:g} %{note}"
        ]
        lines.append(f"  {'':<{width}} {'first order':>22} {'total':>22}")
        rows = zip(
            self.names, self.first, self.first_half_width, self.total, self.total_half_width, strict=True
        )
        lines += [
            f"  {name:<{width}} {f'{s:.4f} +- {ds:.4f}':>22} {f'{st:.4f} +- {dst:.4f}':>22}"
            for name, s, ds, st, dst in rows
        ]
        return "\n".join(lines)


def sobol_indices(values, names: Sequence[str], *, confidence: float = 0.95) -> SobolIndices:
    """Return Sobol' indices of a quantity from its `values` on a design with sampler "saltelli", whose
    variables are called `names`.

        vary = {"a": jj.studies.Uniform(-1.0, 1.0), "b": jj.studies.Uniform(0.0, 1.0)}
        design = jj.studies.Design(vary, sampler="saltelli", samples=4 * 1024)
        at = design.values()
        print(jj.studies.sobol_indices(at["a"] + at["b"] ** 2, design.names))

    `confidence`: of each interval. Groups with a value that is not finite are omitted and counted; if they
    are many or not random, the indices describe only the rest. Raises ValueError if the number of values is
    no multiple of variables + 2, or if nothing varies.
    """
    values, names = np.asarray(values, float), tuple(names)
    group = len(names) + 2
    if values.ndim != 1 or values.size % group or not values.size:
        raise ValueError(
            f"there are {values.size} values, expected a multiple of {group}; give the values of a design of "
            f"{len(names)} variables with sampler='saltelli'"
        )
    if not 0 < confidence < 1:
        raise ValueError(f"`confidence` is {confidence}, expected a number between 0 and 1")
    groups = values.reshape(-1, group)
    sound = np.isfinite(groups).all(axis=1)
    groups = groups[sound]
    if len(groups) < 2 or np.ptp(groups[:, [0, -1]]) == 0:  # the variance of these columns is the divisor
        raise ValueError(
            "fewer than two groups of samples have values, or all values are equal; Sobol' "
            "indices need a quantity that varies"
        )
    generator = np.random.default_rng(0)
    drawn = np.stack([_indices(groups[generator.integers(0, len(groups), len(groups))]) for _ in range(200)])
    half = special.ndtri(0.5 + confidence / 2) * drawn.std(axis=0, ddof=1)
    first, total = _indices(groups)
    return SobolIndices(names, first, half[0], total, half[1], confidence, len(groups), int(np.sum(~sound)))


def _indices(groups: np.ndarray) -> np.ndarray:
    """Return S and ST, shape (2, variables), from rows f(A), f(AB^1), ..., f(B)."""
    centred = groups - groups[:, [0, -1]].mean()
    a, mixed, b = centred[:, :1], centred[:, 1:-1], centred[:, -1:]
    variance = np.concatenate([a, b]).var()
    # S = mean f(B) (f(AB) - f(A)) / V;  ST = mean (f(A) - f(AB))^2 / (2 V)
    return np.stack([np.mean(b * (mixed - a), axis=0), np.mean((a - mixed) ** 2, axis=0) / 2]) / variance
