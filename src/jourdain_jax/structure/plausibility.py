"""Checks of the numbers that a scene gives for its bodies, contacts and gravity.

    m >= 0,   I = I' >= 0,   R' R = 1,   det R = 1
    n.n = 1,   e.e = 1 of gravity,   0 < r of a rolling body and of its ground,   0 <= tyre < r
    gap = 0 with height="coordinates"
    d[n.(p - o)]/dt = - n.(v + w x (p - o))    p fixed; a plane's motion, stated by o, n and by v, w
    dg/dt along the motion of other bodies = 0  or  v, w != 0      g: pose of a contact's ground
    I_3 <= I_1 + I_2
    x' M x > 0 for motions x with A x = 0

The table `CHECKS` contains these checks as functions of numbers at some states. The checks run when a scene
is probed, and a fault raises an error with the message of its check. Checks with a `label` also run in the
compiled program of each motion, where a fault becomes a result code. There they run at the start and, since
the start may hide a fault, at random states of the domain on the geometric constraints.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import reduce
from itertools import combinations
from operator import or_

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jourdain_jax.calculus.reals import Flag, array_module, at_index, eps_of, largest
from jourdain_jax.equations.instant import derivatives_in_speeds
from jourdain_jax.equations.kinematics import inertias_of, motion_at, pose_at
from jourdain_jax.equations.virtual_power import mass_matrix
from jourdain_jax.program.eager import eval_numpy
from jourdain_jax.scene.coordinates import Sentences
from jourdain_jax.scene.scene import Scene
from jourdain_jax.structure.assembly import random_states
from jourdain_jax.structure.scene_numbers import Numbers, numbers_of, stated_of

ROUNDED = 0.05  # physics: of the largest moment of inertia: error of measured and rounded values
TOLERANCE = 1e-4  # physics: relative: covers rounded constants, while mistakes are larger
_ROWS_INSTEAD = (
    "state it in `velocity_constraints`: tangents @ (rolling.velocity_at(point) - ground.velocity_at(point))"
)


@dataclass(frozen=True)
class Check:
    """One check: the kind of numbers, the test (axis of states first), the message for one state, and a label
    if the fault ends a motion.
    """

    of: str
    wrong: Callable
    says: Callable[[np.ndarray], str]
    label: str = ""
    group: str = "faults"  # or "gravity"; "moments", which a fit may pass; "grounds", possible but unlikely


def _size(x):
    return largest(x, (-2, -1))


def _lopsided(x):
    I = x[..., :3, :]
    return _size(I - I.swapaxes(-1, -2)) > TOLERANCE * _size(x)


def _negative(x):
    return _indefinite(_scaled(x) + TOLERANCE * np.eye(3))


def _exceeds_the_others(x):
    """Return whether the largest moment of a body exceeds the sum of the others by more than errors of
    measured values. For thin wheels both are equal. A moment about one axis alone is exempt, since in a plane
    the others have no effect.
    """
    I = _scaled(x)
    trace, pairs, _ = _invariants(I)
    less = trace[..., None, None] * np.eye(3) - (1 + 1 / (1 + ROUNDED)) * I
    return (pairs > TOLERANCE) & _indefinite(less) & ~_negative(x)


def _scaled(x):
    """Return the symmetric part of an inertia matrix in units of its largest entry or of the inertia of a
    point.
    """
    I, size = x[..., :3, :], _size(x)
    return (I + I.swapaxes(-1, -2)) / (2 * (size + (size == 0)))[..., None, None]


def _indefinite(S):
    """Return whether a symmetric matrix has a negative eigenvalue: one of its invariants is negative."""
    return reduce(or_, (x < 0 for x in _invariants(S)))


def _invariants(S):
    """Return the elementary symmetric polynomials of the eigenvalues of a symmetric matrix."""
    trace = sum(S[..., i, i] for i in range(3))
    pairs = sum(S[..., i, i] * S[..., k, k] - S[..., i, k] ** 2 for i, k in combinations(range(3), 2))
    return trace, pairs, _volume(S)


def _from_identity(R):
    return _size(R.swapaxes(-1, -2) @ R - np.eye(3))


def _volume(R):
    at = lambda i, k: R[..., i, k]
    return sum(
        at(0, i) * (at(1, (i + 1) % 3) * at(2, (i + 2) % 3) - at(1, (i + 2) % 3) * at(2, (i + 1) % 3))
        for i in range(3)
    )


def _off(square):
    return abs(square**0.5 - 1)


def _nowhere(x):
    """Return one flag per state. All flags are true if no state has finite numbers; otherwise
    all are false.
    """
    bad = ~array_module(x).isfinite(x.reshape(len(x), -1)).all(1)
    return bad & bad.all()


def without_inertia(M, A):
    """Return for each state whether a motion x that the rows A permit (`A x = 0`) has no inertia (`M x = 0`).
    Such motions are the null vectors of K, since both terms of K are positive semidefinite; they exist if a
    pivot of K is zero to round-off.

        K = M + A' A    in speeds of unit inertia, with rows of unit length

    A pivot that is NaN does not count as zero.
    """
    xp, n = array_module((M, A)), M.shape[-1]
    own = xp.stack([M[..., i, i] for i in range(n)], -1)
    scale = 1 / xp.sqrt(xp.where(own > 0, own, 1.0))
    M, A = scale[..., :, None] * M * scale[..., None, :], A * scale[..., None, :]
    square = xp.sum(A * A, -1)
    A = A / xp.sqrt(xp.where(square > 0, square, 1.0))[..., None]
    K, wrong = M + xp.sum(A[..., :, None] * A[..., None, :], -3), xp.zeros(M.shape[:-2], bool)
    size = [K[..., i, i] for i in range(n)]
    for i in range(n):
        row, zero = K[..., i, :], K[..., i, i] <= 16 * n * eps_of(M) * size[i]
        K = K - row[..., :, None] * row[..., None, :] / xp.where(zero, 1.0, row[..., i])[..., None, None]
        wrong = wrong | zero
    return wrong


def checks_inertia(scene: Scene) -> bool:
    """Return whether compiled programs check for free motions without inertia. For many speeds the
    elimination would take a minute to compile.
    """
    return len(scene.speed_names.entries) <= 16


def _says_nothing(piece: str) -> Callable:
    return lambda _: (
        f"has no finite {piece} at any probed state, expected finite numbers; check its computation"
    )


def _says_moments(x) -> str:
    return (
        "has principal moments of inertia {:.4g}, {:.4g} and {:.4g} kg m^2, the last above the sum of "
        "the others: no distribution of mass has them; check signs and products of inertia, and bound "
        "the parameters of a fit".format(*np.linalg.eigvalsh(x[:3]))
    )


def _unit(kind: str, group: str) -> Check:
    return Check(
        kind,
        lambda square: _off(square) > TOLERANCE,
        lambda square: (
            f"has a length that differs from 1 by {_off(square):.2g}, expected a unit vector; "
            "divide it by its length"
        ),
        "not a unit vector",
        group,
    )


def _stated_twice(kind: str) -> Check:
    return Check(
        kind,
        lambda x: abs(x[..., 0] - x[..., 1]) > TOLERANCE * x[..., 2],
        lambda x: (
            f"moves along its normal at {x[0]:.4g} m/s by `origin` and `tilt`, but at {x[1]:.4g} m/s by "
            "`velocity` and `angular_velocity`; state the motion in both: velocity = d origin/dt, "
            "angular_velocity = (0, d tilt/dt, 0); if coordinates move it, omit the contact and "
            f"{_ROWS_INSTEAD}"
        ),
        "a plane that contradicts its stated motion",
        "grounds",
    )


_OF_BODIES = ("mass", "inertia")
CHECKS = (
    *(
        Check(piece, _nowhere, _says_nothing(piece), f"no finite {piece}" if piece in _OF_BODIES else "")
        for piece in (*_OF_BODIES, "orientation", "position")
    ),
    Check(
        "touch",
        _nowhere,
        lambda _: (
            "has no point where body and ground touch at any probed state; make a ball smaller than its "
            "hollow cylinder or sphere, give a surface a nonzero gradient, and state a `domain` near the "
            "ground"
        ),
    ),
    Check(
        "mass",
        lambda m: m < 0,
        lambda m: f"has a mass of {m:.4g} kg, expected a number that is not negative; check its computation",
        "a negative mass",
    ),
    Check(
        "inertia",
        _lopsided,
        lambda x: (
            "has an inertia that is not symmetric; give the same products of inertia above and below "
            "the diagonal"
        ),
        "an inertia that is not symmetric",
    ),
    Check(
        "inertia",
        _negative,
        lambda x: (
            f"has a principal moment of inertia of {np.linalg.eigvalsh(x[:3])[0]:.4g} kg m^2, expected none "
            "below zero; check signs and products of inertia"
        ),
        "a negative moment of inertia",
    ),
    Check(
        "inertia",
        _exceeds_the_others,
        _says_moments,
        "a moment of inertia above the sum of the others",
        "moments",
    ),
    Check(
        "orientation",
        lambda R: _from_identity(R) > TOLERANCE,
        lambda R: (
            "has an orientation R that is not a rotation: R' R differs from the identity by "
            f"{_from_identity(R):.2g}; build it from jj.rot_x, jj.rot_y, jj.rot_z or "
            "jj.quaternion_to_matrix"
        ),
        "an orientation that is not a rotation",
    ),
    Check(
        "orientation",
        lambda R: _volume(R) < 0,
        lambda R: "has an orientation of determinant -1, a reflection; reverse one axis",
        "a reflected orientation",
    ),
    _unit("unit", "grounds"),
    Check(
        "length",
        lambda x: x <= 0,
        lambda x: f"is {x:.4g} m, expected a positive number; check it",
        "no positive length",
    ),
    Check(
        "tyre",
        lambda x: x < 0,
        lambda x: f"has a tyre of {x:.4g} m, expected a radius >= 0",
        "a negative tyre",
    ),
    Check(
        "gap",
        lambda x: abs(x[..., 0]) > TOLERANCE * x[..., 1],
        lambda x: (
            f'has height="coordinates", but at a probed state its body is {x[0]:.4g} m off the ground; let '
            'the coordinates keep it there, or write height="row"'
        ),
        "a body off its ground",
    ),
    Check(
        "friction",
        lambda x: x < 0,
        lambda x: f"is {x:.4g}, expected a coefficient that is not negative",
        "a negative coefficient of friction",
    ),
    Check(
        "static",
        lambda x: x[..., 0] < x[..., 1],
        lambda x: f"is {x[0]:.4g}, expected at least the coefficient of sliding, {x[1]:.4g}",
        "static friction below sliding friction",
    ),
    Check(
        "restitution",
        lambda x: (x < 0) | (x > 1),
        lambda x: f"is {x:.4g}, expected a number from 0 to 1",
        "a restitution outside 0 to 1",
    ),
    _unit("gravity", "gravity"),
    Check(
        "ground",
        lambda x: (x[..., 0] > TOLERANCE) & ~(x[..., 1] > 0).any(0),
        lambda _: (
            "moves with another body, but its `velocity` and `angular_velocity` are zero; omit the contact "
            f"and {_ROWS_INSTEAD}"
        ),
        "a ground that another body carries",
        "grounds",
    ),
    *(_stated_twice(kind) for kind in ("plane", "own plane")),
)


NO_INERTIA = "no inertia along a free direction"
BY_ROWS = "gap", "own plane"  # kinds of numbers that depend on the projection onto geometric constraints


def elsewhere(scene: Scene) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return random states t, q, u of the scene's domain, not projected onto the geometric constraints."""
    return random_states(scene, 3, np.random.default_rng(0))


def faults_at(
    scene: Scene, t, q, u, inputs, others: Float[Array, "others coordinates"], moments: bool = True
) -> dict[str, Flag]:
    """Return for each fault whether it occurs at (t, q, u), or at a state from `elsewhere` with the
    coordinates `others`. This works under jit and vmap. NaN does not count as a fault. `moments`: whether
    moments of inertia above the sum of the others are a fault.
    """
    times, _, speeds = (x[: len(others)] for x in elsewhere(scene))
    pairs = zip(map(jnp.asarray, (t, q, u)), (times, others, speeds), strict=True)
    states = tuple(jnp.concatenate([x[None], more.astype(x.dtype)]) for x, more in pairs)
    # not vmapped: loads may be callbacks without batching
    numbers = jax.lax.map(
        lambda state: numbers_of(scene, motion_at(scene, state[0], state[1], state[2], inputs)), states
    )
    checks = [check for check in CHECKS if check.label and (moments or check.group != "moments")]
    seen = ((check, name, x) for check in checks for name, x in numbers[check.of].items())
    found = {f"{check.label}: {name}": jnp.any(check.wrong(x)) for check, name, x in seen}
    if len(others) and checks_inertia(scene):
        at, place, moving = (x[0] for x in elsewhere(scene))
        by_speeds, _, motion = derivatives_in_speeds(scene, at, place, moving, inputs)
        weights, moved = inertias_of(motion), by_speeds.bodies
        M = mass_matrix(weights.mass, weights.inertia, moved.linear, moved.angular)
        found[NO_INERTIA] = without_inertia(M, by_speeds.rows)
    return found


def any_wrong(stacked: dict[str, Array], moments: bool) -> Flag:
    """Return whether any number fails its check: of moments of inertia, or any other check. `stacked`: kind
    -> numbers, with axes of states and of the bodies or contacts that have them.
    """
    checks = [check for check in CHECKS if check.label and (check.group == "moments") == moments]
    found = [check.wrong(stacked[check.of]).ravel() for check in checks if check.of in stacked]
    return jnp.any(jnp.hstack([False, *found]))


def impossible_bodies(scene: Scene, q) -> Sentences:
    """Return one message for each body with a mass or moments of inertia that no distribution of mass has.
    Bodies with a moment about one axis alone are exempt from the last condition.

        m >= 0,   0 <= I_1 <= I_2 <= I_3 <= I_1 + I_2
    """
    stated = {kind: at_index(x, None) for kind, x in _weights(scene, q).items()}
    return sentences(scene, stated, "faults") + sentences(scene, stated, "moments")


@eval_numpy
def _weights(scene: Scene, q) -> Numbers:
    numbers = stated_of(scene, pose_at(scene, 0.0, q))
    return {kind: numbers[kind] for kind in ("mass", "inertia")}


def sentences(scene: Scene, numbers: Numbers, group: str) -> Sentences:
    """Return one message for each fault of a group of the table, about the first state with the fault."""
    found = []
    for check in (check for check in CHECKS if check.group == group):
        for name, x in numbers.get(check.of, {}).items():
            wrong = np.flatnonzero(check.wrong(x))
            found += [f"{name} of `{type(scene).__name__}` {check.says(x[wrong[0]])}"] if wrong.size else []
    return tuple(found)
