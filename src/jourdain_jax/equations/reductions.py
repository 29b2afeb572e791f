"""Reductions: interchangeable methods that compute accelerations from virtual power and constraints.

    M udot + h = Q + A' lambda,   A udot = -drift

- `Privileged`: independent and dependent speeds, `zdot = B ydot + b` (Appell, Kane; eqs. (25)-(31), (41))
- `NullSpaceQR`, `NullSpaceSVD`: `udot = udot_p + Z zeta`, `(Z'MZ) zeta = Z'(Q - h - M udot_p)`
- `Multipliers`: the saddle-point (KKT) system, (68)-(70)
- `UdwadiaKalaba`: Gauss's principle of least constraint, `min |udot - M^-1 (Q - h)|_M` over `A udot = -drift`
- `GibbsAppell`: Hessian of the Gibbs function over the independent accelerations (in `gibbs_appell.py`)

All agree to round-off where they apply (`applicable`). If a free direction has no inertia, accelerations are
NaN, except by `Multipliers`, whose test is too coarse near a loss of rank. All allow dependent constraints:
the rank is determined at every state, and the multipliers have minimum norm.

Scaling before rank decisions: speeds by their inertia, constraint rows by their length.

    M^ = c M c,  f^ = c (Q - h),  A^ = d A c,  b^ = -d drift,   udot = c w
    c_i = M_ii^(-1/2),   d_s = 1/max(|A_s c|, l_s)        l_s: typical length of row s (`structure_of`)

A row that vanishes at a configuration has only round-off left; l_s keeps it from being scaled up. The scales
are constant under differentiation, because the accelerations do not depend on them.
"""

import abc

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jourdain_jax.calculus.matrices import (
    null_space_qr,
    null_space_svd,
    numerical_rank,
    pivots_qr,
    present,
    pseudo_inverse,
    singular_values,
)
from jourdain_jax.calculus.reals import Flag, PerRow, Scalar, Speeds, rank_cutoff
from jourdain_jax.equations.rows import ConstraintRows, UsualRows
from jourdain_jax.equations.virtual_power import UnconstrainedEquations


class ScaledProblem(eqx.Module):
    """`M w + A' mu = f`, `A w = b` in scaled speeds and rows."""

    M: Float[Array, "speeds speeds"]
    f: Speeds
    A: Float[Array, "rows speeds"]
    b: PerRow
    c: Speeds
    d: PerRow
    usual: UsualRows | None


def speed_scale(M: Float[Array, "speeds speeds"]) -> Speeds:
    """Return `M_ii^(-1/2)`, and 1 for a speed without inertia."""
    diagonal = jax.lax.stop_gradient(jnp.diagonal(M))
    heavy = diagonal > 0
    return jnp.where(heavy, 1 / jnp.sqrt(jnp.where(heavy, diagonal, 1)), 1)


def row_scale(
    A: Float[Array, "rows speeds"], typical: Float[Array | np.ndarray, "rows"] | None = None
) -> PerRow:
    """Return the reciprocal length of each row, or of its `typical` length if that is longer; 1 for a zero
    row without a typical length.

    So a row that becomes shorter than its typical length has a length below 1 after scaling. It counts as
    zero once it is mere round-off relative to its typical length.
    """
    length = jnp.sqrt(jnp.sum(jax.lax.stop_gradient(A) ** 2, axis=1))
    if typical is not None:
        length = jnp.maximum(length, jnp.asarray(typical, length.dtype))
    return jnp.where(length > 0, 1 / jnp.where(length > 0, length, 1), 1)


def scaled(equations: UnconstrainedEquations, rows: ConstraintRows) -> ScaledProblem:
    """Return the scaled problem of one state."""
    c = speed_scale(equations.M)
    d = row_scale(rows.A * c, None if rows.usual is None else rows.usual.lengths)
    return ScaledProblem(
        c[:, None] * equations.M * c,
        c * (equations.Q - equations.h),
        d[:, None] * rows.A * c,
        -d * rows.drift,
        c,
        d,
        rows.usual,
    )


# Least pivot of the scaled A_z. Round-off grows as the inverse square of the pivot: at 1e-2, accelerations
# agree to 1e-12 with the other reductions.
APPLICABLE_PIVOT = 1e-2  # numerics
SMALLEST_PIVOT = 1e-3  # numerics: least pivot for independent speeds as the state of a simulation


class Reduction(eqx.Module):
    """A method that solves the equations and constraints of one state for accelerations."""

    name: eqx.AbstractClassVar[str]

    @abc.abstractmethod
    def solve(self, problem: ScaledProblem) -> tuple[Speeds, Scalar, Flag]:
        """Return scaled accelerations of the scaled `problem`, the smallest pivot of the reduction, and
        whether it applies.
        """


class Reduced(eqx.Module):
    """The result of a reduction, before multipliers and diagnostics."""

    udot: Speeds
    constraint_force: Speeds  # A' lambda = M udot + h - Q
    pivot: Scalar
    applicable: Flag


def reduce(reduction: Reduction, equations: UnconstrainedEquations, rows: ConstraintRows) -> Reduced:
    """Return accelerations and constraint force by the given reduction."""
    problem = scaled(equations, rows)
    w, pivot, applicable = reduction.solve(problem)
    return reduced(problem.c * w, pivot, applicable, equations)


def reduced(udot, pivot, applicable, equations: UnconstrainedEquations) -> Reduced:
    """Return accelerations that are already known, with their constraint force."""
    # A' lambda = M udot + h - Q
    return Reduced(udot, equations.M @ udot + equations.h - equations.Q, pivot, applicable)


def smallest_that_counts(sigma: Float[Array, "values"], usual: UsualRows | None = None) -> Scalar:
    """Return the last singular value within the usual rank, which vanishes at a loss of rank. If the rank is
    unknown, return the smallest value above the cut-off, or 1 if there is none.
    """
    if sigma.shape[0] == 0:
        return jnp.ones((), sigma.dtype)
    if usual is not None:
        return jnp.min(jnp.where(jnp.arange(sigma.shape[0]) < usual.rank, sigma, 1.0), initial=1.0)
    counts = sigma > rank_cutoff(sigma.dtype) * sigma[0]
    return jnp.min(jnp.where(counts, sigma, jnp.inf), initial=1.0)


def cholesky(M: Float[Array, "n n"]) -> tuple[Float[Array, "n n"], Flag]:
    """Return the lower Cholesky factor, and whether M is positive definite. If it is not, the factor is the
    identity.
    """
    factor = jnp.linalg.cholesky(jax.lax.stop_gradient(M))
    # a pivot at round-off, of either sign, means a singular matrix
    definite = jnp.all(jnp.isfinite(factor)) & (
        jnp.min(jnp.diagonal(factor), initial=1.0) ** 2 > 16 * M.shape[0] * jnp.finfo(M.dtype).eps
    )
    usable = definite | ~jnp.all(jnp.isfinite(M))  # keep NaN in M visible
    return jnp.linalg.cholesky(jnp.where(usable, M, jnp.eye(M.shape[0], dtype=M.dtype))), definite


def solve_definite(M: Float[Array, "n n"], f: Float[Array, "n"]) -> tuple[Float[Array, "n"], Flag]:
    """Return `M^-1 f` by Cholesky, and whether M is positive definite. If it is not, the result is NaN."""
    factor, definite = cholesky(M)
    return jnp.where(definite, jax.scipy.linalg.cho_solve((factor, True), f), jnp.nan), definite


class Privileged(Reduction):
    """Appell's equations in independent speeds, the paper's privileged velocities. The speeds `independent`
    are free, and the constraints determine the others.

        udot = C yddot + c        y and z in the scene's order, with zdot = B ydot + b, B = -A_z^-1 A_y
        C' (M (C yddot + c) + h - Q) = 0

    Rows that are redundant at every state are allowed: A_z is then tall, with full column rank. The reduction
    does not apply where A_z loses rank.
    """

    independent: tuple[int, ...] = eqx.field(static=True)
    name = "privileged"

    def solve(self, problem):
        split = Partition(problem.A, self.independent)
        return (*appell(problem.M, problem.f, split.C, split.particular(problem.b), split.pivot()),)


def appell(M, f, C, c, pivot):
    """Return `udot = C yddot + c` from `C' M C yddot = C' (f - M c)`, the pivot, and whether the result is
    valid (eq. (41)).
    """
    yddot, definite = solve_definite(C.T @ M @ C, C.T @ (f - M @ c))
    return C @ yddot + c, pivot, definite & (pivot > APPLICABLE_PIVOT)


class Partition(eqx.Module):
    """The partition into independent and dependent speeds, y and z: `A u = b` solved as `u = C y + c` (eqs.
    (25)-(31)).

    `B = -A_z^-1 A_y`. A_z is tall if rows are redundant at every state.
    """

    A: Float[Array, "rows speeds"]
    independent: tuple[int, ...] = eqx.field(static=True)

    @property
    def dependent(self) -> tuple[int, ...]:
        """Return indices of the dependent speeds."""
        return tuple(i for i in range(self.A.shape[1]) if i not in self.independent)

    def all_from(
        self, y: Float[Array, "freedoms *k"], z: Float[Array, "rank *k"]
    ) -> Float[Array, "speeds *k"]:
        """Return all speeds in the scene's order, from the independent and the dependent ones."""
        order = np.argsort([*self.independent, *self.dependent])
        return jnp.concatenate([y, z])[order]

    @property
    def C(self) -> Float[Array, "speeds freedoms"]:
        """Return C, the derivative of all speeds with respect to the independent ones."""
        B = self._solved(-self.A[:, np.array(self.independent, int)])
        return self.all_from(jnp.eye(len(self.independent), dtype=B.dtype), B)

    def particular(self, b: PerRow) -> Speeds:
        """Return `c`, the solution of `A c = b` with zero independent speeds."""
        return self.all_from(jnp.zeros(len(self.independent), b.dtype), self._solved(b[:, None])[:, 0])

    def pivot(self) -> Scalar:
        """Return the smallest singular value of A_z; 1 without rows."""
        A_z = self._A_z
        if not self.dependent:
            return jnp.ones((), A_z.dtype)
        return singular_values(A_z)[-1] if A_z.shape[0] >= A_z.shape[1] else jnp.zeros((), A_z.dtype)

    def signed_pivot(self) -> Scalar:
        """Return the pivot with the sign of det A_z if A_z is square. If the sign changes along a motion, A_z
        was singular in between.
        """
        return self.pivot() * self.orientation()

    def orientation(self) -> Scalar:
        """Return the sign of det A_z, or 1 if A_z is not square; it has no derivative."""
        if self.A.shape[0] == len(self.dependent) > 0:
            return jnp.linalg.slogdet(jax.lax.stop_gradient(self._A_z))[0]
        return jnp.ones((), self.A.dtype)

    @property
    def _A_z(self):
        return self.A[:, np.array(self.dependent, int)]

    def _solved(self, right: Float[Array, "rows k"]) -> Float[Array, "rank k"]:
        """Return `A_z^-1 right`."""
        A_z = self._A_z
        if not self.dependent:
            return jnp.zeros((0, right.shape[1]), right.dtype)
        return jnp.linalg.solve(A_z, right) if A_z.shape[0] == A_z.shape[1] else pseudo_inverse(A_z) @ right


def _by_null_space(problem: ScaledProblem, Z, cutoff: float | None = None):
    # A udot_p = -drift; (Z' M Z) zeta = Z' (Q - h - M udot_p); absent columns of Z get a unit diagonal and a
    # zero right-hand side
    particular = pseudo_inverse(problem.A, cutoff) @ problem.b
    S = Z.T @ problem.M @ Z + jnp.diag(jnp.where(present(Z), 0.0, 1.0).astype(Z.dtype))
    zeta, definite = solve_definite(S, Z.T @ (problem.f - problem.M @ particular))
    return particular + Z @ zeta, definite


class NullSpaceQR(Reduction):
    """Null space of the rows from a column-pivoted QR decomposition: `udot = udot_p + Z zeta`,
    `(Z'MZ) zeta = Z'(Q - h - M udot_p)`.

    It applies wherever `Z'MZ` is positive definite. The result does not depend on the choice of Z, since
    `F - m a` is orthogonal to the whole null space, (71)-(73). `cutoff`: relative size of singular values
    below which scaled rows count as dependent (default: round-off, `rank_cutoff`).
    """

    cutoff: float | None = eqx.field(static=True, default=None)
    name = "null space (QR)"

    def solve(self, problem):
        w, definite = _by_null_space(problem, null_space_qr(problem.A, self.cutoff), self.cutoff)
        return w, smallest_that_counts(pivots_qr(problem.A), problem.usual), definite


class NullSpaceSVD(Reduction):
    """Null space of the rows from their singular value decomposition; otherwise as `NullSpaceQR`."""

    name = "null space (SVD)"

    def solve(self, problem):
        w, definite = _by_null_space(problem, null_space_svd(problem.A))
        return w, jnp.ones((), w.dtype), definite


def _refined(inverse, A, b):
    """Return `A+ b` with one step of iterative refinement, which recovers the two digits that an explicit
    inverse loses.
    """
    x = inverse @ b
    return x + inverse @ (b - A @ x)


class Multipliers(Reduction):
    """Lagrange multipliers: the saddle-point system `[[M, -A'], [A, 0]] [udot, lambda] = [f, b]` with
    `f = Q - h` and `b = -drift`, solved by a pseudo-inverse for dependent rows; (68)-(70).

    M may be singular if every admissible velocity has inertia.
    """

    name = "multipliers (KKT)"

    def solve(self, problem):
        n, m = problem.M.shape[0], problem.A.shape[0]
        saddle = jnp.block([[problem.M, -problem.A.T], [problem.A, jnp.zeros((m, m), problem.A.dtype)]])
        sigma = singular_values(saddle)
        rows_rank = numerical_rank(singular_values(problem.A))
        w = _refined(pseudo_inverse(saddle), saddle, jnp.concatenate([problem.f, problem.b]))
        return w[:n], jnp.ones((), w.dtype), numerical_rank(sigma) == n + rows_rank


class UdwadiaKalaba(Reduction):
    """Gauss's least constraint: `udot = a + M^-1/2 (A M^-1/2)+ (b - A a)` with `a = M^-1 f`, `f = Q - h`,
    `b = -drift`, for positive definite M.

    Source: F. E. Udwadia and R. E. Kalaba, Proc. R. Soc. A 439 (1992) 407, here with the Cholesky factor
    instead of the square root.
    """

    name = "Udwadia-Kalaba (Gauss)"

    def solve(self, problem):
        L, definite = cholesky(problem.M)
        both = jnp.column_stack([problem.f, problem.A.T])
        both = jax.scipy.linalg.solve_triangular(L, both, lower=True).T
        free, weighted = both[0], both[1:]  # L' a and A L'^-1
        # rescale to the lengths in A, so that a vanishing row stays small
        lengths, by_mass = (
            jnp.sqrt(jnp.sum(jax.lax.stop_gradient(rows) ** 2, axis=1)) for rows in (problem.A, weighted)
        )
        d = jnp.where(by_mass > 0, lengths / jnp.where(by_mass > 0, by_mass, 1.0), 1.0)
        weighted = d[:, None] * weighted
        x = free + _refined(pseudo_inverse(weighted), weighted, d * problem.b - weighted @ free)
        return (
            jnp.where(definite, jax.scipy.linalg.solve_triangular(L.T, x, lower=False), jnp.nan),
            jnp.ones((), L.dtype),
            definite,
        )
