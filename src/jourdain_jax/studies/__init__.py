"""Studies of many motions: designs, runs that survive interruption, storage, statistics, Sobol' indices.

`study.py` -> `design.py` -> `outputs.py` (one block of samples) -> `run.py` -> `store.py`. Files on disk keep
their format between versions. Open `study.py` first.
"""

from jourdain_jax.studies.design import Design, Levels, LogNormal, LogUniform, Normal, Uniform
from jourdain_jax.studies.mean_gradients import MeanGradients
from jourdain_jax.studies.outputs import (
    End,
    EventTime,
    Happened,
    Integral,
    Largest,
    LargestMagnitude,
    Quantity,
    Smallest,
)
from jourdain_jax.studies.records import InUseError
from jourdain_jax.studies.result import StudyResult, merge_studies
from jourdain_jax.studies.statistics import SobolIndices, sobol_indices

__all__ = [
    "Design",
    "End",
    "EventTime",
    "Happened",
    "InUseError",
    "Integral",
    "Largest",
    "LargestMagnitude",
    "Levels",
    "LogNormal",
    "LogUniform",
    "MeanGradients",
    "Normal",
    "Quantity",
    "Smallest",
    "SobolIndices",
    "StudyResult",
    "Uniform",
    "merge_studies",
    "sobol_indices",
]
