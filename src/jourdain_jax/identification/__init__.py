"""Identification of parameters from measurements: `fit`, its uncertainty and its report.

    data       what was measured: experiments, sensors, channels, first guesses and priors
    solve      residuals of all runs, F(theta) = sum rho(w) + sum n log sigma + priors, and its minimum
    inference  how well the minimum is known: covariance, intervals, densities, filters
    report     `Fit`: values, warnings, text and page

A motion enters only through `solve/shooting.py`. Open `fit.py` first.
"""

from jourdain_jax.identification.data.channels import Accelerometer, LoadCell
from jourdain_jax.identification.data.estimate import joint_normal, unbounded
from jourdain_jax.identification.data.sensors import Actuator, Sensor
from jourdain_jax.identification.inference.likelihood import filtered_log_likelihood, log_likelihood
from jourdain_jax.identification.inference.log_density import LogDensity, log_density
from jourdain_jax.identification.inference.planned_information import PlannedInformation, planned_information
from jourdain_jax.identification.report.fit_result import Fit
from jourdain_jax.identification.solve.body_inertia import possible_inertia
from jourdain_jax.identification.solve.levenberg_marquardt import huber, student_t
from jourdain_jax.identification.solve.shooting import MultipleShooting
from jourdain_jax.scene.possible_inertia import inertia_from_log_cholesky, log_cholesky

__all__ = [
    "Accelerometer",
    "Actuator",
    "Fit",
    "LoadCell",
    "LogDensity",
    "MultipleShooting",
    "PlannedInformation",
    "Sensor",
    "filtered_log_likelihood",
    "huber",
    "inertia_from_log_cholesky",
    "joint_normal",
    "log_cholesky",
    "log_density",
    "log_likelihood",
    "planned_information",
    "possible_inertia",
    "student_t",
    "unbounded",
]
