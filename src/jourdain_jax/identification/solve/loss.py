"""Losses of a fit: rho(r) grows like r^2 for small residuals r, and more slowly for outliers.

    minimise sum rho(r)
    weights     w = rho'(r) / r     least squares of sqrt(w) r and sqrt(w) J has the same gradient
    Huber       rho = r^2/2 for |r| <= k, else k |r| - k^2/2      w = min(1, k / |r|)
    Student-t   rho = (nu + 1)/2 log(1 + r^2/nu)                  w = (nu + 1) / (nu + r^2)
    covariance  K^2 (J'J)^-1 sum psi^2 / (n - p) / mean(psi')^2,   K = 1 + p var(psi') / (n mean(psi')^2)

psi = rho'; n residuals, p unknowns; J = dr/dtheta. J'J is the weighted J'WJ, divided by the mean weight.
Source: P. J. Huber and E. M. Ronchetti, Robust Statistics, 2nd ed. (2009), section 7.6; K. L. Lange, R. J. A.
Little and J. M. G. Taylor, JASA 84 (1989) 881.
"""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from jourdain_jax.calculus.reals import Number, checked_real

Residuals = Float[np.ndarray, "samples"]
Samples = Float[np.ndarray, "*samples"]


@dataclass(frozen=True)
class Loss:
    """A loss, `huber(k)` or `student_t(degrees)`. An infinite parameter means least squares."""

    kind: str
    parameter: float

    def value(self, r: Float[np.ndarray, "*batch samples"]) -> Float[np.ndarray, "*batch"]:
        """Return the sum of rho over the last axis."""
        k = self.parameter
        if math.isinf(k):
            return 0.5 * np.einsum("...i,...i->...", r, r)
        if self.kind == "student-t":
            return np.sum((k + 1) / 2 * np.log1p(r**2 / k), axis=-1)
        inside = np.minimum(abs(r), k)
        return np.sum(
            inside * (np.minimum(abs(r), np.finfo(float).max / max(k, 1.0)) - 0.5 * inside), axis=-1
        )

    def weight(self, r: Samples) -> Samples:
        """Return the weight w = rho'(r) / r."""
        k = self.parameter
        if self.kind == "student-t":
            return (k + 1) / (k + r**2)
        return np.minimum(1.0, k / np.maximum(abs(r), np.finfo(float).tiny))

    def weighted(self, rows: Float[np.ndarray, "*samples width"], r: Samples):
        """Return `rows`, each multiplied by the root of its weight."""
        return rows if math.isinf(self.parameter) else np.sqrt(self.weight(r))[..., None] * rows

    def inflation(self, r: Residuals, determined: float) -> float:
        """Return the factor of the covariance (J'WJ)^-1, after `determined` unknowns were fitted to `r`."""
        if not np.isfinite(bend := self.bend(r)):
            return bend
        psi, slope = self.weight(r) * r, self._slope(r)
        left, K = max(r.size - determined, 1.0), 1 + determined / r.size * np.var(slope) / np.mean(slope) ** 2
        return bend * K**2 * float(np.sum(psi**2) / left / np.mean(slope))

    def bend(self, r: Residuals) -> float:
        """Return the ratio of the inverse second derivative of F to (J'WJ)^-1; infinite if F is not convex in
        the residuals.
        """
        slope = float(np.mean(self._slope(r)))
        return float(np.mean(self.weight(r))) / slope if slope > 0 else math.inf

    def _slope(self, r: Residuals) -> Residuals:
        """Return psi', the second derivative of rho."""
        k = self.parameter
        if self.kind == "student-t":
            return (k + 1) * (k - r**2) / (k + r**2) ** 2
        return (np.abs(r) <= k).astype(float)


LEAST_SQUARES = Loss("least squares", np.inf)


def huber(k: Number = 1.345) -> Loss:
    """Return a loss that grows with the magnitude of residuals beyond `k` sigmas instead of their square:
    `jj.fit(..., loss=jj.identification.huber())`. The default has 95 % of the efficiency of least squares for
    normal noise.

    Raises ValueError unless k is positive and finite.
    """
    return Loss("huber", _positive(k, "k", "huber"))


def student_t(degrees: Number = 4.0) -> Loss:
    """Return the loss for noise distributed as Student's t, in which outliers have little weight. Fewer
    `degrees` of freedom mean heavier tails. Sigma is then the scale of the noise.

    Raises ValueError unless the degrees are positive and finite.
    """
    return Loss("student-t", _positive(degrees, "degrees", "student_t"))


def _positive(x: Number, name: str, function: str) -> float:
    checked_real(x, f"`{name}` of `{function}`", ())
    if not (np.isfinite(x) and x > 0):
        raise ValueError(
            f"{function}({x}): expected a positive finite number for `{name}`; omit it for the default"
        )
    return float(x)
