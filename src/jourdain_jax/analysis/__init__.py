"""Analyses of scenes and states: `report`, `verify`, `energy`, `linearize`, `steady`, `family`, `periodic`.

`motion_derivatives.py` computes the derivatives at one instant that linearisation, steady motions and
families share. Open `report.py` or `linearize.py` first.
"""

from jourdain_jax.analysis.linearize import Linearization
from jourdain_jax.analysis.report import Report
from jourdain_jax.analysis.state_space import StateSpace
from jourdain_jax.analysis.statements import derivative_exists
from jourdain_jax.analysis.steady import SteadyMotion
from jourdain_jax.analysis.verification import Verification
from jourdain_jax.analysis.verify import Energy, EnergyBalance, energy_balance

__all__ = [
    "Energy",
    "EnergyBalance",
    "Linearization",
    "Report",
    "StateSpace",
    "SteadyMotion",
    "Verification",
    "derivative_exists",
    "energy_balance",
]
