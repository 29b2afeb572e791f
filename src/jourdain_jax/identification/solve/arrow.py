"""Least squares with an arrow-shaped matrix: some unknowns are shared by all runs, others belong to single
runs or pieces of runs. Consecutive pieces may be coupled.

    minimise sum_i |r_i + J_i dx_i + S_i ds|^2 + sum_i |c_i + B_i dx_i + A_i dx_i-1 + C_i ds|^2
             + lambda |D d|^2
    [J_i S_i r_i] = Q_i [ T_i ; 0 ]
    [ B_i A_i C_i c_i ; T_i ; sqrt(lambda) D_i ; remainder of the next piece ] = Q_i' [ U_i ; remainder ]

Piece i has residuals r_i and own unknowns x_i; c_i are the residuals of its join with the previous piece; s
are the shared unknowns; d = (ds, dx_0, ...). Only T_i of the first QR factorisation is stored. The second
factorisation eliminates x_i, from the last piece of a run to the first. A singular value decomposition of the
remainders of all runs gives ds, which is zero in directions below a cut-off.

A whole run is one piece without a join. Time and memory grow linearly with the number of pieces. A leading
axis `members` holds several problems of equal shape. All arrays are NumPy's. Source: G. H. Golub and V.
Pereyra, Inverse Problems 19 (2003) R1; J. J. Moré, Lecture Notes in Mathematics 630 (1978) 105 (the scaling
D); G. J. Bierman, Factorization Methods for Discrete Sequential Estimation (1977), chapter VI (square-root
information, the chain).
"""

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import TypeVar

import numpy as np
from jaxtyping import Bool, Float, Int, Shaped

Parts = TypeVar("Parts", bound="ByMember")
ByUnknown = Float[np.ndarray, "members unknowns"]
PerMember = Float[np.ndarray, "members"]
Flags = Bool[np.ndarray, "members"]
Members = Int[np.ndarray, "members"]  # indices of members


class ByMember:
    """Base of dataclasses whose fields are arrays, or nested dataclasses, with a leading axis of members; or
    None.
    """

    def _parts(self) -> list:
        return [getattr(self, field.name) for field in fields(self)]  # type: ignore[arg-type]

    def of(self: Parts, members) -> Parts:
        """Return the entries of some members."""
        return type(self)(
            *(
                x if x is None else x.of(members) if isinstance(x, ByMember) else x[members]
                for x in self._parts()
            )
        )

    def put(self: Parts, members, new: Parts) -> None:
        """Store `new` as the entries of these members."""
        for kept, one in zip(self._parts(), new._parts(), strict=True):
            if isinstance(kept, ByMember):
                kept.put(members, one)
            elif kept is not None:
                kept[members] = one

    def replaced(self: Parts, members: np.ndarray, new: Parts, chosen: Bool[np.ndarray, "some"]) -> Parts:
        """Return all members; the `chosen` ones have their `new` values."""
        count = len(next(x for x in self._parts() if isinstance(x, np.ndarray)))
        if len(members) == count and chosen.all():
            return new
        found = self.of(np.arange(count))
        found.put(members[chosen], new.of(chosen))
        return found


def triangle(whole: Float[np.ndarray, "*batch samples width"]) -> Float[np.ndarray, "*batch width width"]:
    """Return the triangle T of Jacobian and residuals [J r]; not finite if these are not."""
    width = whole.shape[-1]
    if whole.shape[-2] < width:
        whole = np.concatenate(
            [whole, np.zeros((*whole.shape[:-2], width - whole.shape[-2], width))], axis=-2
        )
    # LAPACK's raw form: the transposed triangle, with reflectors beyond the diagonal
    reflected, _ = np.linalg.qr(whole, mode="raw")
    index = np.arange(width)
    return reflected[..., :width].swapaxes(-1, -2) * (index[:, None] <= index)


@dataclass(frozen=True)
class Arrow(ByMember):
    """A linearised least-squares problem. Its unknowns are (shared, own of piece 0, own of piece 1, ...)."""

    local: Float[np.ndarray, "members pieces local width"]  # the rows of T that contain own unknowns
    shared: Float[np.ndarray, "members rows columns"]  # the other rows of all pieces, as one triangle
    # gradient of each piece in the shared unknowns, after its own unknowns were fitted
    scores: Float[np.ndarray, "members pieces _"]
    # [B A C c]; zero for the first piece of a run
    joins: Float[np.ndarray, "members pieces joined both"] | None = None

    @property
    def counts(self) -> tuple[int, int, int]:
        """Return the numbers of pieces, of unknowns of each piece, and of shared unknowns."""
        pieces, local = self.local.shape[1:3]
        return pieces, local, self.shared.shape[-1] - 1

    def split(self, x: Shaped[np.ndarray, "members unknowns"]) -> tuple[np.ndarray, np.ndarray]:
        """Return shared unknowns (members, shared), and unknowns of the pieces (members, pieces, local)."""
        pieces, local, shared = self.counts
        return x[:, :shared], x[:, shared:].reshape(len(x), pieces, local)

    @property
    def _blocks(self) -> list[np.ndarray]:
        """Return up to three blocks of rows: rows with shared unknowns only, rows of single pieces, and rows
        of joins between a piece and its predecessor.
        """
        return [
            x for x in (self.shared, self.local if self.local.shape[2] else None, self.joins) if x is not None
        ]

    def _columns(self, x: Shaped[np.ndarray, "members unknowns"]) -> list[np.ndarray]:
        """Return the entries of x for the columns of each block. A first piece has no predecessor, and the
        entries for it are arbitrary.
        """
        shared, own = self.split(x)
        if len(self._blocks) == 1:
            return [shared]
        each = np.broadcast_to(shared[:, None], (*own.shape[:2], shared.shape[1]))
        leading = ([], [own], [own, np.roll(own, 1, axis=1)])[: len(self._blocks)]
        return [np.concatenate([*parts, each], axis=-1) if parts else shared for parts in leading]

    def _of_blocks(self, blocks: list[np.ndarray]) -> "Arrow":
        shared, local, joins = (*blocks, None, None)[:3]
        return Arrow(self.local if local is None else local, shared, self.scores, joins)

    def scaled(self, size: ByUnknown) -> "Arrow":
        """Return this arrow for unknowns divided by `size`."""
        blocks = [rows.copy() for rows in self._blocks]
        for rows, x in zip(blocks, self._columns(size), strict=True):
            rows[..., :-1] *= x[..., None, :]
        return replace(self._of_blocks(blocks), scores=self.scores * self.split(size)[0][:, None])

    def _by_unknown(self, of: Callable[[np.ndarray], np.ndarray]) -> ByUnknown:
        """Return the sum of `of(block)` over all rows, for each column. `of` maps (..., rows, columns and
        residual) to (..., columns).
        """
        shared, *others = map(of, self._blocks)
        pieces, m, _ = self.counts
        own = np.zeros((len(shared), pieces, m))
        for lead, x in enumerate(others, 1):
            shared = shared + x[..., lead * m :].sum(axis=1)
            own += x[..., :m]
            own[:, :-1] += x[:, 1:, m : lead * m] if lead > 1 else 0.0
        return np.concatenate([shared, own.reshape(len(own), -1)], axis=1) if m else shared

    @cached_property
    def column_norms(self) -> ByUnknown:
        """Return the length of each column of the Jacobian."""
        return np.sqrt(
            self._by_unknown(lambda rows: np.einsum("...ij,...ij->...j", rows[..., :-1], rows[..., :-1]))
        )

    @cached_property
    def gradient(self) -> ByUnknown:
        """Return `J' r`."""
        return self._by_unknown(lambda rows: (rows[..., None, :, -1] @ rows[..., :-1])[..., 0, :])

    def _changes(self, d: ByUnknown) -> list[np.ndarray]:
        """Return the first-order change of the residuals of each block."""
        return [
            (rows[..., :-1] @ x[..., None])[..., 0]
            for rows, x in zip(self._blocks, self._columns(d), strict=True)
        ]

    def change(self, d: ByUnknown) -> PerMember:
        """Return `|J d|^2`."""
        return sum(np.einsum("bi,bi->b", x, x) for x in (x.reshape(len(x), -1) for x in self._changes(d)))

    def _held(self, held: Bool[np.ndarray, "members unknowns"], moved: ByUnknown) -> "Arrow":
        """Return the problem without the `held` unknowns, with the residuals after these have changed by
        `moved`.
        """
        blocks = [rows.copy() for rows in self._blocks]
        for rows, change, free in zip(
            blocks, self._changes(np.where(held, moved, 0.0)), self._columns(~held), strict=True
        ):
            rows[..., -1] += change
            rows[..., :-1] *= free[..., None, :]
        return self._of_blocks(blocks)

    def step(self, damping: PerMember, D, held, moved, cutoff: float) -> ByUnknown:
        """Return the damped step; the `held` unknowns change by `moved`. D: (members, unknowns), positive."""
        _, m, p = self.counts
        here = self._held(held, moved) if held.any() else self
        D_s, D_l = self.split(D)
        tops, left = eliminated(here.local, np.sqrt(damping)[:, None, None] * D_l, here.joins)
        found = by_singular_values(
            np.concatenate([here.shared, left], axis=1) if m else here.shared, D_s, damping, cutoff
        )
        if m:
            right = -(tops[..., -1:] + tops[..., -1 - p : -1] @ found[:, None, :, None])
            own = np.linalg.solve(tops[..., :m], right)
            for i in range(1, 1 if here.joins is None else own.shape[1]):
                own[:, i] -= np.linalg.solve(tops[:, i, :, :m], tops[:, i, :, m : 2 * m] @ own[:, i - 1])
            found = np.concatenate([found, own.reshape(len(own), -1)], axis=1)
        return np.where(held, moved, found)


def with_prior(
    arrow: Arrow, residual: ByUnknown, weight: np.ndarray, M: Float[np.ndarray, "shared shared"]
) -> Arrow:
    """Return the arrow with prior residuals added: `residual` is (theta - mean) * weight of each unknown,
    zero without a prior. Residuals of shared unknowns are multiplied by M. The scores do not change.
    """
    (r_s, r_l), (J_s, J_l) = arrow.split(residual), arrow.split(np.broadcast_to(weight, residual.shape))
    tops, left = eliminated(arrow.local, J_l, residual=r_l)
    below = np.concatenate([M * J_s[:, None], M @ r_s[..., None]], axis=-1)
    return Arrow(
        tops, np.linalg.qr(np.concatenate([arrow.shared, left, below], axis=1), mode="r"), arrow.scores
    )


def eliminated(
    local: np.ndarray, below: np.ndarray, joins: np.ndarray | None = None, residual: np.ndarray | float = 0.0
) -> tuple[np.ndarray, np.ndarray]:
    """Return rows that express the unknowns of each piece by shared unknowns and the unknowns of the previous
    piece, and the remaining rows, which contain only shared unknowns.

    `below`: the diagonal (members, pieces, local) of additional rows for the pieces' unknowns; `residual`:
    the residuals of these rows.
    """
    members, pieces, m, width = local.shape
    if not m:
        return local, np.zeros((members, 0, width))
    added = np.zeros((members, pieces, m, width))
    added[..., range(m), range(m)], added[..., -1] = below, residual
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
    """Return the rows with zero columns inserted after their first m columns, for the unknowns of the
    previous piece.
    """
    return np.concatenate([rows[..., :m], np.zeros((*rows.shape[:-1], m)), rows[..., m:]], axis=-1)


def by_singular_values(
    shared: np.ndarray, D: np.ndarray, damping: PerMember, cutoff: float
) -> Float[np.ndarray, "members shared"]:
    """Return the damped step ds of the shared unknowns: (S^2 + lambda) V' D ds = - S U' c, zero in
    undetermined directions. `shared` is [J, c], with residuals c; U S V' = J D^-1.
    """
    U, S, Vt = np.linalg.svd(shared[..., :-1] / D[:, None], full_matrices=False)
    hidden = S[:, :1] * cutoff >= S  # the first is the largest
    weight = S / (S * S + damping[:, None])
    weight[hidden] = 0.0
    return -((weight * (shared[:, None, :, -1] @ U)[:, 0])[:, None] @ Vt)[:, 0] / D


def arrow(triangles: Float[np.ndarray, "members runs width width"], local: int) -> Arrow:
    """Return the arrow of the triangles of all runs. The first `local` columns of a triangle belong to the
    run's own unknowns.
    """
    members, runs, width, _ = triangles.shape
    rest = triangles[:, :, local:, local:]
    scores = (rest[..., None, :, -1] @ rest[..., :-1])[..., 0, :]
    together = rest.reshape(members, runs * (width - local), width - local)
    return Arrow(triangles[:, :, :local], np.linalg.qr(together, mode="r") if runs > 1 else together, scores)
