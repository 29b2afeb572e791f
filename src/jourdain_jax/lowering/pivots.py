"""What a linear system of nodes is eliminated by: pivots that are large wherever the system itself is regular.

A pivot that is a number or depends on parameters alone cannot vanish on the way and is taken first; the others are judged by the smallest
value they take, relative to their row, at all probes. Among good pivots the one that fills in least is taken. Where only entries that may
vanish are left, or no order of elimination serves, rows are combined: those of one column, a_1, a_2, ..., into one row with the pivot sum w_i a_i^2, which
depends on parameters alone where these are components of a vector in turned axes, such as the velocity of a hitch. From that row the
others are made orthogonal. Rows of a rolling wheel along the world's axes so become rows along and across its heading. In exact numbers such a pivot is
the squared distance of its column from those before it, which is no smaller than the smallest singular value squared, and it serves as well where there
are more rows than unknowns and each row vanishes somewhere.
"""

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jourdain_jax.program.evaluate import Probes
from jourdain_jax.program.graph import Graph
from jourdain_jax.program.polynomial import NormalForms

GOOD = 0.02  # of a pivot, relative to its row, at the worst probe
FEW = 12  # equations: with more, the operations that lead to a pivot are not counted when it is chosen


class Pivot(NamedTuple):
    """A row and a column that are eliminated."""

    row: int
    column: int
    monitored: int  # must not vanish


@dataclass(frozen=True)
class _Entry:
    """What a place promises as a pivot."""

    worst: float  # of its row, at the worst probe
    fixed: bool  # it depends on parameters alone


class _Combined(NamedTuple):
    """A column, the rows that hold it with their weights, and what their combination promises as a pivot."""

    column: int
    rows: list[int]
    weights: list[float]
    squares: int  # sum of weights times entries squared
    worst: float  # beside the sizes of the rows, at the worst probe

    @property
    def serves(self) -> bool:
        """Whether it is large at every probe."""
        return self.worst > GOOD


class Pivots:
    """The system `A x = right` while it is eliminated, and the choice of the next pivot. `probes`: of the domain; `far`: at full turns of all angles."""

    def __init__(self, graph: Graph, A: Sequence[Sequence[int]], right: Sequence[Sequence[int]], probes: Probes, far: Callable[[], Probes] | None):
        # terms of a determinant in normal form
        self.graph, self.probes, self.forms = graph, probes, NormalForms(graph, 32, sign=probes.sign)
        self.A, self.right = [list(row) for row in A], [list(row) for row in right]
        self.rows, self.columns = set(range(len(self.A))), set(range(len(self.A[0]) if self.A else 0))
        self._far, self._kept_regular = far, None
        self._given = [list(row) for row in A]
        self._tall = len(self.rows) > len(self.columns)
        self._sizes: dict[int, np.ndarray] = {}  # of what a row was made of
        self._entries: dict[int, list[int]] = {}  # columns of a row that hold something
        self._judged: dict[int, dict[int, _Entry]] = {}
        self._combined: dict[tuple, _Combined] = {}  # by column and entries

    def eliminated(self, pivot: Pivot) -> None:
        """Subtract multiples of the pivot's row from the rows that are left."""
        graph, A = self.graph, self.A
        r, c = pivot.row, pivot.column
        self.rows.remove(r)
        self.columns.remove(c)
        over = graph.div(graph.one, A[r][c])
        for other in sorted(self.rows):
            factor = graph.mul(A[other][c], over)
            if factor == graph.zero:
                continue
            if self._tall:
                self._sizes[other] = self._size(other) + np.abs(self._at([factor])[0]) * self._size(r)
            for k in self._in_row(r):
                A[other][k] = graph.sub(A[other][k], graph.mul(factor, A[r][k]))
            self._changed(other)
            self.right[other] = [graph.sub(a, graph.mul(factor, b)) for a, b in zip(self.right[other], self.right[r], strict=True)]

    def _changed(self, *rows: int) -> None:
        """Some rows were changed; all of them, where none is named."""
        for row in rows or list(self._entries):
            self._entries.pop(row, None)
            self._judged.pop(row, None)

    def _in_row(self, row: int) -> list[int]:
        """The columns left in which a row holds something, in order."""
        if row not in self._entries:
            self._entries[row] = [k for k, n in enumerate(self.A[row]) if n != self.graph.zero]
        return [k for k in self._entries[row] if k in self.columns]

    def best(self) -> Pivot:
        """The next pivot. Rows may be combined for it."""
        graph, A, rows = self.graph, self.A, self.rows
        judged = [(r, c, entry) for r in sorted(rows) for c, entry in self._judged_row(r).items()]
        if not judged:
            raise ZeroDivisionError("the rows are dependent")
        in_row, in_column = Counter(r for r, _, _ in judged), Counter(c for _, c, _ in judged)

        def cost(place):
            r, c, entry = place
            fill = (in_row[r] - 1) * (in_column[c] - 1)
            return fill, not entry.fixed, graph.operations([A[r][c]]) if len(rows) <= FEW else 0, -entry.worst

        good = [place for place in judged if place[2].fixed or place[2].worst > GOOD]
        if good:
            r, c, entry = min(good, key=cost)
            if entry.fixed:
                return Pivot(r, c, A[r][c])
        combined = self._best_column()
        if combined is not None and combined.serves and not graph.varies[combined.squares]:
            return self._by_column(combined)
        good.sort(key=cost)
        serving = next(((r, c) for r, c, entry in good if entry.fixed or self._regular_everywhere((r, c))), None)
        if serving is not None:
            r, c = serving
            return Pivot(r, c, A[r][c])
        r, c, _ = good[0] if good else max(judged, key=lambda place: place[2].worst)
        if combined is None or combined.worst <= _least(np.abs(self._beside_row((r, c)))[self._regular]):
            return Pivot(r, c, A[r][c])
        return self._by_column(combined)

    def _judged_row(self, row: int) -> dict[int, "_Entry"]:
        """The entries of a row by column, judged; kept until the row changes."""
        if row not in self._judged or not self.columns.issuperset(self._judged[row]):
            columns = self._in_row(row)
            ratio = np.abs(self._ratios(row, columns, self.probes)) if columns else np.empty((0, 1))
            worst = np.min(np.where(np.isfinite(ratio), ratio, 0.0), axis=1)  # at any probe
            self._judged[row] = {c: _Entry(w, bool(w > 0) and self._is_fixed(self.A[row][c])) for c, w in zip(columns, worst, strict=True)}
        return self._judged[row]

    def _is_fixed(self, node: int) -> bool:
        """Whether a node depends on parameters alone, none of which turns it through zero."""
        graph = self.graph
        return not graph.varies[node] and (graph.is_const(node) or not any(turns(graph, n) for n in graph.reachable([node])))

    # judgement: at the probes of the domain, and at full turns of all angles where the system itself is regular

    def _regular_everywhere(self, place: tuple[int, int]) -> bool:
        """Whether an entry stays away from zero also outside of the domain, wherever the system is regular."""
        ratio = self._beside_row(place)
        ratio = ratio[self._regular & np.isfinite(ratio)]
        size = np.min(np.abs(ratio), initial=np.inf)
        # one with both signs that is smaller than 0.25 somewhere vanishes in between
        return bool(size > 0.25 or (size > GOOD and not ratio.min() < 0 < ratio.max()))

    def _beside_row(self, place: tuple[int, int]) -> Float[np.ndarray, "probes"]:
        """An entry beside the largest of its row, with its sign."""
        r, c = place
        columns = self._in_row(r)
        return self._ratios(r, columns, self._at)[columns.index(c)]

    def _ratios(self, row: int, columns: list[int], values_of: Callable) -> Float[np.ndarray, "columns probes"]:
        """Entries beside the largest of their row, and, unless a row that vanishes makes the system singular anyway, beside what that was made of."""
        values = values_of([self.A[row][c] for c in columns])
        largest = np.max(np.abs(values), axis=0)
        if self._tall:
            size = self._size(row)
            largest = np.fmax(largest, np.fmax(size, np.nanmedian(size))[: len(largest)])
        with np.errstate(all="ignore"):
            return values / np.where(largest > 0, largest, 1.0)

    @property
    def _regular(self) -> np.ndarray:
        """The probes at which the given system is regular: its rows and columns scaled, at the probes of the domain and the far ones."""
        if self._kept_regular is None:
            count = len(self._given[0])
            A = np.moveaxis(self._at([n for row in self._given for n in row]).reshape(len(self._given), count, -1), -1, 0)
            finite = np.all(np.isfinite(A), axis=(1, 2))
            A = np.where(finite[:, None, None], A, 0.0)
            lengths = np.linalg.norm(A, axis=2, keepdims=True)
            usual = np.median(lengths[finite], axis=0, keepdims=True) if finite.any() else lengths[:1]
            A = A / np.where(usual > 0, usual, 1.0)
            width = np.sqrt(np.mean(np.sum(A**2, axis=1), axis=0))
            sigma = np.linalg.svd(A / np.where(width > 0, width, 1.0), compute_uv=False)[:, count - 1]
            # smallest singular value of a scaled system that a pivot has to serve
            self._kept_regular = finite & (sigma > 0.02)
        return self._kept_regular

    def _at(self, nodes) -> np.ndarray:
        """Values at the probes of the domain and the far ones."""
        near = self.probes(nodes)
        return near if self._far is None else np.concatenate([near, self._far()(nodes)], axis=1)

    def _size(self, row: int) -> np.ndarray:
        """The size of what a row was made of, at all probes."""
        if row not in self._sizes:
            self._sizes[row] = np.max(np.abs(self._at(self.A[row])), axis=0)
        return self._sizes[row]

    # rows combined

    def _best_column(self) -> "_Combined | None":
        """The column with the best pivot by all rows that hold it, combined; None where each is held by one."""
        found = []
        for c in sorted(self.columns):
            users = [r for r in sorted(self.rows) if self.A[r][c] != self.graph.zero]
            if len(users) < 2:
                continue
            key = c, *((r, self.A[r][c]) for r in users)
            if key not in self._combined:
                self._combined[key] = self._combination(c, users)
            combined = self._combined[key]
            fill = len({k for r in users for k in self._in_row(r)}) * len(users)
            found.append((not combined.serves, self.graph.varies[combined.squares], fill, -combined.worst, c, combined))
        return min(found)[-1] if found else None

    def _combination(self, c: int, users: list[int]) -> "_Combined":
        graph, weights = self.graph, self._weights(users)
        squares = graph.total(graph.mul(graph.const(w), graph.mul(self.A[r][c], self.A[r][c])) for r, w in zip(users, weights, strict=True))
        squares = self.forms.simplified(squares)
        size = sum(w * self._size(r) ** 2 for r, w in zip(users, weights, strict=True))
        with np.errstate(all="ignore"):
            return _Combined(c, users, weights, squares, _least(np.sqrt(self._at([squares])[0] / size)[self._regular]))

    def _by_column(self, combined: "_Combined") -> Pivot:
        turned = len(combined.rows) == 2 and len(self.rows) <= len(self.columns)
        return (self._turned if turned else self._orthogonal)(combined.column, combined.rows, combined.weights, combined.squares)

    def _weights(self, rows: list[int]) -> list[float]:
        """The weights of rows in a combination: one where their sizes are alike."""
        sizes = [float(np.nanmedian(self._size(r))) for r in rows]
        largest = max(sizes)
        # rows whose sizes differ by more are combined with weights
        if min(sizes) * 8.0 > largest:
            return [1.0] * len(rows)
        return [4.0 ** round(np.log2(largest / size)) if size > 0 else 1.0 for size in sizes]

    def _turned(self, c: int, users: list[int], weights: list[float], squares: int) -> Pivot:
        """Two rows turned into one with the pivot and one without: `a r + w b s` and `b r - a s`; the determinant keeps its sign."""
        graph, A, (r, s) = self.graph, self.A, users
        a, b = A[r][c], A[s][c]
        first, second = (graph.mul(graph.const(w), n) for w, n in zip(weights, (a, b), strict=True))
        sizes = [np.abs(self._at([a])[0]), np.abs(self._at([b])[0])]
        self._sizes[r], self._sizes[s] = (
            weights[0] * sizes[0] * self._size(r) + weights[1] * sizes[1] * self._size(s),
            sizes[1] * self._size(r) + sizes[0] * self._size(s),
        )
        for row in (A, self.right):
            pairs = list(zip(row[r], row[s], strict=True))
            row[r] = [self.forms.simplified(graph.add(graph.mul(first, x), graph.mul(second, y))) for x, y in pairs]
            row[s] = [self.forms.simplified(graph.sub(graph.mul(b, x), graph.mul(a, y))) for x, y in pairs]
        A[r][c], A[s][c] = squares, graph.zero
        self._changed()
        return Pivot(r, c, graph.call("sqrt", squares))

    def _orthogonal(self, c: int, users: list[int], weights: list[float], squares: int) -> Pivot:
        """All rows of a column combined into a new one, and made orthogonal to the column (Gram and Schmidt)."""
        graph, A = self.graph, self.A
        new = len(A)
        over = graph.div(graph.one, squares)
        entries = [(r, graph.mul(graph.const(w), A[r][c]), A[r][c]) for r, w in zip(users, weights, strict=True)]
        self._sizes[new] = sum(np.abs(self._at([wa])[0]) * self._size(r) for r, wa, _ in entries)
        for row in (A, self.right):
            made = [self.forms.simplified(graph.total(graph.mul(wa, row[r][k]) for r, wa, _ in entries)) for k in range(len(row[users[0]]))]
            row.append(made)
        for r, _, a in entries:
            factor = graph.mul(a, over)
            self._sizes[r] = self._size(r) + np.abs(self._at([factor])[0]) * self._sizes[new]
            for row in (A, self.right):
                row[r] = [self.forms.simplified(graph.sub(x, graph.mul(factor, p))) for x, p in zip(row[r], row[new], strict=True)]
            A[r][c] = graph.zero
        A[new][c] = squares
        self._changed()
        self.rows.add(new)
        self._tall = True
        return Pivot(new, c, graph.call("sqrt", squares))


def turns(graph: Graph, node: int) -> bool:
    """Whether a node is the sine or cosine of a parameter, which may be any angle."""
    return graph.op[node] in ("sin", "cos") and graph.op[graph.args[node][0]] == "input" and not graph.varies[node]


def _least(ratio: Float[np.ndarray, "probes"]) -> float:
    """The smallest; zero where none is a number."""
    return float(np.min(ratio[np.isfinite(ratio)], initial=np.inf)) if np.isfinite(ratio).any() else 0.0

