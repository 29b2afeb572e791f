"""Why a method fails, in one line each: the usual reason of every method, unless a case gives its own, for
the method or for its group.
"""

from atlas_cases.case import Case
from atlas_cases.methods import Method
from atlas_cases.outcomes import FLAGGED, NOT_APPLICABLE, RIGHT, Outcome

USUAL = {
    **dict.fromkeys(
        ("privileged", "gibbs-appell"),
        "the privileged speeds stop determining the others: division by their pivot",
    ),
    **dict.fromkeys(
        ("qr", "svd", "kkt", "udwadia-kalaba"),
        "all speeds are integrated: errors off the rows and round-off are amplified by the motion before the"
        " projection takes them back",
    ),
    **dict.fromkeys(
        ("default", "rollout"), "the tolerance is met per step, and errors are amplified by the motion"
    ),
    "fixed partition": "division by the determinant of a partition that was chosen once, at the start",
    "Schur, Cholesky": (
        "A M^-1 A' is singular or nearly so: its Cholesky factor fails or loses twice the digits"
    ),
    "KKT, LU": "the saddle-point matrix is singular where rows are dependent",
    "pinv, 1e-10": (
        "a fixed cut-off on A M^-1 A': squared singular values fall below it early, or round-off of float32"
        " rises above it"
    ),
    "ridge 1e-6": "a regularised row is a soft row: it yields by 1e-6 of its multiplier, all the time",
    "raw SVD basis": (
        "the factorisation assumes a rank and its derivative divides by differences of singular values"
    ),
    "raw QR basis": (
        "without pivoting, dependent rows leave a wrong null space; the derivative divides by zero for rows"
        " along the axes"
    ),
    "speeds in SVD basis": (
        "LAPACK returns another rotation or sign of the basis at each call: speeds jump; their rate, by a"
        " difference, has half the digits"
    ),
    "speeds in QR basis": (
        "signs of Householder vectors flip, and the basis with them: speeds jump; their rate, by a"
        " difference, has half the digits"
    ),
    "no projection": (
        "rows hold for accelerations only: round-off and truncation of velocities and positions are never"
        " taken back"
    ),
    "Baumgarte 5/s": (
        "violations decay at a rate that has nothing to do with the motion, and their forces do work"
    ),
    "Baumgarte 1e4/s": "a pole at -1e4/s that the motion does not have: the step is bound to it",
    "Tsit5": (
        "order 5: the tolerance is met per step, and errors add up over the run; explicit: a stiff force"
        " bounds its steps"
    ),
    "Dopri8": (
        "the tolerance is met per step, and errors add up over the run or are amplified by the motion;"
        " explicit: a stiff force bounds its steps"
    ),
    "Kvaerno5": (
        "order 5, by iterations that stop at the tolerance: errors of the order of it add up; where these"
        " iterations fail, steps shrink"
    ),
    "Radau IIA": (
        "order 5 with an estimate of order 3: many short steps at a tight tolerance, whose errors add up over"
        " the run"
    ),
    "implicit midpoint": (
        "order 2: its energy error stays bounded, but is of the size of the step squared; a fast transient is"
        " not damped, only its sign flips"
    ),
    "DLA": (
        "order 2: the discrete Lagrangian is conserved, not the energy; a gauge term, which changes no"
        " motion, changes its errors"
    ),
    "discrete gradient": (
        "order 2: the energy is kept to round-off, every other integral and the path itself only to the size"
        " of the step squared"
    ),
    "forward mode": (
        "the derivative is exact for steps that are off by the tolerance: a motion that amplifies errors"
        " spoils it, too"
    ),
    "MuJoCo": (
        "constraints and contacts are springs with regularised friction: rods stretch, discs sink in and"
        " creep; steps have one length"
    ),
}


REGULAR = (
    "Schur, Cholesky",
    "KKT, LU",
    "pinv, 1e-10",
    "raw SVD basis",
    "raw QR basis",
)  # naive accelerations that are right where rows are independent
ENGINE = ("engine", "reductions", "constraints", "integrators")
TRUNCATION = (
    "its accelerations are right here; fixed steps of fourth order add up their truncation, and the motion"
    " amplifies it"
)
ROUND_OFF = "its accelerations are right here; in float32 the round-off of thousands of short steps adds up"
STEPPED = dict.fromkeys((*REGULAR, "fixed partition"), TRUNCATION)
UNPROJECTED = dict.fromkeys(
    REGULAR,
    "its accelerations are right here; rows hold for accelerations only, and nothing takes the drift off them"
    " back",
) | {
    "fixed partition": (
        "its speeds meet the rows; positions and norms of quaternions drift, and nothing takes that back"
    )
}
PARALLEL = dict.fromkeys(
    ("qr", "svd", "kkt", "udwadia-kalaba", "constraints", "integrators"),
    "near parallel rows accelerations carry round-off over the smallest singular value: there no step meets a"
    " tight tolerance",
)
NEAR_FLAT = dict.fromkeys(
    ENGINE,
    "errors of the attitude count 1/theta^2: the swing ends elsewhere, steps shrink, or the disc runs into"
    " its stop event",
)

CROSSING = dict.fromkeys(
    ENGINE,
    "two branches cross there: near it accelerations carry round-off over the distance, which may decide on"
    " which one it goes on",
)

# Of a case, or of all cases of one number: method or group -> why it fails there.
BY_CASE: dict[str, dict[str, str]] = {
    "E1": {"fixed partition": "ydot = xdot tan(heading): division by cos(heading), which passes zero"},
    "E1 disc": (
        dict.fromkeys(REGULAR, ROUND_OFF)
        | {"fixed partition": "rolldot = xdot / (R cos(heading)): division by zero at 90 degrees"}
        | {
            "ridge 1e-6": (
                "a regularised row is a soft row; in float32 the round-off of thousands of short steps adds"
                " up, too"
            )
        }
    ),
    "E2": STEPPED,
    "E5": PARALLEL,
    "E5 gradient": PARALLEL | {"rollout": "inside a derivative no lane can be run again with the full state"},
    "E6": {
        "naive": (
            "it goes on where no motion does: what would stop the body at once is cut off, softened, or"
            " divided by round-off"
        )
    },
    "E7": {"fixed partition": ROUND_OFF},
    "E7 copies": {},
    "E8": (
        dict.fromkeys(
            ENGINE,
            "the second row differs from the first by the angle: of the order of round-off, no cut-off can"
            " tell the rank",
        )
        | dict.fromkeys(
            ("privileged", "gibbs-appell"),
            "every partition has a pivot of the size of the angle: too small to count as independent",
        )
    ),
    "E9": UNPROJECTED,
    "E11": (
        dict.fromkeys(
            ENGINE,
            "one freedom becomes three: near there accelerations carry round-off over the distance to the"
            " singular configuration",
        )
        | {
            "naive": (
                "one freedom becomes three: digits are lost near there, and round-off may choose the branch"
                " on which it goes on"
            )
        }
    ),
    "E12": STEPPED,
    "E12 angles": {"naive": "fixed steps across infinite rates of angles, to wherever their length puts it"},
    "E13": {"MuJoCo": "RK4 with steps of one length, 1 ms: their truncation adds up over the run"},
    "E13 ball": UNPROJECTED,
    "E14": NEAR_FLAT | {"naive": "fixed steps too long for the swing through the flat position"},
    "E14 Euler": {"naive": "it goes on where the disc lies flat and no motion does"},
    "E18": (
        dict.fromkeys(
            (*REGULAR, "no projection"),
            "accelerations hold a violation constant: a velocity off its row stays off",
        )
        | dict.fromkeys(
            ("fixed partition", "speeds in SVD basis", "speeds in QR basis"),
            "it drops the part off the row, but not M-orthogonally: another motion",
        )
    ),
    "E19": {"Baumgarte 5/s": "backwards in time the terms drive violations apart, at 5/s"},
    "E21": {"fixed partition": ROUND_OFF},
    "E21 units": dict.fromkeys(REGULAR, TRUNCATION),
    "E21 light": dict.fromkeys(
        ("privileged", "gibbs-appell", "fixed partition"),
        "a mass ratio of 1e8 is more than float32 holds: the light part is lost in sums",
    ),
    "E27": CROSSING,
    "E28": CROSSING,
    "E30": {"MuJoCo": "it knows no stop events"},
    "E31": {
        "MuJoCo": (
            "steps of one length, in which the force is constant: the flanks of the blow fall between them"
        )
    },
    "E36": dict.fromkeys(
        ENGINE, "the edge is narrower than a step: no stage meets it, and the energy says so afterwards"
    ),
    "E24": {"naive": "at rest the row has no slope, and whatever force comes out is made up"},
}


def mechanism(case: Case, method: Method, outcome: Outcome) -> str:
    """One line: why it failed, and what it said itself."""
    if outcome.outcome == RIGHT:
        return ""
    if outcome.outcome == NOT_APPLICABLE:
        return outcome.flag
    if case.flag_is_right and outcome.outcome == FLAGGED:
        return f"{case.reason} [{outcome.flag}]"
    here = BY_CASE.get(case.name, BY_CASE.get(case.name.split()[0], {}))
    own = next((here[key] for key in (method.name, method.group) if key in here), USUAL[method.name])
    return " ".join(part for part in (own, f"[{outcome.flag}]" if outcome.flag else "") if part)
