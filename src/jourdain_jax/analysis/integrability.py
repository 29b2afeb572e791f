"""Determine which constraints are holonomic: each one by Frobenius' criterion, all together by the growth of
the admissible velocities.

A constraint `A u + d = 0` is the differential form `w = alpha . dq + alpha_0 dt`, `alpha = A N+`, `alpha_0 =
d - alpha . nu`. It is integrable if and only if `w ^ dw = 0`, that is, if the two-form dw vanishes on the
velocities that w admits (Frobenius).

All constraints together: with the admissible velocities `qdot = X y + X_0`, the spaces `D_1 = span X`,
`D_k+1 = D_k + [D_1, D_k]` grow to a final dimension, and the motion stays on a manifold of that dimension. If
constraints or rates depend on time or are not homogeneous, time counts as an additional coordinate with the
field `(1, X_0)`; the growth vector does not count it.

The Lie bracket is `[X, Y] = DY X - DX Y`. Brackets of brackets need second and higher derivatives. These are
taken by central differences of eighth order (to about 1e-11), because each further exact derivative would
double the cost. Source: Wang and Pao (2003), section II; for the growth vector A. M. Vershik and V. Ya.
Gershkovich, Dynamical Systems VII (1994).

Constraints and coordinate rates are linear in the speeds,

    A u + d = 0,   qdot = N u + nu.

They and their derivatives with respect to x = (t, q) are evaluated at many points by NumPy, from the scene's
scalar graph and its sparse derivatives, without compilation.
"""

from collections.abc import Callable

import jax.numpy as jnp
import numpy as np

from jourdain_jax.calculus.reals import largest, real_type
from jourdain_jax.program.derivative import derivatives, jacobian
from jourdain_jax.program.evaluate import Probes
from jourdain_jax.scene.scene import Scene
from jourdain_jax.structure.sampling import sample_states
from jourdain_jax.structure.structure import structure_of
from jourdain_jax.structure.trace import named_values, traced_scene

Both = tuple[np.ndarray, np.ndarray]


class RowsOverStates:
    """Constraints and coordinate rates of a scene as functions of points `x = (t, q)`."""

    def __init__(self, scene: Scene):
        self.scene, self.traced = scene, traced_scene(scene)
        g, at, u = self.traced.graph, self.traced.at, self.traced.u.tolist()
        qdot, variables = at.qdot.tolist(), [self.traced.t, *self.traced.q.tolist()]
        flat = [*at.phi.tolist(), *qdot]
        slopes = np.full((len(flat), len(u)), g.zero)
        for row, of in zip(slopes, jacobian(g, flat, u), strict=True):
            row[[u.index(n) for n in of]] = [*of.values()]
        self.shape, still = slopes.shape, g.substituted(qdot, dict.fromkeys(u, g.zero))
        self.values = [*flat, *still, *slopes.ravel().tolist()]
        self.moved = [f"rate {k}" for k in range(len(variables))]
        rates = [g.input(name, True) for name in self.moved]
        self.changes = derivatives(g, self.values, dict(zip(variables, rates, strict=True)))

    def __call__(self, x: np.ndarray, u: np.ndarray) -> tuple[Both, Callable[[np.ndarray], Both]]:
        """Return the rows (d, A) and the frame (1, 0; nu, N) at points, and a function that returns their
        derivatives along directions. The speeds `u` matter only for nonlinear constraints.

        `x`, `u` and the directions have a leading axis of points.
        """
        inputs = np.zeros((len(x), len(self.scene.inputs)))
        probes = Probes(self.traced.graph, named_values(self.scene, x[:, 0], x[:, 1:], u, inputs))

        def along(direction: np.ndarray) -> Both:
            moving = probes.with_inputs(dict(zip(self.moved, direction.T, strict=True)))
            return self._arranged(moving(self.changes), u, 0.0)

        return self._arranged(probes(self.values), u, 1.0), along

    def _arranged(self, flat: np.ndarray, u: np.ndarray, time: float) -> Both:
        """Return the rows and the frame as arrays with a leading axis of points. `time`: the rate of the time
        coordinate.
        """
        count, rows = self.shape[0], len(self.traced.at.phi)
        value, still, slopes = np.split(flat.T, [count, 2 * count - rows], axis=1)
        slopes = slopes.reshape(-1, *self.shape)
        A, F = slopes[:, :rows], np.pad(slopes[:, rows:], ((0, 0), (1, 0), (1, 0)))
        F[:, 0, 0], F[:, 1:, 0] = time, still
        d = value[:, :rows] - np.einsum("pij,pj->pi", A, u)
        return np.concatenate([d[..., None], A], axis=-1), F


STEP = {"float64": 0.02, "float32": 0.1}  # of central differences along unit directions


def integrable_below() -> float:
    """Return the violation of Frobenius' criterion below which a constraint counts as integrable."""
    return 1e-9 if real_type() == jnp.float64 else 1e-4


def frobenius_violations(scene: Scene) -> dict[str, float]:
    """Return the violation of Frobenius' criterion by each constraint, at six random admissible states.

    The violation is the largest value of the two-form dw on unit velocities that w admits, over all states,
    divided by the size of w and of its derivatives. It is infinite for constraints that are nonlinear in the
    speeds, because these are not differential forms.
    """
    names = structure_of(scene).row_names
    if not names:
        return {}
    t, q, u = (np.asarray(x, float) for x in sample_states(scene, 6))
    rows, x = RowsOverStates(scene), np.concatenate([t[:, None], q], axis=1)
    ((a, F), along), ((other, _), _) = rows(x, u), rows(x, -0.7 * u[:, ::-1])
    A, other = a[..., 1:], other[..., 1:]
    curved = largest(A - other, 2) > 1.5e-8 * (1 + largest(A, 2))
    changes = [along(np.tile(e, (len(x), 1))) for e in np.eye(x.shape[1])]
    da, dF = (np.stack(parts, axis=-1) for parts in zip(*changes, strict=True))
    worst = {
        name: max(_frobenius_violation(*one) for one in zip(a[:, s], da[:, s], F, dF, strict=True))
        for s, name in enumerate(names)
    }
    return {name: float("inf") if curved[:, s].any() else worst[name] for s, name in enumerate(names)}


def _frobenius_violation(a: np.ndarray, da: np.ndarray, F: np.ndarray, dF: np.ndarray) -> float:
    """Return the largest value of dw on unit velocities that w admits, divided by the size of w and of its
    derivatives. The form w is given by `w F = a`; the last axis of `da` and `dF` counts directions in (t, q).

    dw(X, Y) = X a(y) - Y a(x) - w(DF[X] y - DF[Y] x) for fields X = F x, Y = F y with constant x and y
    """
    U, S, Vt = np.linalg.svd(F, full_matrices=False)
    kept = 1e-12 * S[0] < S
    basis, coefficients = U[:, kept], Vt[kept].T / S[kept]  # orthonormal = F coefficients
    w = a @ coefficients
    size = np.linalg.norm(w)
    if size == 0:
        return 0.0
    slopes = coefficients.T @ (da - np.tensordot(basis @ w, dF, 1))
    admitted = np.linalg.svd(w[None])[2][1:].T
    along = admitted.T @ slopes @ basis @ admitted
    return float(largest(along - along.T) / (size + largest(slopes)))


def growth_vector(scene: Scene, depth: int) -> tuple[tuple[int, ...], bool]:
    """Return the growth vector of the admissible velocities at generic states, and whether it is closed.

    Brackets have at most `depth` fields. The vector is closed if longer brackets add no direction or all
    dimensions are reached. It is empty if constraints are nonlinear in the speeds. Of the results at two
    random states, the larger is returned. A bracket adds a direction if its component outside the span of the
    others exceeds 1e-6 (1e-2 in single precision) of its terms.
    """
    structure = structure_of(scene)
    if not structure.affine:
        return (), False
    with_time = structure.timed_kinematics or structure.driven or not structure.homogeneous
    states = zip(*sample_states(scene, 2), strict=True)
    return max(_grow(_Fields(scene, with_time, u), t, q, depth) for t, q, u in states)


def reachable(scene: Scene) -> int:
    """Return the number of coordinates minus the number of quaternion norms, which are always constant."""
    return len(scene.coordinates.default_speeds)


def _grow(fields: "_Fields", t, q, depth: int) -> tuple[tuple[int, ...], bool]:
    """Return the dimensions at one state, and whether they stopped growing."""
    tolerance = 1e-6 if real_type() == jnp.float64 else 1e-2
    x = np.concatenate([t[None], q]) if fields.with_time else q
    generators = np.eye(structure_of(fields.scene).degrees_of_freedom + fields.with_time)
    if not len(generators):
        return (0,), True
    spanned = np.zeros((0, len(x)))
    newest = generators[:, None]  # (brackets, fields in each, coefficients of the generators)
    dimensions: list[int] = []
    size = 0.0
    for length in range(1, depth + 1):
        if length > 1:
            newest = np.array([[first, *rest] for first in generators for rest in newest])
        values, sizes = _brackets(fields, np.tile(x, (len(newest), 1)), newest)
        size = max(size, float(sizes.max()))
        spanned, chosen = extended(spanned, values, tolerance * size)
        if not chosen:
            return tuple(dimensions), True
        dimensions.append(len(spanned) - fields.with_time)
        if dimensions[-1] == reachable(fields.scene):
            return tuple(dimensions), True
        newest = newest[chosen]
    return tuple(dimensions), False


def extended(spanned: np.ndarray, values: np.ndarray, smallest: float) -> tuple[np.ndarray, list[int]]:
    """Extend an orthonormal basis by the independent vectors among `values`, largest first. Return the basis
    and the indices of these vectors.
    """
    chosen: list[int] = []
    while len(chosen) < len(values):
        rest = values - (values @ spanned.T) @ spanned
        rest = rest - (rest @ spanned.T) @ spanned  # twice, for orthogonality to round-off
        lengths = np.linalg.norm(rest, axis=1)
        best = int(np.argmax(lengths))
        if not lengths[best] > smallest:
            break
        spanned = np.vstack([spanned, rest[best] / lengths[best]])
        chosen.append(best)
    return spanned, chosen


def _brackets(fields: "_Fields", x: np.ndarray, parts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return brackets `[X, [Y, ...]]` at points x, and the sizes of their terms.

    `x` has shape (brackets, coordinates). `parts` has shape (brackets, fields in each, generators) and
    contains the coefficients of X, Y, ... in the generators.
    """
    together = 256  # points evaluated in one call
    pieces = [(x[i : i + together], parts[i : i + together]) for i in range(0, len(x), together)]
    values, sizes = zip(*(_brackets_of(fields, some, *fields(some), of) for some, of in pieces), strict=True)
    return np.concatenate(values), np.concatenate(sizes)


def _brackets_of(
    fields: "_Fields", x: np.ndarray, here: np.ndarray, along: Callable, parts: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Compute `_brackets` from the generators at these points (`here`) and a function for their derivatives
    `along` directions.
    """
    first = np.einsum("bng,bg->bn", here, parts[:, 0])
    if parts.shape[1] == 1:
        return first, largest(first, 1)
    rest, _ = _brackets_of(fields, x, here, along, parts[:, 1:])
    if parts.shape[1] == 2:
        along_first = np.einsum("bng,bg->bn", along(first), parts[:, 1])
    else:
        along_first = _differences(lambda x, parts: _brackets(fields, x, parts)[0], x, first, parts[:, 1:])
    along_rest = np.einsum("bng,bg->bn", along(rest), parts[:, 0])
    # [X, Y] = DY X - DX Y
    return along_first - along_rest, largest(along_first, 1) + largest(along_rest, 1)


def _differences(f, x: np.ndarray, direction: np.ndarray, parts: np.ndarray) -> np.ndarray:
    """Return the derivative of `f(x, parts)` along a direction, by central differences of eighth order."""
    length = np.linalg.norm(direction, axis=1, keepdims=True)
    step = STEP[x.dtype.name]
    steps = step * np.array([1, 2, 3, 4, -1, -2, -3, -4], x.dtype)
    weights = np.array([672, -168, 32, -3, -672, 168, -32, 3], x.dtype) / (840 * step)
    unit = direction / np.where(length > 0, length, 1)
    points = x + steps[:, None, None] * unit
    values = f(points.reshape(-1, x.shape[1]), np.tile(parts, (len(steps), 1, 1)))
    return length * np.tensordot(weights, values.reshape(len(steps), *x.shape), 1)


class _Fields:
    """Generators X of the admissible velocities, as columns of rates of q, and their derivatives. If they
    depend on time, they are columns of rates of (t, q), and `(1, X_0)` is the first.
    """

    def __init__(self, scene: Scene, with_time: bool, u):
        self.scene = scene
        self.with_time = with_time
        self.u = np.asarray(u, float)
        self.rows = RowsOverStates(scene)
        # indices in (1, u)
        self.free = [0, *(1 + i for i in structure_of(scene).independent)]
        self.dependent = [k for k in range(1 + len(scene.speed_names)) if k not in self.free]

    def __call__(self, x: np.ndarray) -> tuple[np.ndarray, Callable[[np.ndarray], np.ndarray]]:
        """Return values at many points, and their derivatives as a function of one direction per point."""
        first = 1 - self.with_time
        padded = lambda a: np.pad(a, ((0, 0), (first, 0)))
        (a, F), change_along = self.rows(padded(x), np.tile(self.u, (len(x), 1)))
        length = np.linalg.norm(a[..., 1:], axis=2, keepdims=True)
        scale = 1 / np.where(length > 0, length, 1.0)
        # X = F C,  a C = 0,  a dC = -da C, solved for the dependent speeds
        C = np.zeros((len(x), a.shape[2], len(self.free)))
        C[:, self.free, np.arange(len(self.free))] = 1.0
        C[:, self.dependent] = self._solved(scale * a, scale * a @ C)

        def along(direction: np.ndarray) -> np.ndarray:
            (da, dF), dC = change_along(padded(direction)), np.zeros_like(C)
            dC[:, self.dependent] = self._solved(scale * a, scale * da @ C)
            return (dF @ C + F @ dC)[:, first:, first:]

        return (F @ C)[:, first:, first:], along

    def _solved(self, a: np.ndarray, right: np.ndarray) -> np.ndarray:
        """Return `-a_z^-1 right`, with a_z for the dependent speeds."""
        a_z = a[:, :, self.dependent]
        if a_z.shape[1] == a_z.shape[2]:
            return -np.linalg.solve(a_z, right)
        return -np.linalg.pinv(a_z, rcond=1e-12) @ right
