"""Every case through every method, in this process's floating-point type."""

import time

import jax
import numpy as np

from atlas_cases.case import single
from atlas_cases.mechanisms import mechanism
from atlas_cases.methods import Method
from atlas_cases.outcomes import FLAGGED, NOT_APPLICABLE, WRONG, Outcome
from jourdain_jax import DifferentiationModeError, SimulationError


def cells(cases, methods, progress=print):
    """The cells of the atlas, one dictionary each, with the documented keys."""
    dtype = "float32" if single() else "float64"
    for case in cases:
        probe, begin, found = case.probe(), time.perf_counter(), []
        for method in methods:
            tolerance = case.tolerance32 if single() else case.tolerance
            outcome = _asked(probe, method, tolerance)
            found.append(f"{method.name} {outcome.outcome}")
            yield {
                "case": case.name,
                "method": method.name,
                "dtype": dtype,
                "outcome": outcome.outcome,
                "error": None if outcome.error is None or not np.isfinite(outcome.error) else outcome.error,
                "tolerance": tolerance,
                "mechanism": mechanism(case, method, outcome),
            }
        progress(
            f"{case.name} ({dtype}, {time.perf_counter() - begin:.0f} s):"
            f" {'; '.join(f for f in found if NOT_APPLICABLE not in f)}"
        )
        jax.clear_caches()


def _asked(probe, method: Method, tolerance) -> Outcome:
    """The method's outcome. An error is a flag; but the engine as it comes must raise its own kind of error,
    any other is a wrong answer that says why.
    """
    try:
        return probe.cell(method, tolerance)
    except Exception as error:
        own = isinstance(error, ValueError | SimulationError | DifferentiationModeError)
        said = f"raised {type(error).__name__}: {str(error).splitlines()[0][:120] if str(error) else ''}"
        return Outcome(WRONG if method.group == "engine" and not own else FLAGGED, None, said)
