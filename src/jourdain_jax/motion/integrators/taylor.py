"""Taylor series as a solver: the order, by default chosen from the tolerance."""

import math

import equinox as eqx

from jourdain_jax.calculus.reals import Number, is_traced

LEAST, MOST = 4, 30


class Taylor(eqx.Module):
    """Taylor series of the motion, `simulate(..., solver=jj.Taylor())`: for small scenes and tight tolerances, and where many times are saved.

    y(t + s) = sum_{k=0}^p y_k s^k with coefficients from recurrences, by machine code of the CPU. The order is p = ceil(1 - log(rtol)/2) unless it is given,
    and a step is as long as its last two terms stay within the tolerance (Jorba and Zou). States at times to save come from the series: steps do not end
    there. Against Dopri8 at equal error, a Chaplygin sleigh takes half of the time alone at 1e-12, a scene of some hundred operations more time than it.

    **Arguments:** `order`, from 4 to 30; None: from the tolerance `rtol`.
    **Raises** from `simulate`: ValueError without machine code, for sampled inputs, and for equations that
    branch or are too long.
    Derivatives: forward mode by series too, and by Dopri8 where those of second derivatives were too long; reverse mode goes over the motion once more by it.
    Source: A. Jorba and M. Zou, Experimental Mathematics 14 (2005) 99.
    """

    order: int | None = eqx.field(static=True, default=None)

    def __check_init__(self) -> None:
        if self.order is not None and (not isinstance(self.order, int) or isinstance(self.order, bool) or not LEAST <= self.order <= MOST):
            raise ValueError(f"`order` is {self.order!r}, expected a whole number from {LEAST} to {MOST}, or None to choose it by the tolerance")


def order_for(rtol: Number) -> int:
    """p = ceil(1 - log(rtol)/2), at which the arithmetic for a length of time is least."""
    # the tolerance that the order is for where it is traced
    tolerance = 1e-12 if is_traced(rtol) else float(rtol)
    return min(max(math.ceil(1 - math.log(tolerance) / 2), LEAST), MOST)
