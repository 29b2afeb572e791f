"""Least squares whose runs are pieces that are joined one to the next: an arrow with a chain through it.

minimise sum_i |r_i + J_i dx_i + S_i ds|^2 + sum_i |c_i + A_i dx_i + B_i dx_i+1 + C_i ds|^2 + lambda |D d|^2      x_i: own unknowns of piece i

    from the last piece of a run to its first   [ B_i A_i C_i c_i ; T_i+1 0 S_i+1 r_i+1 ] = Q [ R ; 0 ]     one QR factorisation per piece takes x_i+1 out

Time and memory grow linearly with the number of pieces. All on NumPy, with a leading axis `members`.
Source: G. J. Bierman, Factorization Methods for Discrete Sequential Estimation (1977), chapter VI (square-root information).
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from jourdain_jax.analysis.arrow import Arrow, by_singular_values


@dataclass(frozen=True)
class JoinedArrow:
    """A linearised problem of pieces; unknowns are (shared, own of piece 0, own of piece 1, ...), as of an `Arrow`."""

    pieces: Arrow
    joins: Float[np.ndarray, "members pieces rows columns"]  # of piece i with the next one: [A B C c]; zero where a run ends
    follows: Bool[np.ndarray, "pieces"]  # whether a piece is joined to the one before

    @property
    def arrays(self) -> tuple[np.ndarray, ...]:
        """All that it holds, with the axis of members first."""
        return *self.pieces.arrays, self.joins

    def at(self, members) -> "JoinedArrow":
        """That of some members."""
        return JoinedArrow(self.pieces.at(members), self.joins[members], self.follows)

    def split(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Shared unknowns (members, shared), and those of the pieces (members, pieces, local)."""
        return self.pieces.split(x)

    @property
    def _parts(self) -> tuple[np.ndarray, ...]:
        """A, B, C, c of the joins."""
        _, m, _ = self.pieces.counts
        return self.joins[..., :m], self.joins[..., m : 2 * m], self.joins[..., 2 * m : -1], self.joins[..., -1]

    def _gathered(self, of_piece: np.ndarray, of_next: np.ndarray, of_shared: np.ndarray) -> Float[np.ndarray, "members unknowns"]:
        """A number for each unknown from numbers for each join; what the next piece has comes one place later."""
        later = np.concatenate([np.zeros_like(of_next[:, :1]), of_next[:, :-1]], axis=1)
        return np.concatenate([of_shared.sum(axis=1), (of_piece + later).reshape(len(of_piece), -1)], axis=1)

    @property
    def column_norms(self) -> Float[np.ndarray, "members unknowns"]:
        """Length of each column of the Jacobian."""
        A, B, C = (np.sum(x**2, axis=2) for x in self._parts[:3])
        return np.sqrt(self.pieces.column_norms**2 + self._gathered(A, B, C))

    @property
    def gradient(self) -> Float[np.ndarray, "members unknowns"]:
        """`J' r`."""
        *slopes, c = self._parts
        return self.pieces.gradient + self._gathered(*((c[..., None, :] @ x)[..., 0, :] for x in slopes))

    def _of_joins(self, d: Float[np.ndarray, "members unknowns"]) -> Float[np.ndarray, "members pieces rows"]:
        """How much the residuals of the joins change."""
        shared, own = self.pieces.split(d)
        A, B, C, _ = self._parts
        following = np.concatenate([own[:, 1:], np.zeros_like(own[:, :1])], axis=1)
        return (A @ own[..., None] + B @ following[..., None] + C @ shared[:, None, :, None])[..., 0]

    def moved(self, d: Float[np.ndarray, "members unknowns"]) -> "JoinedArrow":
        """Close by, with the residuals that it has there to first order."""
        joins = self.joins.copy()
        joins[..., -1] += self._of_joins(d)
        return JoinedArrow(self.pieces.moved(d), joins, self.follows)

    def change(self, d: Float[np.ndarray, "members unknowns"]) -> Float[np.ndarray, "members"]:
        """`|J d|^2`."""
        return self.pieces.change(d) + np.sum(self._of_joins(d) ** 2, axis=(1, 2))

    def step(self, damping: Float[np.ndarray, "members"], D, held, moved, cutoff) -> Float[np.ndarray, "members unknowns"]:
        """The damped step; unknowns that are `held` move by `moved`. D: (members, unknowns), positive."""
        runs, m, p = self.pieces.counts
        ended = self.moved(np.where(held, moved, 0.0)) if held.any() else self
        held_s, held_l = self.pieces.split(held)
        D_s, D_l = self.pieces.split(D)
        local, joins, shared = ended.pieces.local.copy(), ended.joins.copy(), ended.pieces.shared.copy()
        shared[..., :-1] *= ~held_s[:, None]
        local[..., :m] *= ~held_l[:, :, None]
        local[..., m:-1] *= ~held_s[:, None, None]
        joins[..., :m] *= ~held_l[:, :, None]
        joins[:, :-1, :, m : 2 * m] *= ~held_l[:, 1:, None]
        joins[..., 2 * m : -1] *= ~held_s[:, None, None]
        below, members = np.sqrt(damping)[:, None, None] * D_l, len(D)
        tops: list[np.ndarray] = [np.zeros(0)] * runs
        left, carried = [shared], np.zeros((members, 0, m + p + 1))
        for i in reversed(range(runs)):
            damped = np.concatenate([below[:, i, :, None] * np.eye(m), np.zeros((members, m, p + 1))], axis=2)
            rows = np.concatenate([local[:, i], damped, carried], axis=1)
            if self.follows[i]:
                join = joins[:, i - 1]
                apart = np.concatenate([rows[..., :m], np.zeros((*rows.shape[:2], m)), rows[..., m:]], axis=2)
                rows = np.concatenate([np.concatenate([join[..., m : 2 * m], join[..., :m], join[..., 2 * m :]], axis=2), apart], axis=1)
            R = np.linalg.qr(rows, mode="r")
            tops[i], rest = R[:, :m], R[:, m:, m:]
            if self.follows[i]:
                carried = rest
            else:
                carried = carried[:, :0]
                left.append(rest)
        ds = by_singular_values(np.concatenate(left, axis=1), D_s, damping, cutoff)
        found = np.zeros((members, runs, m))
        for i, top in enumerate(tops):
            right = top[..., -1:] + top[..., -1 - p : -1] @ ds[..., None]
            if self.follows[i]:
                right = right + top[..., m : 2 * m] @ found[:, i - 1, :, None]
            found[:, i] = -np.linalg.solve(top[..., :m], right)[..., 0]
        return np.where(held, moved, np.concatenate([ds, found.reshape(members, -1)], axis=1))
