"""M, C1, K0 and K2 of a bicycle from its nonlinear model, by linearisation about upright straight running.

    M q'' + v C1 q' + (g K0 + v^2 K2) q = f,   q = (lean, steer)

The nonlinear model is linearised at rest and at one speed; that C grows with v and K with v^2 is a fact of the model, checked in the tests.
Source of the form: J. P. Meijaard, J. M. Papadopoulos, A. Ruina and A. L. Schwab, Proc. R. Soc. A 463 (2007) 1955.
"""

from collections.abc import Mapping

import jax
import jax.numpy as jnp

from jourdain_jax.analysis.linearize import linearize
from jourdain_jax.bicycle.stability import BicycleMatrices
from jourdain_jax.calculus.reals import Scalar, compiled_quickly
from jourdain_jax.models.whipple_bicycle import WhippleBicycle
from jourdain_jax.motion.put_on_rows import State, state_of

_SPEED = 4.0  # m/s, of the second linearisation
_DEPENDENT = ("pitch",)


def upright_running(bicycle: WhippleBicycle, speed, lean_rate=0.0) -> State:
    """Return upright straight running at `speed` (m/s), a steady motion, or with a kick in `lean_rate`
    (rad/s). Both satisfy the constraints exactly.
    """
    q, u, _ = bicycle.named(**bicycle.upright(speed), lean_rate=lean_rate)
    return state_of(bicycle, 0.0, q, u)


def linear_matrices(values: Mapping[str, float | Scalar]) -> BicycleMatrices:
    """Return M, C1, K0, K2 (2x2, in lean and steer) and g from the 26 parameters by name. It works under jit
    and vmap.
    """
    return _matrices({name: jnp.asarray(value) for name, value in values.items()})


def _linearised(values: dict[str, Scalar]) -> BicycleMatrices:
    bicycle = WhippleBicycle.from_values(values)

    def at(speed):
        small = linearize(bicycle, upright_running(bicycle, speed), ("lean", "steer"), dependent=_DEPENDENT)
        return small.M, small.C, small.K

    M, C, K = jax.vmap(at)(jnp.array([0.0, _SPEED]))
    return BicycleMatrices(M[0], C[1] / _SPEED, K[0] / bicycle.g, (K[1] - K[0]) / _SPEED**2, bicycle.g)


_matrices = compiled_quickly(_linearised)  # the first call in 10 s of processor time, not in 23; the second in 6 ms
