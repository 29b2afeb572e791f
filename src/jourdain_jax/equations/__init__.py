"""Jourdain's principle of virtual power: kinematics, virtual power, constraints, reduction, accelerations.

    kinematics.py -> virtual_power.py -> rows.py -> reductions.py -> gibbs_appell.py

The code of every formula of docs/theory.md is here or in `dynamics`, beside the formula. Contacts that
switch: `contact_laws.py`, `phases.py`. Open `kinematics.py` first.
"""

from jourdain_jax.equations.gibbs_appell import GibbsAppell, gibbs_equations, gibbs_function
from jourdain_jax.equations.instant import constraint_rows
from jourdain_jax.equations.kinematics import coordinate_rates, partial_velocities
from jourdain_jax.equations.reductions import (
    Multipliers,
    NullSpaceQR,
    NullSpaceSVD,
    Privileged,
    UdwadiaKalaba,
)
from jourdain_jax.equations.rows import position_residual, velocity_residual
from jourdain_jax.equations.virtual_power import (
    generalized_forces,
    kinetic_energy,
    lagrange_equations,
    potential_energy,
    unconstrained_equations,
)

__all__ = [
    "GibbsAppell",
    "Multipliers",
    "NullSpaceQR",
    "NullSpaceSVD",
    "Privileged",
    "UdwadiaKalaba",
    "constraint_rows",
    "coordinate_rates",
    "generalized_forces",
    "gibbs_equations",
    "gibbs_function",
    "kinetic_energy",
    "lagrange_equations",
    "partial_velocities",
    "position_residual",
    "potential_energy",
    "unconstrained_equations",
    "velocity_residual",
]
