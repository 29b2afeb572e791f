"""Measured bicycles: parameter files and raw measurements, linear stability and its uncertainty, rides.

The formats of the files in `data` stay readable; add a bicycle by adding a file. Open `job.py` first, then
`stability.py`. The nonlinear model is `models/whipple_bicycle.py`.
"""

from jourdain_jax.bicycle.job import Refused, Study, run, study, table, write_results
from jourdain_jax.bicycle.measurements import benchmark_from_measurements, read_readings
from jourdain_jax.bicycle.parameter_files import (
    MeasuredBicycle,
    measured_bicycle,
    read_bicycle,
    shipped_bicycles,
    shipped_measurements,
)
from jourdain_jax.bicycle.parameters import PARAMETER_NAMES, PARAMETERS
from jourdain_jax.bicycle.stability import (
    Interval,
    ParameterSamples,
    StabilitySpeeds,
    eigenvalues,
    interval,
    linear_matrices,
    sample_parameters,
    stability_speeds,
    upright_running,
)

__all__ = [
    "PARAMETERS",
    "PARAMETER_NAMES",
    "Interval",
    "MeasuredBicycle",
    "ParameterSamples",
    "Refused",
    "StabilitySpeeds",
    "Study",
    "benchmark_from_measurements",
    "eigenvalues",
    "interval",
    "linear_matrices",
    "measured_bicycle",
    "read_bicycle",
    "read_readings",
    "run",
    "sample_parameters",
    "shipped_bicycles",
    "shipped_measurements",
    "stability_speeds",
    "study",
    "table",
    "upright_running",
    "write_results",
]
