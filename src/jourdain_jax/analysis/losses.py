"""How much a residual counts: by its square, or less where it is far out.

minimise sum rho(r)       weights w = rho'(r) / r: a weighted least-squares problem with the same gradient, sqrt(w) r and sqrt(w) J
Huber        rho = r^2/2 for |r| <= k, k |r| - k^2/2 beyond          w = min(1, k / |r|)
Student-t    rho = (nu + 1)/2 log(1 + r^2/nu)                        w = (nu + 1) / (nu + r^2)

Covariance: K^2 (J'J)^-1 sum psi^2 / (n - p) / mean(psi')^2,   K = 1 + p var(psi') / (n mean(psi')^2)     psi = rho'; n residuals, p unknowns
J'J from the weighted J'WJ, divided by the mean weight.
Source: P. J. Huber and E. M. Ronchetti, Robust Statistics, 2nd ed. (2009), section 7.6; K. L. Lange, R. J. A. Little and J. M. G. Taylor, JASA 84 (1989) 881.
"""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from jourdain_jax.calculus.reals import Number, checked_real


@dataclass(frozen=True)
class Loss:
    """`huber(k)` or `student_t(degrees)`; with an infinite parameter, least squares."""

    kind: str
    parameter: float

    def value(self, r: Float[np.ndarray, "*batch samples"]) -> Float[np.ndarray, "*batch"]:
        """Sum of rho over the last axis."""
        k = self.parameter
        if math.isinf(k):
            return 0.5 * np.einsum("...i,...i->...", r, r)
        size = abs(r)
        if self.kind == "student-t":
            return np.sum((k + 1) / 2 * np.log1p(r**2 / k), axis=-1)
        return np.sum(np.where(size <= k, 0.5 * r**2, k * np.minimum(size, np.finfo(float).max / max(k, 1.0)) - 0.5 * k**2), axis=-1)

    def weight(self, r: Float[np.ndarray, "*samples"]) -> Float[np.ndarray, "*samples"]:
        """w(r)."""
        k = self.parameter
        if not np.isfinite(k):
            return np.ones_like(r)
        return (k + 1) / (k + r**2) if self.kind == "student-t" else np.minimum(1.0, k / np.maximum(abs(r), np.finfo(float).tiny))

    def weighted(self, rows: Float[np.ndarray, "*samples width"], r: Float[np.ndarray, "*samples"]):
        """Rows times the roots of their weights."""
        return rows if math.isinf(self.parameter) else np.sqrt(self.weight(r))[..., None] * rows

    def inflation(self, r: Float[np.ndarray, "samples"], determined: float) -> float:
        """The factor by which the covariance (J'WJ)^-1 is to be multiplied, from the residuals that count, which determined so many unknowns."""
        if not np.isfinite(bend := self.bend(r)):
            return bend
        psi, slope = self.weight(r) * r, self._slope(r)
        left, K = max(r.size - determined, 1.0), 1 + determined / r.size * np.var(slope) / np.mean(slope) ** 2
        return bend * K**2 * float(np.sum(psi**2) / left / np.mean(slope))

    def bend(self, r: Float[np.ndarray, "samples"]) -> float:
        """The factor by which (J'WJ)^-1 is to be multiplied to be the inverse of the second derivatives of F; infinite where F is not convex in residuals."""
        slope = float(np.mean(self._slope(r)))
        return float(np.mean(self.weight(r))) / slope if slope > 0 else math.inf

    def _slope(self, r: Float[np.ndarray, "samples"]) -> Float[np.ndarray, "samples"]:
        """psi'."""
        k = self.parameter
        return (k + 1) * (k - r**2) / (k + r**2) ** 2 if self.kind == "student-t" else (np.abs(r) <= k).astype(float)


LEAST_SQUARES = Loss("least squares", np.inf)


def huber(k: Number = 1.345) -> Loss:
    """Residuals beyond `k` sigmas count by their magnitude, not by their square: `jj.fit(..., loss=jj.huber())`. The default keeps 95 % of the efficiency.

    Raises ValueError unless k is positive and finite.
    """
    return Loss("huber", _positive(k, "k", "huber"))


def student_t(degrees: Number = 4.0) -> Loss:
    """Noise with the tails of Student's t: residuals far out hardly count. `degrees` of freedom: fewer for heavier tails; sigma is the scale of the noise.

    Raises ValueError unless the degrees are positive and finite.
    """
    return Loss("student-t", _positive(degrees, "degrees", "student_t"))


def _positive(x: Number, name: str, function: str) -> float:
    checked_real(x, f"`{name}` of `{function}`", ())
    if not (np.isfinite(x) and x > 0):
        raise ValueError(f"{function}({x}): expected a positive finite number for `{name}`; leave it out for the default")
    return float(x)
