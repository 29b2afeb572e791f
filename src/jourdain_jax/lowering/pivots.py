"""Choose pivots to eliminate a linear system of nodes, such that they are large wherever the system itself is
regular.

A pivot that is constant, or that depends only on parameters and vanishes for no values of their declared
signs, is taken first. A pivot that vanishes for some parameters is taken last.
Other pivots are rated by their smallest value over all probes, relative to their row. Among good pivots, the
one with the least fill-in is taken. If only entries that may vanish remain, two rows and two columns are
eliminated together if their determinant cannot vanish. For example, the velocity of a hitch in rotated axes
gives entries that each vanish at some angle, but their determinant depends only on parameters.

If no order of elimination works, rows are combined. The rows with entries `a_1, a_2, ...` in one column give
one row with the pivot `sum w_i a_i^2`, and the other rows are made orthogonal to it. For example, the
constraints of a rolling wheel along the world axes become constraints along and across its heading. In exact
arithmetic, such a pivot is the squared distance of its column from the span of the earlier columns, and at
least the square of the smallest singular value. There may be more rows than unknowns, and each row may vanish
somewhere.
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

GOOD = 0.02  # numerics: smallest acceptable pivot, relative to its row, at the worst probe
# tuning: for at most this number of equations, the choice of a pivot depends on its number of operations
FEW = 12


@dataclass(frozen=True)
class Pivot:
    """Rows and columns eliminated together: one of each, or two."""

    rows: Indices
    columns: Indices
    inverse: tuple[Indices, ...]  # of A[rows][columns]
    monitored: int  # must not vanish


@dataclass(frozen=True)
class _Entry:
    """Quality of an entry as a pivot."""

    worst: float  # size relative to its row, at the worst probe
    fixed: bool  # depends only on parameters, and vanishes for none


class Pivots:
    """System `A x = right` during elimination, which chooses the next pivot. `probes`: states in the domain;
    `far`: function that returns states with angles over full turns.
    """

    def __init__(
        self,
        graph: Graph,
        A: Sequence[Sequence[int]],
        right: Sequence[Sequence[int]],
        probes: Probes,
        far: Callable[[], Probes] | None,
    ):
        # determinants in normal form have at most 32 terms
        self.graph, self.probes, self.forms = graph, probes, NormalForms(graph, 32, sign=probes.sign)
        self.A, self.right = [list(row) for row in A], [list(row) for row in right]
        self.rows, self.columns = set(range(len(self.A))), set(range(len(self.A[0]) if self.A else 0))
        self._far, self._kept_regular = far, None
        self._given, self._anywhere = [list(row) for row in A], _of_any_parameters(graph)
        self._tall = len(self.rows) > len(self.columns)
        self._sizes: dict[int, np.ndarray] = {}  # size of the terms of each row
        self._entries: dict[int, list[int]] = {}  # columns with structurally nonzero entries, by row
        self._judged: dict[int, dict[int, _Entry]] = {}
        # determinant by its four entries; None if it is not acceptable as a pivot
        self._determinants: dict[tuple[int, int, int, int], int | None] = {}

    def eliminated(self, pivot: Pivot) -> None:
        """Subtract multiples of the pivot rows from the remaining rows."""
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
                self.right[other] = [
                    graph.sub(a, graph.mul(factor, b))
                    for a, b in zip(self.right[other], self.right[r], strict=True)
                ]

    def _changed(self, *rows: int) -> None:
        """Clear cached results of these rows; without arguments, of all rows."""
        for row in rows or list(self._entries):
            self._entries.pop(row, None)
            self._judged.pop(row, None)

    def _in_row(self, row: int) -> list[int]:
        """Return the remaining columns with nonzero entries in a row, in order."""
        if row not in self._entries:
            self._entries[row] = [k for k, n in enumerate(self.A[row]) if n != self.graph.zero]
        return [k for k in self._entries[row] if k in self.columns]

    def best(self) -> Pivot:
        """Return the next pivot, combining rows if necessary."""
        graph, A, rows = self.graph, self.A, self.rows
        judged = [(r, c, entry) for r in sorted(rows) for c, entry in self._judged_row(r).items()]
        if not judged:
            raise ZeroDivisionError("the constraints are dependent")
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
        serving = next(
            ((r, c) for r, c, entry in good if entry.fixed or self._regular_everywhere((r, c))), None
        )
        if serving is not None:
            return self._single(*serving)
        r, c, _ = good[0] if good else max(judged, key=lambda place: place[2].worst)
        return self._by_column((r, c))

    def _judged_row(self, row: int) -> dict[int, "_Entry"]:
        """Return the quality of the entries of a row, by column. It is cached until the row changes."""
        if row not in self._judged or not self.columns.issuperset(self._judged[row]):
            columns = self._in_row(row)
            nodes, places = [self.A[row][c] for c in columns], [(row, c) for c in columns]
            ratio = np.empty((0, 1))
            if columns:
                ratio = _ratios(self.probes(nodes), places, self._sizes_at(places, self.probes.count))
                ratio[[self._may_vanish(n) for n in nodes]] = 0.0
            worst = np.min(np.where(np.isfinite(ratio), ratio, 0.0), axis=1)  # at any probe
            self._judged[row] = {
                c: _Entry(w, bool(w > 0) and not self.graph.varies[n])
                for c, n, w in zip(columns, nodes, worst, strict=True)
            }
        return self._judged[row]

    def _may_vanish(self, node: int) -> bool:
        """Return whether a node depends only on parameters and vanishes for some values of them."""
        return not (self.graph.varies[node] or self._anywhere.sign(node))

    def _single(self, row: int, column: int, monitored: int | None = None) -> Pivot:
        entry = self.A[row][column]
        inverse = ((self.graph.div(self.graph.one, entry),),)
        return Pivot((row,), (column,), inverse, entry if monitored is None else monitored)

    # quality at probes in the domain, and at far probes at which the system itself is regular

    def _regular_everywhere(self, place: tuple[int, int]) -> bool:
        """Return whether an entry is far from zero wherever the system is regular, even beyond the domain."""
        ratio = self._beside_row(place)
        ratio = ratio[self._regular & np.isfinite(ratio)]
        size = np.min(np.abs(ratio), initial=np.inf)
        # an entry with both signs that is below 0.25 somewhere is assumed to vanish
        return bool(size > 0.25 or (size > GOOD and not ratio.min() < 0 < ratio.max()))

    def _beside_row(self, place: tuple[int, int]) -> Float[np.ndarray, "probes"]:
        """Return an entry, with its sign, relative to the largest entry of its row."""
        r, c = place
        columns = [k for k in sorted(self.columns) if self.A[r][k] != self.graph.zero]
        places, values = [(r, k) for k in columns], self._at([self.A[r][k] for k in columns])
        k = columns.index(c)
        ratio = np.sign(values[k]) * _ratios(values, places, self._sizes_at(places))[k]
        return np.where(self._may_vanish(self.A[r][c]), 0.0, ratio)

    @property
    def _regular(self) -> np.ndarray:
        """Return at which probes, in the domain and far from it, the system with scaled rows and columns is
        regular.
        """
        if self._kept_regular is None:
            count = len(self._given[0])
            values = self._at([n for row in self._given for n in row])
            A = np.moveaxis(values.reshape(len(self._given), count, -1), -1, 0)
            finite = all_finite(A, axis=(1, 2))
            A = np.where(finite[:, None, None], A, 0.0)
            lengths = np.linalg.norm(A, axis=2, keepdims=True)
            usual = np.median(lengths[finite], axis=0, keepdims=True) if finite.any() else lengths[:1]
            A = A / np.where(usual > 0, usual, 1.0)
            width = np.sqrt(np.mean(np.sum(A**2, axis=1), axis=0))
            sigma = np.linalg.svd(A / np.where(width > 0, width, 1.0), compute_uv=False)[:, count - 1]
            # smallest singular value at which a scaled system counts as regular
            self._kept_regular = finite & (sigma > 0.02)
        return self._kept_regular

    def _at(self, nodes) -> np.ndarray:
        """Return values at the probes in the domain, followed by the far probes."""
        near = self.probes(nodes)
        return near if self._far is None else np.concatenate([near, self._far()(nodes)], axis=1)

    def _size(self, row: int) -> np.ndarray:
        """Return the size of the terms that sum up to a row, at all probes."""
        if row not in self._sizes:
            self._sizes[row] = largest(self._at(self.A[row]), 0)
        return self._sizes[row]

    def _sizes_at(self, places, count: int | None = None) -> np.ndarray | None:
        """Return reference sizes for the rows of some entries at the first `count` probes. Return None if the
        system does not have more rows than unknowns, because a vanishing row then makes it singular.
        """
        if not self._tall:
            return None
        return np.stack([np.fmax(self._size(r), np.nanmedian(self._size(r)))[:count] for r, _ in places])

    # two rows and two columns

    def _best_pair(self) -> Pivot | None:
        """Return two rows and two columns whose determinant depends only on parameters, with the least
        fill-in; None if there are none.
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
        inverse = (over[0], graph.neg(over[1])), (graph.neg(over[2]), over[3])
        return Pivot((r, s), (c, d), inverse, determinant)

    def _determinant_of(self, a: int, b: int, c: int, d: int) -> int | None:
        """Return a b - c d if it depends only on parameters and is not small; otherwise None."""
        graph, probes = self.graph, self.probes
        both = graph.mul(a, b), graph.mul(c, d)
        determinant = self.forms.simplified(graph.sub(*both))
        lasting = not (graph.varies[determinant] or self._may_vanish(determinant))
        regular = lasting and np.all(
            np.abs(probes([determinant])) > GOOD * np.sum(np.abs(probes(both)), axis=0)
        )
        return determinant if regular else None

    # combined rows

    def _by_column(self, single: tuple[int, int]) -> Pivot:
        """Return a pivot in a row that combines all rows with an entry in one column, or the entry at
        `single` if it is at least as good.
        """
        graph, A, regular = self.graph, self.A, self._regular
        found = []
        for c in sorted(self.columns):
            users = [r for r in sorted(self.rows) if A[r][c] != graph.zero]
            if len(users) < 2:
                continue
            weights = self._weights(users)
            terms = [
                graph.mul(graph.const(w), graph.mul(A[r][c], A[r][c]))
                for r, w in zip(users, weights, strict=True)
            ]
            squares = self.forms.simplified(graph.total(terms))
            size = sum(w * self._size(r) ** 2 for r, w in zip(users, weights, strict=True))
            with np.errstate(all="ignore"):
                worst = _least(np.sqrt(self._at([squares])[0] / size)[regular])
            fill = len({k for r in users for k in self.columns if A[r][k] != graph.zero}) * len(users)
            found.append((worst <= GOOD, graph.varies[squares], fill, -worst, c, users, weights, squares))
        if not found or -min(found)[3] <= _least(np.abs(self._beside_row(single))[regular]):
            return self._single(*single)
        *_, c, users, weights, squares = min(found)
        two = len(users) == 2 and len(self.rows) <= len(self.columns)
        return (self._turned if two else self._orthogonal)(c, users, weights, squares)

    def _weights(self, rows: list[int]) -> list[float]:
        """Return weights for combining rows: all one if their sizes are similar."""
        sizes = [float(np.nanmedian(self._size(r))) for r in rows]
        largest = max(sizes)
        # rows are scaled if their sizes differ by more than a factor of eight
        if min(sizes) * 8.0 > largest:
            return [1.0] * len(rows)
        return [4.0 ** round(np.log2(largest / size)) if size > 0 else 1.0 for size in sizes]

    def _turned(self, c: int, users: list[int], weights: list[float], squares: int) -> Pivot:
        """Replace the rows r, s, which have entries a, b in column c, by the pivot row `w_r a r + w_s b s`,
        with weights w, and by `b r - a s`.
        """
        graph, A, (r, s) = self.graph, self.A, users
        a, b = A[r][c], A[s][c]
        first, second = (graph.mul(graph.const(w), n) for w, n in zip(weights, (a, b), strict=True))
        sizes = [np.abs(self._at([a])[0]), np.abs(self._at([b])[0])]
        of_r, of_s = self._size(r), self._size(s)
        self._sizes[r] = weights[0] * sizes[0] * of_r + weights[1] * sizes[1] * of_s
        self._sizes[s] = sizes[1] * of_r + sizes[0] * of_s
        for row in (A, self.right):
            pairs = list(zip(row[r], row[s], strict=True))
            row[r] = [
                self.forms.simplified(graph.add(graph.mul(first, x), graph.mul(second, y))) for x, y in pairs
            ]
            row[s] = [self.forms.simplified(graph.sub(graph.mul(b, x), graph.mul(a, y))) for x, y in pairs]
        A[r][c], A[s][c] = squares, graph.zero
        self._changed()
        return self._single(r, c, graph.call("sqrt", squares))

    def _orthogonal(self, c: int, users: list[int], weights: list[float], squares: int) -> Pivot:
        """Add a row that combines all rows with an entry in a column, and eliminate the entry from these rows
        (Gram-Schmidt).
        """
        graph, A = self.graph, self.A
        new = len(A)
        over = graph.div(graph.one, squares)
        entries = [
            (r, graph.mul(graph.const(w), A[r][c]), A[r][c]) for r, w in zip(users, weights, strict=True)
        ]
        self._sizes[new] = sum(np.abs(self._at([wa])[0]) * self._size(r) for r, wa, _ in entries)
        for row in (A, self.right):
            made = [
                self.forms.simplified(graph.total(graph.mul(wa, row[r][k]) for r, wa, _ in entries))
                for k in range(len(row[users[0]]))
            ]
            row.append(made)
        for r, _, a in entries:
            factor = graph.mul(a, over)
            self._sizes[r] = self._size(r) + np.abs(self._at([factor])[0]) * self._sizes[new]
            for row in (A, self.right):
                row[r] = [
                    self.forms.simplified(graph.sub(x, graph.mul(factor, p)))
                    for x, p in zip(row[r], row[new], strict=True)
                ]
            A[r][c] = graph.zero
        A[new][c] = squares
        self._changed()
        self.rows.add(new)
        self._tall = True
        return self._single(new, c, graph.call("sqrt", squares))


def _ratios(values: Float[np.ndarray, "places probes"], places, sizes) -> np.ndarray:
    """Return the ratios of entries to the largest entry of their row, or to `sizes` if these are larger.
    Entries of a row are contiguous.
    """
    values = np.abs(values)
    # places are ordered by rows
    starts = np.flatnonzero([k == 0 or places[k][0] != places[k - 1][0] for k in range(len(places))])
    largest = np.repeat(np.maximum.reduceat(values, starts), np.diff([*starts, len(places)]), axis=0)
    largest = largest if sizes is None else np.fmax(largest, sizes)
    with np.errstate(all="ignore"):
        return values / np.where(largest > 0, largest, 1.0)


def _of_any_parameters(graph: Graph) -> Probes:
    """Return probes with parameters of any size and, unless they are declared positive, any sign."""
    draws = np.random.default_rng(2)
    size = lambda: 10.0 ** draws.uniform(-3.0, 3.0, 64)
    sign = lambda node: 1.0 if node in graph.positive else draws.choice([-1.0, 0.0, 1.0], 64)
    inputs = (n for n, op in enumerate(graph.op) if op == "input" and not graph.varies[n])
    return Probes(graph, {graph.value[n]: sign(n) * size() for n in inputs})


def turns(graph: Graph, node: int) -> bool:
    """Return whether a node is the sine or cosine of a parameter, which may be any angle."""
    of_input = graph.op[node] in ("sin", "cos") and graph.op[graph.args[node][0]] == "input"
    return of_input and not graph.varies[node]


def _least(ratio: Float[np.ndarray, "probes"]) -> float:
    """Return the smallest finite ratio; zero if there is none."""
    return float(np.min(ratio[np.isfinite(ratio)], initial=np.inf)) if np.isfinite(ratio).any() else 0.0


def products(graph: Graph, a: Sequence[int], rows) -> list[int]:
    """Return the products of a vector with some rows."""
    return [graph.dot(row, a) for row in rows]
