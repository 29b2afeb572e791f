"""Measured bicycles: parameter files, linear stability and its uncertainty, rides."""

from jourdain_jax.bicycle.job import Refused, Study, run, study, table, write_results
from jourdain_jax.bicycle.linear import linear_matrices, upright_running
from jourdain_jax.bicycle.parameter_files import MeasuredBicycle, measured_bicycle, read_bicycle, shipped_bicycles
from jourdain_jax.bicycle.stability import StabilitySpeeds, eigenvalues, stability_speeds
from jourdain_jax.bicycle.uncertainty import Interval, ParameterSamples, interval, sample_parameters

__all__ = [
    "Interval",
    "MeasuredBicycle",
    "ParameterSamples",
    "Refused",
    "StabilitySpeeds",
    "Study",
    "eigenvalues",
    "interval",
    "linear_matrices",
    "measured_bicycle",
    "read_bicycle",
    "run",
    "sample_parameters",
    "shipped_bicycles",
    "stability_speeds",
    "study",
    "table",
    "upright_running",
    "write_results",
]
