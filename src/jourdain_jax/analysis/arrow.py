"""Least squares with unknowns that all runs share and unknowns of one run, or of one piece of a run, each: an arrow, through which a chain may go.

minimise sum_i |r_i + J_i dx_i + S_i ds|^2 + sum_i |c_i + B_i dx_i + A_i dx_i-1 + C_i ds|^2 + lambda |D d|^2
         piece i: its own unknowns x_i, the shared ones s; its join with the piece before, if it has one

    [J_i S_i r_i] = Q_i [ T_i ; 0 ]          one QR factorisation per piece: T_i is all that is kept of its samples
    from the last pieces of the runs to their first, x_i goes out by a QR factorisation of
    [ B_i A_i C_i c_i ; T_i ; sqrt(lambda) D_i ; what the piece after it left ]:     the Schur complement, without squaring anything
    s by the singular values of what is left of all runs; directions whose singular value is below a cut-off stay as they are

A run that is not cut is one piece without a join. Time and memory grow linearly with the number of pieces. A leading axis `members` holds problems of equal
shape. All on NumPy.
Source: G. H. Golub and V. Pereyra, Inverse Problems 19 (2003) R1; J. J. Moré, Lecture Notes in Mathematics 630 (1978) 105 (the scaling D); G. J. Bierman,
Factorization Methods for Discrete Sequential Estimation (1977), chapter VI (square-root information, the chain).
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from jaxtyping import Bool, Float, Shaped


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
    """A linearised problem. Unknowns are (shared, own of piece 0, own of piece 1, ...)."""

    local: Float[np.ndarray, "members pieces local width"]  # the rows of T that hold own unknowns
    shared: Float[np.ndarray, "members rows columns"]  # of all pieces together the rest, as one triangle
    scores: Float[np.ndarray, "members pieces _"]  # of each: gradient in the shared unknowns, its own ones being fitted
    joins: Float[np.ndarray, "members pieces joined both"] | None = None  # [B A C c]; zero of the first piece of a run

    @property
    def arrays(self) -> tuple[np.ndarray, ...]:
        """All that it holds, with the axis of members first."""
        return (self.local, self.shared, self.scores) if self.joins is None else (self.local, self.shared, self.scores, self.joins)

    @property
    def counts(self) -> tuple[int, int, int]:
        """Numbers of pieces, of unknowns of each piece, and of shared unknowns."""
        pieces, local = self.local.shape[1:3]
        return pieces, local, self.shared.shape[-1] - 1

    def at(self, members) -> "Arrow":
        """Return the problems of some members."""
        return Arrow(*(x[members] for x in self.arrays))

    def scaled(self, size: Float[np.ndarray, "members unknowns"]) -> "Arrow":
        """Return this arrow, which has no joins, in unknowns divided by `size`."""
        shared, local = self.split(size)
        whole = np.concatenate([local, np.broadcast_to(shared[:, None], (*local.shape[:2], shared.shape[1])), np.ones((*local.shape[:2], 1))], axis=-1)
        return Arrow(
            self.local * whole[:, :, None], self.shared * np.concatenate([shared, np.ones((len(shared), 1))], axis=-1)[:, None], self.scores * shared[:, None]
        )

    def split(self, x: Shaped[np.ndarray, "members unknowns"]) -> tuple[np.ndarray, np.ndarray]:
        """Return shared unknowns (members, shared), and unknowns of the pieces (members, pieces, local)."""
        pieces, local, shared = self.counts
        return x[:, :shared], x[:, shared:].reshape(len(x), pieces, local)

    def _by_unknown(self, of: Callable[[np.ndarray], np.ndarray]) -> Float[np.ndarray, "members unknowns"]:
        """Return the sums over all rows of what is `of` rows: (..., rows, columns and residual) -> (..., columns)."""
        _, m, _ = self.counts
        shared = of(self.shared)
        if not m:
            return shared
        local = of(self.local)
        shared, own = shared + local[..., m:].sum(axis=1), local[..., :m]
        if self.joins is not None:
            joins = of(self.joins)
            shared, own = shared + joins[..., 2 * m :].sum(axis=1), own + joins[..., :m]
            own[:, :-1] += joins[:, 1:, m : 2 * m]
        return np.concatenate([shared, own.reshape(len(own), -1)], axis=1)

    @cached_property
    def column_norms(self) -> Float[np.ndarray, "members unknowns"]:
        """Length of each column of the Jacobian."""
        return np.sqrt(self._by_unknown(lambda rows: np.einsum("...ij,...ij->...j", rows[..., :-1], rows[..., :-1])))

    @cached_property
    def gradient(self) -> Float[np.ndarray, "members unknowns"]:
        """`J' r`."""
        return self._by_unknown(lambda rows: (rows[..., None, :, -1] @ rows[..., :-1])[..., 0, :])

    def _changes(self, d: Float[np.ndarray, "members unknowns"]) -> list[np.ndarray]:
        """Return by how much the residuals of each part change, to first order."""
        shared, own = self.split(d)
        _, m, _ = self.counts
        found = [(self.shared[..., :-1] @ shared[..., None])[..., 0]]
        if m:
            found.append((self.local[..., :m] @ own[..., None] + self.local[..., m:-1] @ shared[:, None, :, None])[..., 0])
        if self.joins is not None:
            before = np.roll(own, 1, axis=1)[..., None]  # of the first piece it meets a zero
            joins = self.joins
            found.append((joins[..., :m] @ own[..., None] + joins[..., m : 2 * m] @ before + joins[..., 2 * m : -1] @ shared[:, None, :, None])[..., 0])
        return found

    def change(self, d: Float[np.ndarray, "members unknowns"]) -> Float[np.ndarray, "members"]:
        """`|J d|^2`."""
        return sum(np.einsum("bi,bi->b", x, x) for x in (x.reshape(len(x), -1) for x in self._changes(d)))

    def _held(self, held: Bool[np.ndarray, "members unknowns"], moved: Float[np.ndarray, "members unknowns"]) -> "Arrow":
        """Return the problem of all other unknowns, with the residuals where those that are `held` have `moved`."""
        _, m, _ = self.counts
        shared, own = self.split(~held)
        parts = [self.shared.copy(), self.local.copy(), *([] if self.joins is None else [self.joins.copy()])]
        for part, change in zip(parts, self._changes(np.where(held, moved, 0.0)), strict=False):
            part[..., -1] += change
        parts[0][..., :-1] *= shared[:, None]
        for part, start in zip(parts[1:], (m, 2 * m), strict=False):
            part[..., :m] *= own[:, :, None]
            part[..., start:-1] *= shared[:, None, None]
        if self.joins is not None:
            parts[2][..., m : 2 * m] *= np.roll(own, 1, axis=1)[:, :, None]
        return Arrow(parts[1], parts[0], self.scores, *parts[2:])

    def step(self, damping: Float[np.ndarray, "members"], D, held, moved, cutoff: float) -> Float[np.ndarray, "members unknowns"]:
        """Return the damped step; unknowns that are `held` move by `moved`. D: (members, unknowns), positive."""
        _, m, p = self.counts
        here = self._held(held, moved) if held.any() else self
        D_s, D_l = self.split(D)
        tops, left = eliminated(here.local, np.sqrt(damping)[:, None, None] * D_l, here.joins)
        found = by_singular_values(np.concatenate([here.shared, left], axis=1) if m else here.shared, D_s, damping, cutoff)
        if m:
            right = -(tops[..., -1:] + tops[..., -1 - p : -1] @ found[:, None, :, None])
            own = np.linalg.solve(tops[..., :m], right)
            for i in range(1, 1 if here.joins is None else own.shape[1]):
                own[:, i] -= np.linalg.solve(tops[:, i, :, :m], tops[:, i, :, m : 2 * m] @ own[:, i - 1])
            found = np.concatenate([found, own.reshape(len(own), -1)], axis=1)
        return np.where(held, moved, found)


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


def eliminated(local: np.ndarray, below: Float[np.ndarray, "members pieces local"], joins: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Return the rows that give own unknowns in terms of shared unknowns and of the piece before, and the rows that are left for these.

    `below`: the diagonal of the rows that are added. The rows that are left stand one after another.
    """
    members, pieces, m, width = local.shape
    if not m:
        return local, np.zeros((members, 0, width))
    added = np.concatenate([below[..., None] * np.eye(m), np.zeros((members, pieces, m, width - m))], axis=-1)
    rows = np.concatenate([local, added], axis=2)
    if joins is None:
        R = np.linalg.qr(rows, mode="r")
        return R[:, :, :m], R[:, :, m:, m:].reshape(members, -1, width - m)
    apart = _beside(rows, m)
    tops, left, carried = np.zeros((members, pieces, m, width + m)), [], apart[:, 0, :0]
    for i in reversed(range(pieces)):
        R = np.linalg.qr(np.concatenate([joins[:, i], apart[:, i], carried], axis=1), mode="r")
        tops[:, i], rest = R[:, :m], R[:, m:, m:]
        if joins[:, i].any():
            carried = _beside(rest, m)
        else:
            left.append(rest[..., m:])
            carried = carried[:, :0]
    return tops, np.concatenate(left, axis=1)


def _beside(rows: Float[np.ndarray, "*batch rows width"], m: int) -> Float[np.ndarray, "*batch rows wider"]:
    """Return the rows with zeros in the columns of the piece before, which come after their first m."""
    return np.concatenate([rows[..., :m], np.zeros((*rows.shape[:-1], m)), rows[..., m:]], axis=-1)


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
