"""What a fit tells of one unknown, and of the residuals of one channel."""

import equinox as eqx
import numpy as np
from jaxtyping import Float

from jourdain_jax.calculus.reals import described
from jourdain_jax.scene.printing import Printed


class Estimated(Printed, eqx.Module):
    """One unknown, in its unit; NaN for what the measurements cannot tell."""

    value: Float[np.ndarray, "*repeats"]
    standard_error: Float[np.ndarray, "*repeats"]
    low: Float[np.ndarray, "*repeats"]  # ends of the 95 % interval
    high: Float[np.ndarray, "*repeats"]
    unit: str = eqx.field(static=True)

    def _text(self) -> str:
        unit = f" {self.unit}" if self.unit else ""
        if self.value.ndim:
            return f"{described(self.value)}{unit}: its fields `value`, `standard_error`, `low`, `high` have that shape"
        if np.isnan(self.low + self.high):
            return f"{self.value:.6g}{unit}, which the measurements do not tell"
        error = f"standard error {self.standard_error:.2g}" if np.isfinite(self.standard_error) else "at its bound"
        return f"{self.value:.6g}{unit}, {error}, 95 % interval [{self.low:.6g}, {self.high:.6g}]"


class ChannelResiduals(Printed, eqx.Module):
    """Residuals of one channel of one run, in units of sigma. Good fits have mean near 0 and rms near 1."""

    run: int
    channel: str
    samples: int
    mean: float
    rms: float
    largest: float  # in magnitude

    def _text(self) -> str:
        of = f"{self.samples} samples, mean {self.mean:.2g}, rms {self.rms:.3g}, largest {self.largest:.3g}"
        return f"residuals of `{self.channel}` of run {self.run}, in sigmas: {of}"


def summary(run: int, name: str, r: np.ndarray) -> ChannelResiduals:
    """The summary of the residuals `r` of a channel, NaN where a sample is missing."""
    r = r[~np.isnan(r)]
    mean, rms, largest = (r.mean(), np.sqrt((r**2).mean()), np.abs(r).max()) if r.size else (np.nan,) * 3
    return ChannelResiduals(run, name, r.size, float(mean), float(rms), float(largest))
