"""Least squares with unknowns that all runs share and unknowns of one run each: an arrow-shaped problem, kept as one small triangle per run.

minimise sum_i |r_i + J_i dx_i + S_i ds|^2 + lambda |D d|^2          run i: its own unknowns x_i, the shared ones s

    [J_i S_i r_i] = Q_i [ T_i ; 0 ]          one QR factorisation per run: T_i is all that is kept of its samples
    x_i goes out by a QR factorisation of the first columns of T_i, below them sqrt(lambda) D_i: the Schur complement, without squaring anything
    s by the singular values of what is left of all runs; directions whose singular value is below a cut-off stay as they are

Time and memory grow linearly with the number of runs. A leading axis `members` holds problems of equal shape. All on NumPy.
Source: G. H. Golub and V. Pereyra, Inverse Problems 19 (2003) R1; J. J. Moré, Lecture Notes in Mathematics 630 (1978) 105 (the scaling D).
"""

from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from jaxtyping import Float, Shaped


def triangle(whole: Float[np.ndarray, "*batch samples width"]) -> Float[np.ndarray, "*batch width width"]:
    """T of [J r]; with entries that are not finite where those of [J r] are not."""
    width = whole.shape[-1]
    if whole.shape[-2] < width:
        whole = np.concatenate([whole, np.zeros((*whole.shape[:-2], width - whole.shape[-2], width))], axis=-2)
    reflected, _ = np.linalg.qr(whole, mode="raw")  # as LAPACK leaves it: the transposed triangle, and reflectors beyond its diagonal
    return reflected[..., :width].swapaxes(-1, -2) * _upper(width)


@lru_cache(maxsize=64)
def _upper(width: int) -> Float[np.ndarray, "width width"]:
    return np.triu(np.ones((width, width)))


@dataclass(frozen=True)
class Arrow:
    """A linearised problem: of each run the rows of T that hold its own unknowns, and of all runs together the rest as one triangle."""

    local: Float[np.ndarray, "members runs local width"]
    shared: Float[np.ndarray, "members rows columns"]
    scores: Float[np.ndarray, "members runs _"]  # of each run: gradient in the shared unknowns, its own ones being fitted

    @property
    def arrays(self) -> tuple[np.ndarray, ...]:
        """All that it holds, with the axis of members first."""
        return self.local, self.shared, self.scores

    @property
    def counts(self) -> tuple[int, int, int]:
        """Numbers of runs, of unknowns of each run, and of shared unknowns."""
        runs, local = self.local.shape[1:3]
        return runs, local, self.shared.shape[-1] - 1

    def at(self, members) -> "Arrow":
        """That of some members."""
        return Arrow(*(x[members] for x in self.arrays))

    def scaled(self, size: Float[np.ndarray, "members unknowns"]) -> "Arrow":
        """This arrow in unknowns divided by `size`."""
        shared, local = self.split(size)
        whole = np.concatenate([local, np.broadcast_to(shared[:, None], (*local.shape[:2], shared.shape[1])), np.ones((*local.shape[:2], 1))], axis=-1)
        return Arrow(
            self.local * whole[:, :, None], self.shared * np.concatenate([shared, np.ones((len(shared), 1))], axis=-1)[:, None], self.scores * shared[:, None]
        )

    def split(self, x: Shaped[np.ndarray, "members unknowns"]) -> tuple[np.ndarray, np.ndarray]:
        """Shared unknowns (members, shared), and those of the runs (members, runs, local)."""
        runs, local, shared = self.counts
        return x[:, :shared], x[:, shared:].reshape(len(x), runs, local)

    @cached_property
    def column_norms(self) -> Float[np.ndarray, "members unknowns"]:
        """Length of each column of the Jacobian."""
        _, m, _ = self.counts
        squares = np.einsum("bij,bij->bj", self.shared[..., :-1], self.shared[..., :-1])
        if not m:
            return np.sqrt(squares)
        of_runs = np.sum(self.local[..., :-1] ** 2, axis=2)
        return np.sqrt(np.concatenate([squares + np.sum(of_runs[..., m:], axis=1), of_runs[..., :m].reshape(len(of_runs), -1)], axis=1))

    @cached_property
    def gradient(self) -> Float[np.ndarray, "members unknowns"]:
        """`J' r`."""
        _, m, _ = self.counts
        found = (self.shared[:, None, :, -1] @ self.shared[..., :-1])[:, 0]
        if not m:
            return found
        of_runs = (self.local[..., None, :, -1] @ self.local[..., :-1])[..., 0, :]
        return np.concatenate([found + np.sum(of_runs[..., m:], axis=1), of_runs[..., :m].reshape(len(of_runs), -1)], axis=1)

    def moved(self, d: Float[np.ndarray, "members unknowns"]) -> "Arrow":
        """Close by, with the residuals that it has there to first order. The scores stay."""
        shared, own = self.split(d)
        _, m, _ = self.counts
        local, rest = self.local.copy(), self.shared.copy()
        rest[..., -1] += (rest[..., :-1] @ shared[..., None])[..., 0]
        if m:
            local[..., -1] += (local[..., :m] @ own[..., None] + local[..., m:-1] @ shared[:, None, :, None])[..., 0]
        return Arrow(local, rest, self.scores)

    def change(self, d: Float[np.ndarray, "members unknowns"]) -> Float[np.ndarray, "members"]:
        """`|J d|^2`."""
        shared, own = self.split(d)
        _, m, _ = self.counts
        moved = (self.shared[..., :-1] @ shared[..., None])[..., 0]
        found = np.einsum("bi,bi->b", moved, moved)
        if not m:
            return found
        of_runs = self.local[..., :m] @ own[..., None] + self.local[..., m:-1] @ shared[:, None, :, None]
        return found + np.sum(of_runs**2, axis=(1, 2, 3))

    def step(self, damping: Float[np.ndarray, "members"], D, held, moved, cutoff) -> Float[np.ndarray, "members unknowns"]:
        """The damped step; unknowns that are `held` move by `moved`. D: (members, unknowns), positive."""
        _, m, _ = self.counts
        local, shared, any_held = self.local, self.shared, held.any()
        if any_held:
            held_s, held_l = self.split(held)
            ended = self.moved(np.where(held, moved, 0.0))
            local, shared = ended.local, ended.shared
            local[..., :m] *= ~held_l[:, :, None]
            local[..., m:-1] *= ~held_s[:, None, None]
            shared[..., :-1] *= ~held_s[:, None]
        if not m:
            ds = by_singular_values(shared, D, damping, cutoff)
        else:
            D_s, D_l = self.split(D)
            upper, rest = eliminated(local, np.sqrt(damping)[:, None, None] * D_l)
            ds = by_singular_values(np.concatenate([shared, rest], axis=1), D_s, damping, cutoff)
            right = -(upper[..., -1:] + upper[..., m:-1] @ ds[:, None, :, None])
            ds = np.concatenate([ds, np.linalg.solve(upper[..., :m], right).reshape(len(ds), -1)], axis=1)
        return np.where(held, moved, ds) if any_held else ds


def with_prior(
    arrow: Arrow, residual: Float[np.ndarray, "members unknowns"], mean: np.ndarray, sigma: np.ndarray, M: Float[np.ndarray, "shared shared"]
) -> Arrow:
    """Adds one `residual` (theta - mean) / sigma for each unknown that has a mean (not NaN); those of shared ones times M. The scores stay."""
    slope = np.broadcast_to(np.where(np.isnan(mean), 0.0, 1 / sigma), residual.shape)
    (r_s, r_l), (J_s, J_l) = arrow.split(residual), arrow.split(slope)
    members, runs, m = r_l.shape
    every, M = M, np.eye(J_s.shape[1])  # where there is one run, its own unknowns count as shared, after the others
    M[: len(every), : len(every)] = every
    rows = np.zeros((members, runs, m, arrow.local.shape[-1]))
    rows[..., range(m), range(m)], rows[..., -1] = J_l, r_l
    R = np.linalg.qr(np.concatenate([arrow.local, rows], axis=2), mode="r") if m else arrow.local
    below = [R[:, :, m:, m:].reshape(members, -1, arrow.shared.shape[-1]), np.concatenate([M * J_s[:, None], M @ r_s[..., None]], axis=-1)]
    return Arrow(R[:, :, :m], np.linalg.qr(np.concatenate([arrow.shared, *below], axis=1), mode="r"), arrow.scores)


def eliminated(local: np.ndarray, below: Float[np.ndarray, "members runs local"]) -> tuple[np.ndarray, np.ndarray]:
    """The rows that give a run's own unknowns in terms of the shared ones, and those that are left for the latter, all runs one after another.

    `below`: the diagonal of the rows that are added.
    """
    members, runs, m, width = local.shape
    if not m:
        return local, np.zeros((members, 0, width))
    added = np.concatenate([below[..., None] * np.eye(m), np.zeros((members, runs, m, width - m))], axis=-1)
    R = np.linalg.qr(np.concatenate([local, added], axis=2), mode="r")
    return R[:, :, :m], R[:, :, m:, m:].reshape(members, -1, width - m)


def by_singular_values(shared: np.ndarray, D: np.ndarray, damping: Float[np.ndarray, "members"], cutoff: float) -> Float[np.ndarray, "members shared"]:
    """The damped step of the shared unknowns, in unknowns times D: (S^2 + lambda) ds = - S U' c; what does not show stays as it is."""
    U, S, Vt = np.linalg.svd(shared[..., :-1] / D[:, None], full_matrices=False)
    hidden = S[:, :1] * cutoff >= S  # the first is the largest
    weight = S / (S * S + damping[:, None])
    weight[hidden] = 0.0
    return -((weight * (shared[:, None, :, -1] @ U)[:, 0])[:, None] @ Vt)[:, 0] / D


def arrow(triangles: Float[np.ndarray, "members runs width width"], local: int) -> Arrow:
    """Makes an arrow of the triangles of all runs, with `local` unknowns of their own in the first columns."""
    members, runs, width, _ = triangles.shape
    if runs == 1 and not local:
        return Arrow(triangles[:, :, :0], triangles[:, 0], np.zeros((members, 1, width - 1)))  # there is nothing to compare one run with
    rest = triangles[:, :, local:, local:]
    scores = (rest[..., None, :, -1] @ rest[..., :-1])[..., 0, :]
    together = rest.reshape(members, runs * (width - local), width - local)
    return Arrow(triangles[:, :, :local], np.linalg.qr(together, mode="r"), scores)
