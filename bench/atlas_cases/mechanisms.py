"""Why a method fails, in one line each: the usual reason of every method, unless a case gives its own."""

from atlas_cases.case import Case
from atlas_cases.methods import Method
from atlas_cases.outcomes import FLAGGED, NAN, NOT_APPLICABLE, RIGHT, STALLED, Outcome

USUAL = {
    "fixed partition": "division by the determinant of a partition that was chosen once, at the start",
    "Schur, Cholesky": "A M^-1 A' is singular or nearly so: its Cholesky factor fails or loses twice the digits",
    "KKT, LU": "the saddle-point matrix is singular where rows are dependent",
    "pinv, 1e-10": "a fixed cut-off on A M^-1 A': squared singular values fall below it early, or round-off of float32 rises above it",
    "ridge 1e-6": "a regularised row is a soft row: it yields by 1e-6 of its multiplier, all the time",
    "raw SVD basis": "the factorisation assumes a rank and its derivative divides by differences of singular values",
    "raw QR basis": "without pivoting, dependent rows leave a wrong null space; the derivative divides by zero for rows along the axes",
    "speeds in SVD basis": "LAPACK returns another rotation or sign of the basis at each call: speeds in it jump",
    "speeds in QR basis": "signs of Householder vectors flip, and the basis with them: speeds in it jump",
    "no projection": "rows hold for accelerations only: round-off and truncation of velocities and positions are never taken back",
    "Baumgarte 5/s": "violations decay at a rate that has nothing to do with the motion, and their forces do work",
    "Baumgarte 1e4/s": "a pole at -1e4/s that the motion does not have: the step is bound to it",
    "privileged": "the privileged speeds stop determining the others: division by their pivot",
    "gibbs-appell": "the privileged speeds stop determining the others: division by their pivot",
}


def mechanism(case: Case, method: Method, outcome: Outcome) -> str:
    """One line: why it failed, and what it said itself."""
    if outcome.outcome == RIGHT:
        return ""
    if outcome.outcome == NOT_APPLICABLE:
        return outcome.flag
    own = case.mechanisms.get(method.name, USUAL.get(method.name, ""))
    said = f"[{outcome.flag}]" if outcome.flag else ""
    if outcome.outcome in (FLAGGED, STALLED, NAN):
        return " ".join(part for part in (own, said) if part)
    return " ".join(part for part in (own, said) if part)
