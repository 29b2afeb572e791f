"""Methods as a first attempt would write them, without the guards of the engine: fixed partition, plain Schur
complement, ridge, raw bases.

They see the same `M udot + h = Q + A' lambda`, `A udot = -drift` as the engine, in raw units, and are
integrated by Runge and Kutta's classical method with fixed steps. They report nothing: what comes out is
right, wrong or NaN.
"""

from dataclasses import dataclass
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jourdain_jax.equations import constraint_rows, coordinate_rates
from jourdain_jax.equations.virtual_power import equations_and_rows
from jourdain_jax.program.eager import eager_if_concrete


@dataclass(frozen=True)
class Static:
    """What such a method settles once, at the start: rank, and which rows and columns to eliminate."""

    rank: int
    rows: tuple[int, ...]
    dependent: tuple[int, ...]


def fixed_point(scene, q, u, t=0.0, independent=None) -> Static:
    """Rank at the start, and the partition that is best there (or the one asked for)."""
    A = np.asarray(constraint_rows(scene, t, q, u).A, float)
    cut = 4096 * float(jnp.finfo(q.dtype).eps) * np.linalg.norm(A) if A.size else 0.0
    rank = int(np.linalg.matrix_rank(A, tol=cut)) if A.size else 0
    rows = _pivots(A.T, rank)
    names = scene.speed_names.entries
    dependent = (
        _pivots(A[list(rows)], rank)
        if independent is None
        else tuple(i for i, name in enumerate(names) if name not in independent)
    )
    return Static(rank, rows, tuple(sorted(dependent)))


def _pivots(A, count):
    """Columns of A that greedy elimination takes first."""
    A, chosen = np.array(A, float), []
    for _ in range(count):
        k = int(np.argmax(np.sum(A**2, axis=0)))
        e = A[:, k] / np.linalg.norm(A[:, k])
        A -= np.outer(e, e @ A)
        A[:, k] = 0.0
        chosen.append(k)
    return tuple(chosen)


def _partition(A, b, static: Static):
    """C and c of `u = C y + c`, so that `A u + b = 0`, by the partition settled at the start."""
    n, dependent = A.shape[1], list(static.dependent)
    independent = [i for i in range(n) if i not in dependent]
    A, b = A[np.array(static.rows, int)], b[np.array(static.rows, int)]
    B = jnp.linalg.solve(
        A[:, np.array(dependent, int)],
        jnp.concatenate([-A[:, np.array(independent, int)], -b[:, None]], axis=1),
    )
    order = np.argsort([*independent, *dependent])
    C = jnp.concatenate([jnp.eye(len(independent)), B[:, :-1]])[order]
    return C, jnp.concatenate([jnp.zeros(len(independent)), B[:, -1]])[order]


def _fixed_partition(M, f, A, b, static: Static):
    C, c = _partition(A, -b, static)
    return C @ jnp.linalg.solve(C.T @ M @ C, C.T @ (f - M @ c)) + c


def _by_schur(solve):
    """Multipliers first, by a solution of `A M^-1 A' lambda = b - A M^-1 f`."""

    def udot(M, f, A, b, static):
        a, W = jnp.linalg.solve(M, f), jnp.linalg.solve(M, A.T)
        return a + W @ solve(A @ W, b - A @ a)

    return udot


def _kkt(M, f, A, b, static):
    m = A.shape[0]
    return jnp.linalg.solve(jnp.block([[M, -A.T], [A, jnp.zeros((m, m))]]), jnp.concatenate([f, b]))[
        : M.shape[0]
    ]


def svd_basis(A, rank):
    """Null space as LAPACK gives it, derivative and all."""
    return jnp.linalg.svd(A, full_matrices=True)[2][rank:].T


def qr_basis(A, rank):
    """Null space from an unpivoted QR decomposition."""
    return jnp.linalg.qr(A.T, mode="complete")[0][:, rank:]


def _on_basis(basis):
    """Accelerations along a null space, beside the smallest ones that meet the rows."""

    def udot(M, f, A, b, static):
        Z, particular = basis(A, static.rank), jnp.linalg.pinv(A) @ b
        return particular + Z @ jnp.linalg.solve(Z.T @ M @ Z, Z.T @ (f - M @ particular))

    return udot


ACCELERATIONS = {
    "fixed partition": _fixed_partition,
    "Schur, Cholesky": _by_schur(lambda S, r: jax.scipy.linalg.cho_solve(jax.scipy.linalg.cho_factor(S), r)),
    "KKT, LU": _kkt,
    "pinv, 1e-10": _by_schur(lambda S, r: jnp.linalg.pinv(S, rtol=1e-10) @ r),
    "ridge 1e-6": _by_schur(lambda S, r: jnp.linalg.solve(S + 1e-6 * jnp.eye(len(r)), r)),
    "raw SVD basis": _on_basis(svd_basis),
    "raw QR basis": _on_basis(qr_basis),
}
REDUCED_STATE = {
    "fixed partition": _partition,
    "speeds in SVD basis": lambda A, b, static: (svd_basis(A, static.rank), -jnp.linalg.pinv(A) @ b),
    "speeds in QR basis": lambda A, b, static: (qr_basis(A, static.rank), -jnp.linalg.pinv(A) @ b),
}
SPEEDS_IN_BASIS = ("speeds in SVD basis", "speeds in QR basis")


def accelerations(name, scene, static: Static, t, q, u):
    """udot by the naive method `name`."""
    equations, rows = equations_and_rows(scene, t, q, u)
    return _solved(name, static, equations.M, equations.Q - equations.h, rows.A, -rows.drift)


@eager_if_concrete
def _solved(name, static: Static, M, f, A, b):
    return jnp.linalg.solve(M, f) if A.shape[0] == 0 else ACCELERATIONS[name](M, f, A, b, static)


def motion(name, scene, static: Static, q, u, ts, steps, *, alone=False):
    """q and u at `ts` (the first is the start) with `steps` equal steps from each time to the next.

    `alone`: a program of its own, for derivatives: where methods share one, a method without a derivative
    would take it from all.
    """
    program, names = (
        (_in_basis, tuple(REDUCED_STATE))
        if name in REDUCED_STATE
        else (_all_in_one, (name,) if alone else tuple(ACCELERATIONS))
    )
    return program(scene, jnp.asarray(names.index(name)), q, u, jnp.asarray(ts), static, steps, names)


_STAGES = (
    (0.0, 1 / 6),
    (0.5, 1 / 3),
    (0.5, 1 / 3),
    (1.0, 1 / 6),
)  # how far each stage reaches along the slope before it, and its weight


def _plus(y, factor, slope):
    return jax.tree.map(lambda a, b: a + factor * b, y, slope)


def _runge_kutta(rates, y, ts, steps):
    """Classical fourth order, states at all `ts`."""

    def interval(y, ends):
        h = (ends[1] - ends[0]) / steps

        def step(i, y):
            t = ends[0] + i * h

            def stage(carry, weights):
                slope, total = carry
                reach, share = weights
                slope = rates(t + reach * h, _plus(y, reach * h, slope))
                return (slope, _plus(total, share * h, slope)), None

            return jax.lax.scan(stage, (jax.tree.map(jnp.zeros_like, y), y), jnp.asarray(_STAGES, h.dtype))[
                0
            ][1]

        y = jax.lax.fori_loop(0, steps, step, y)
        return y, y

    _, ys = jax.lax.scan(interval, y, (jnp.stack([ts[:-1], ts[1:]], axis=1)))
    return jax.tree.map(lambda first, rest: jnp.concatenate([first[None], rest]), y, ys)


@partial(jax.jit, static_argnames=("static", "steps", "names"))
def _all_in_one(scene, index, q, u, ts, static: Static, steps, names):
    def rates(t, y):
        q, u = y
        equations, rows = equations_and_rows(scene, t, q, u)
        problem = (equations.M, equations.Q - equations.h, rows.A, -rows.drift)
        if rows.A.shape[0] == 0:
            return coordinate_rates(scene, t, q, u), jnp.linalg.solve(problem[0], problem[1])
        branches = [lambda p, name=name: ACCELERATIONS[name](*p, static) for name in names]
        return coordinate_rates(scene, t, q, u), jax.lax.switch(index, branches, problem)

    return _runge_kutta(rates, (q, u), ts, steps)


@partial(jax.jit, static_argnames=("static", "steps", "names"))
def _in_basis(scene, index, q, u, ts, static: Static, steps, names):
    """A state of as many speeds s as there are freedoms: `u = Z s`, `sdot = Z+ (udot - Zdot s)`, Zdot by a
    difference.

    Z is whatever basis the library returns, or C of the fixed partition, for which Z+ just picks the
    independent speeds.
    """
    small, none = float(np.sqrt(jnp.finfo(q.dtype).eps)), jnp.zeros(u.shape)
    independent = np.array([i for i in range(u.shape[0]) if i not in static.dependent], int)

    def rows_at(t, q):
        rows = constraint_rows(scene, t, q, none)
        # beyond that LAPACK's singular values of float32 may never converge: a motion that far off is lost
        A = jnp.where(
            jnp.max(jnp.abs(rows.A), initial=0.0) < 1e-3 * float(np.sqrt(jnp.finfo(q.dtype).max)),
            rows.A,
            jnp.nan,
        )
        return A, rows.phi - A @ none

    @eqx.filter_jit  # one copy of it
    def basis(t, q):
        """Z and c of `u = Z s + c`."""
        return jax.lax.switch(
            index,
            [lambda A, b, name=name: REDUCED_STATE[name](A, b, static) for name in names],
            *rows_at(t, q),
        )

    def rates(t, y):
        q, s = y
        Z, c = basis(t, q)
        u = Z @ s + c
        qdot = coordinate_rates(scene, t, q, u)
        udot = accelerations("pinv, 1e-10", scene, static, t, q, u)
        Z1, c1 = basis(t + small, q + small * qdot)
        by_basis = Z.T @ (udot - ((Z1 - Z) @ s + c1 - c) / small)  # Z'Z = 1 for orthonormal bases
        return qdot, jnp.where(index == names.index("fixed partition"), udot[independent], by_basis)

    Z, c = basis(ts[0], q)
    qs, ss = _runge_kutta(rates, (q, jnp.linalg.pinv(Z) @ (u - c)), ts, steps)
    return qs, jax.vmap(lambda t, q, s: basis(t, q)[0] @ s + basis(t, q)[1])(ts, qs, ss)
