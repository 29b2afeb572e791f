"""Pivots for eliminating a linear system of nodes: large wherever the system itself is regular.

A pivot that is a number or depends on parameters alone cannot vanish on the way and is taken first; the others are judged by the smallest
value they take, relative to their row, at all probes. Among good pivots the one that fills in least is taken. Where only entries that may
vanish are left, two rows and two columns are eliminated together if their determinant cannot vanish: components of a vector in turned axes, such as
the velocity of a hitch, have one that depends on parameters alone, while each entry is zero at some angle.
Where no order of elimination serves, rows are combined: those of one column, a_1, a_2, ..., into one row with the pivot sum w_i a_i^2, from which the
others are made orthogonal. Rows of a rolling wheel along the world's axes so become rows along and across its heading. In exact numbers such a pivot is
the squared distance of its column from those before it, which is no smaller than the smallest singular value squared, and it serves as well where there
are more rows than unknowns and each row vanishes somewhere.
"""

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from jaxtyping import Float

from jourdain_jax.calculus.reals import Indices, all_finite, largest
from jourdain_jax.program.evaluate import Probes
from jourdain_jax.program.graph import Graph
from jourdain_jax.program.polynomial import NormalForms

GOOD = 0.02  # of a pivot, relative to its row, at the worst probe
FEW = 12  # equations: with more, the operations that lead to a pivot are not counted when it is chosen


@dataclass(frozen=True)
class Pivot:
    """Rows and columns eliminated together: one of each, or two."""

    rows: Indices
    columns: Indices
    inverse: tuple[Indices, ...]  # of A[rows][columns]
    monitored: int  # must not vanish


@dataclass(frozen=True)
class _Entry:
    """The quality of a place as a pivot."""

    worst: float  # of its row, at the worst probe
    fixed: bool  # it depends on parameters alone


class Pivots:
    """The system `A x = right` during elimination, and the choice of the next pivot. `probes`: of the domain;
    `far`: at full turns of all angles.
    """

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
        self._determinants: dict[tuple[int, int, int, int], int | None] = {}  # of two rows and columns, where it serves as a pivot

    def eliminated(self, pivot: Pivot) -> None:
        """Subtract multiples of the pivot's rows from the rows that are left."""
        graph, A = self.graph, self.A
        self.rows -= set(pivot.rows)
        self.columns -= set(pivot.columns)
        for other in sorted(self.rows):
            if all(A[other][c] == graph.zero for c in pivot.columns):
                continue
            factors = products(graph, [A[other][c] for c in pivot.columns], zip(*pivot.inverse, strict=True))
            for factor, r in zip(factors, pivot.rows, strict=True):
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
        """Return the columns left in which a row holds something, in order."""
        if row not in self._entries:
            self._entries[row] = [k for k, n in enumerate(self.A[row]) if n != self.graph.zero]
        return [k for k in self._entries[row] if k in self.columns]

    def best(self) -> Pivot:
        """Return the next pivot. Rows may be combined for it."""
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
                return self._single(r, c)
        pair = self._best_pair()
        if pair is not None:
            return pair
        good.sort(key=cost)
        serving = next(((r, c) for r, c, entry in good if entry.fixed or self._regular_everywhere((r, c))), None)
        if serving is not None:
            return self._single(*serving)
        r, c, _ = good[0] if good else max(judged, key=lambda place: place[2].worst)
        return self._by_column((r, c))

    def _judged_row(self, row: int) -> dict[int, "_Entry"]:
        """Return the entries of a row by column, judged; kept until the row changes."""
        if row not in self._judged or not self.columns.issuperset(self._judged[row]):
            columns = self._in_row(row)
            nodes, places = [self.A[row][c] for c in columns], [(row, c) for c in columns]
            ratio = _ratios(self.probes(nodes), places, self._sizes_at(places, self.probes.count)) if columns else np.empty((0, 1))
            worst = np.min(np.where(np.isfinite(ratio), ratio, 0.0), axis=1)  # at any probe
            self._judged[row] = {c: _Entry(w, bool(w > 0) and self._is_fixed(n)) for c, n, w in zip(columns, nodes, worst, strict=True)}
        return self._judged[row]

    def _is_fixed(self, node: int) -> bool:
        """Return whether a node depends on parameters only, and no parameter changes its sign."""
        graph = self.graph
        return not graph.varies[node] and (graph.is_const(node) or not any(turns(graph, n) for n in graph.reachable([node])))

    def _single(self, row: int, column: int, monitored: int | None = None) -> Pivot:
        entry = self.A[row][column]
        return Pivot((row,), (column,), ((self.graph.div(self.graph.one, entry),),), entry if monitored is None else monitored)

    # judgement: at the probes of the domain, and at full turns of all angles where the system itself is regular

    def _regular_everywhere(self, place: tuple[int, int]) -> bool:
        """Return whether an entry stays away from zero wherever the system is regular, also outside of the
        domain.
        """
        ratio = self._beside_row(place)
        ratio = ratio[self._regular & np.isfinite(ratio)]
        size = np.min(np.abs(ratio), initial=np.inf)
        # one with both signs that is smaller than 0.25 somewhere vanishes in between
        return bool(size > 0.25 or (size > GOOD and not ratio.min() < 0 < ratio.max()))

    def _beside_row(self, place: tuple[int, int]) -> Float[np.ndarray, "probes"]:
        """Return an entry beside the largest of its row, with its sign."""
        r, c = place
        columns = [k for k in sorted(self.columns) if self.A[r][k] != self.graph.zero]
        places, values = [(r, k) for k in columns], self._at([self.A[r][k] for k in columns])
        k = columns.index(c)
        return np.sign(values[k]) * _ratios(values, places, self._sizes_at(places))[k]

    @property
    def _regular(self) -> np.ndarray:
        """Return the probes, in the domain and far from it, at which the system with scaled rows and columns
        is regular.
        """
        if self._kept_regular is None:
            count = len(self._given[0])
            A = np.moveaxis(self._at([n for row in self._given for n in row]).reshape(len(self._given), count, -1), -1, 0)
            finite = all_finite(A, axis=(1, 2))
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
        """Return values at the probes of the domain and the far ones."""
        near = self.probes(nodes)
        return near if self._far is None else np.concatenate([near, self._far()(nodes)], axis=1)

    def _size(self, row: int) -> np.ndarray:
        """Return the size of the terms of a row, at all probes."""
        if row not in self._sizes:
            self._sizes[row] = largest(self._at(self.A[row]), 0)
        return self._sizes[row]

    def _sizes_at(self, places, count: int | None = None) -> np.ndarray | None:
        """Return reference sizes of entries and of their rows, at the first probes; None if a vanishing row
        makes the system singular.
        """
        if not self._tall:
            return None
        return np.stack([np.fmax(self._size(r), np.nanmedian(self._size(r)))[:count] for r, _ in places])

    # two rows and two columns

    def _best_pair(self) -> Pivot | None:
        """Return two rows and columns whose determinant depends on parameters only, with the least fill-in;
        None if there are none.
        """
        graph, A = self.graph, self.A
        used = {r: set(self._in_row(r)) for r in self.rows}
        users: dict[int, list[int]] = {c: [] for c in self.columns}
        for r in sorted(self.rows):
            for c in used[r]:
                users[c].append(r)
        found = []
        for r, s in sorted({pair for c in self.columns for pair in combinations(users[c], 2)}):
            for c, d in combinations(sorted(used[r] & used[s]), 2):
                entries = A[r][c], A[s][d], A[r][d], A[s][c]
                if entries not in self._determinants:
                    self._determinants[entries] = self._determinant_of(*entries)
                determinant = self._determinants[entries]
                if determinant is not None:
                    fill = (len(used[r] | used[s]) - 2) * len({*users[c], *users[d]} - {r, s})
                    found.append((fill, r, s, c, d, determinant))
        if not found:
            return None
        _, r, s, c, d, determinant = min(found)
        over = [graph.div(n, determinant) for n in (A[s][d], A[r][d], A[s][c], A[r][c])]
        return Pivot((r, s), (c, d), ((over[0], graph.neg(over[1])), (graph.neg(over[2]), over[3])), determinant)

    def _determinant_of(self, a: int, b: int, c: int, d: int) -> int | None:
        """Return a b - c d if it depends on parameters only and is not small; otherwise None."""
        graph, probes = self.graph, self.probes
        both = graph.mul(a, b), graph.mul(c, d)
        determinant = self.forms.simplified(graph.sub(*both))
        regular = not graph.varies[determinant] and np.all(np.abs(probes([determinant])) > GOOD * np.sum(np.abs(probes(both)), axis=0))
        return determinant if regular else None

    # rows combined

    def _by_column(self, single: tuple[int, int]) -> Pivot:
        """Combine all rows that contain a column into one for that column. If the `single` entry at that
        place is as good, return that entry instead.
        """
        graph, A, regular = self.graph, self.A, self._regular
        found = []
        for c in sorted(self.columns):
            users = [r for r in sorted(self.rows) if A[r][c] != graph.zero]
            if len(users) < 2:
                continue
            weights = self._weights(users)
            terms = [graph.mul(graph.const(w), graph.mul(A[r][c], A[r][c])) for r, w in zip(users, weights, strict=True)]
            squares = self.forms.simplified(graph.total(terms))
            size = sum(w * self._size(r) ** 2 for r, w in zip(users, weights, strict=True))
            with np.errstate(all="ignore"):
                worst = _least(np.sqrt(self._at([squares])[0] / size)[regular])
            fill = len({k for r in users for k in self.columns if A[r][k] != graph.zero}) * len(users)
            found.append((worst <= GOOD, graph.varies[squares], fill, -worst, c, users, weights, squares))
        if not found or -min(found)[3] <= _least(np.abs(self._beside_row(single))[regular]):
            return self._single(*single)
        *_, c, users, weights, squares = min(found)
        combined = self._turned if len(users) == 2 and len(self.rows) <= len(self.columns) else self._orthogonal
        return combined(c, users, weights, squares)

    def _weights(self, rows: list[int]) -> list[float]:
        """Return the weights of rows in a combination: one where their sizes are alike."""
        sizes = [float(np.nanmedian(self._size(r))) for r in rows]
        largest = max(sizes)
        # rows whose sizes differ by more are combined with weights
        if min(sizes) * 8.0 > largest:
            return [1.0] * len(rows)
        return [4.0 ** round(np.log2(largest / size)) if size > 0 else 1.0 for size in sizes]

    def _turned(self, c: int, users: list[int], weights: list[float], squares: int) -> Pivot:
        """Rotate two rows into one with the pivot and one without: `a r + w b s` and `b r - a s`; the
        determinant keeps its sign.
        """
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
        return self._single(r, c, graph.call("sqrt", squares))

    def _orthogonal(self, c: int, users: list[int], weights: list[float], squares: int) -> Pivot:
        """Combine all rows of a column into one new row, and make the other rows orthogonal to the column
        (Gram and Schmidt).
        """
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
        return self._single(new, c, graph.call("sqrt", squares))


def _ratios(values: Float[np.ndarray, "places probes"], places, sizes) -> np.ndarray:
    """Return the ratios of entries to the largest entry of their row, and to `sizes`. Entries of a row are
    contiguous.
    """
    values = np.abs(values)
    starts = np.flatnonzero([k == 0 or places[k][0] != places[k - 1][0] for k in range(len(places))])  # places come row by row
    largest = np.repeat(np.maximum.reduceat(values, starts), np.diff([*starts, len(places)]), axis=0)
    largest = largest if sizes is None else np.fmax(largest, sizes)
    with np.errstate(all="ignore"):
        return values / np.where(largest > 0, largest, 1.0)


def turns(graph: Graph, node: int) -> bool:
    """Return whether a node is the sine or cosine of a parameter, which may be any angle."""
    return graph.op[node] in ("sin", "cos") and graph.op[graph.args[node][0]] == "input" and not graph.varies[node]


def _least(ratio: Float[np.ndarray, "probes"]) -> float:
    """Return the smallest; zero where none is a number."""
    return float(np.min(ratio[np.isfinite(ratio)], initial=np.inf)) if np.isfinite(ratio).any() else 0.0


def products(graph: Graph, a: Sequence[int], rows) -> list[int]:
    """Return the products of a vector with some rows."""
    return [graph.dot(row, a) for row in rows]
