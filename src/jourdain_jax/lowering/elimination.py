"""Linear systems of nodes solved by unrolled elimination, with pivots chosen once.

A pivot that is a number or depends on parameters alone cannot vanish on the way and is taken first; the others are judged by the smallest
value they take, relative to their row, at all probes. Among good pivots the one that fills in least is taken. Where only entries that may
vanish are left, two rows and two columns are eliminated together if their determinant cannot vanish: components of a vector in turned axes, such as
the velocity of a hitch, have one that depends on parameters alone, while each entry is zero at some angle.
"""

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from jaxtyping import Bool, Float

from jourdain_jax.equations.reductions import SMALLEST_PIVOT
from jourdain_jax.program.evaluate import Probes
from jourdain_jax.program.graph import Graph
from jourdain_jax.program.polynomial import NormalForms

GOOD = 0.02  # of a pivot, relative to its row, at the worst probe
TERMS = 32  # of a determinant in normal form
FEW = 12  # equations: with more, the operations that lead to a pivot are not counted when it is chosen


@dataclass(frozen=True)
class Eliminated:
    """`solution[column][k]` of `A x_k = b_k`, and the pivots that may vanish: along the motion, or for some parameters."""

    solution: list[list[int]]
    pivots: list[int]


@dataclass(frozen=True)
class Pivot:
    """Rows and columns eliminated together: one of each, or two."""

    rows: tuple[int, ...]
    columns: tuple[int, ...]
    inverse: tuple[tuple[int, ...], ...]  # of A[rows][columns]
    determinant: int


def serves(pivots: list[int], probes: Probes) -> Bool[np.ndarray, "probes"]:
    """At which probes what was divided by these pivots is more than round-off: none of them is small beside its usual size."""
    sizes = np.abs(probes(pivots))
    return np.all(sizes > SMALLEST_PIVOT * usual(sizes)[:, None], axis=0)


def usual(sizes: Float[np.ndarray, "nodes probes"]) -> Float[np.ndarray, "nodes"]:
    """The median of each over the probes at which it is a number; NaN where it is none at any."""
    known = np.any(~np.isnan(sizes), axis=1)
    found = np.full(len(sizes), np.nan)
    found[known] = np.nanmedian(sizes[known], axis=1)
    return found


def eliminate(graph: Graph, A: list[list[int]], right: list[list[int]], probes: Probes) -> Eliminated:
    """Solve a system; `right[row]` holds the right-hand sides of that row. With more rows than unknowns, the best rows are used."""
    A, right = [list(row) for row in A], [list(row) for row in right]
    count = len(A[0]) if A else 0
    rows, columns = set(range(len(A))), set(range(count))
    forms = NormalForms(graph, TERMS, sign=probes.sign)
    order: list[Pivot] = []
    while columns:
        pivot = _best(graph, A, rows, columns, probes, forms)
        rows -= set(pivot.rows)
        columns -= set(pivot.columns)
        order.append(pivot)
        for other in rows:
            factors = _products(graph, [A[other][c] for c in pivot.columns], zip(*pivot.inverse, strict=True))
            for factor, r in zip(factors, pivot.rows, strict=True):
                if factor == graph.zero:
                    continue
                for k in (k for k in columns if A[r][k] != graph.zero):
                    A[other][k] = graph.sub(A[other][k], graph.mul(factor, A[r][k]))
                right[other] = [graph.sub(a, graph.mul(factor, b)) for a, b in zip(right[other], right[r], strict=True)]
    solution: dict[int, list[int]] = {}
    for pivot in reversed(order):
        rest = [
            [graph.sub(b, graph.total(graph.mul(A[r][k], x[j]) for k, x in solution.items() if A[r][k] != graph.zero)) for j, b in enumerate(right[r])]
            for r in pivot.rows
        ]
        found = [_products(graph, b, pivot.inverse) for b in zip(*rest, strict=True)]
        solution |= dict(zip(pivot.columns, map(list, zip(*found, strict=True)), strict=True)) if found else {c: [] for c in pivot.columns}
    return Eliminated([solution[c] for c in range(count)], [pivot.determinant for pivot in order if graph.op[pivot.determinant] != "const"])


def _products(graph: Graph, a: Sequence[int], rows: Iterable[Sequence[int]]) -> list[int]:
    """The products of a vector with some rows."""
    return [graph.dot(row, a) for row in rows]


def quotient(graph: Graph, a: int, b: int) -> int:
    """a/b, by the reciprocal of b where that is in the graph already."""
    return graph.mul(a, graph.div(graph.one, b))


def _best(graph: Graph, A, rows: set[int], columns: set[int], probes: Probes, forms: NormalForms) -> Pivot:
    places = [(r, c) for r in sorted(rows) for c in sorted(columns) if A[r][c] != graph.zero]
    if not places:
        raise ZeroDivisionError("the rows are dependent")
    nodes = [A[r][c] for r, c in places]
    in_row, in_column = Counter(r for r, _ in places), Counter(c for _, c in places)
    values = np.abs(probes(nodes))
    starts = np.flatnonzero([k == 0 or places[k][0] != places[k - 1][0] for k in range(len(places))])  # places come row by row
    largest = np.repeat(np.maximum.reduceat(values, starts), np.diff([*starts, len(places)]), axis=0)
    with np.errstate(all="ignore"):
        ratio = values / np.where(largest > 0, largest, 1.0)
    worst = np.min(np.where(np.isfinite(ratio), ratio, 0.0), axis=1)
    fixed = [not graph.varies[n] and w > 0 for n, w in zip(nodes, worst, strict=True)]
    good = [k for k in range(len(places)) if fixed[k] or worst[k] > GOOD]

    def cost(k):
        r, c = places[k]
        fill = (in_row[r] - 1) * (in_column[c] - 1)
        return fill, not fixed[k], graph.operations([nodes[k]]) if len(rows) <= FEW else 0, -worst[k]

    best = min(good, key=cost) if good else int(np.argmax(worst))
    pair = None if fixed[best] else _best_pair(graph, A, rows, columns, probes, forms)
    return pair or _single(graph, *places[best], nodes[best])


def _single(graph: Graph, row: int, column: int, entry: int) -> Pivot:
    return Pivot((row,), (column,), ((graph.div(graph.one, entry),),), entry)


def _best_pair(graph: Graph, A, rows: set[int], columns: set[int], probes: Probes, forms: NormalForms) -> Pivot | None:
    """Two rows and columns whose determinant depends on parameters alone, with the least fill-in; None where there are none."""
    used = {r: {c for c in columns if A[r][c] != graph.zero} for r in rows}
    users = {c: [r for r in sorted(rows) if c in used[r]] for c in columns}
    found = []
    for r, s in sorted({pair for c in columns for pair in combinations(users[c], 2)}):
        for c, d in combinations(sorted(used[r] & used[s]), 2):
            products = graph.mul(A[r][c], A[s][d]), graph.mul(A[r][d], A[s][c])
            determinant = forms.simplified(graph.sub(*products))
            if not graph.varies[determinant] and np.all(np.abs(probes([determinant])) > GOOD * np.sum(np.abs(probes(products)), axis=0)):
                fill = (len(used[r] | used[s]) - 2) * len({*users[c], *users[d]} - {r, s})
                found.append((fill, r, s, c, d, determinant))
    if not found:
        return None
    _, r, s, c, d, determinant = min(found)
    over = [graph.div(n, determinant) for n in (A[s][d], A[r][d], A[s][c], A[r][c])]
    return Pivot((r, s), (c, d), ((over[0], graph.neg(over[1])), (graph.neg(over[2]), over[3])), determinant)


def solve_symmetric(graph: Graph, M: list[list[int]], right: list[list[int]]) -> Eliminated:
    """`M^-1 right` for a symmetric positive definite M, as L D L'; `right` holds columns, and so does the solution. The pivots are D."""
    count = len(M)
    S, columns = [list(row) for row in M], [list(column) for column in right]
    left = set(range(count))
    order: list[int] = []
    factors: dict[int, dict[int, int]] = {}  # column of L by pivot

    def cost(k):
        fill = sum(S[k][j] != graph.zero for j in left)
        return fill, graph.varies[S[k][k]], graph.operations([S[k][k]]) if count <= FEW else 0

    while left:
        pivot = min(left, key=cost)
        left.remove(pivot)
        order.append(pivot)
        below = [i for i in sorted(left) if S[i][pivot] != graph.zero]
        factors[pivot] = {i: quotient(graph, S[i][pivot], S[pivot][pivot]) for i in below}
        for i in below:
            for j in below:
                if j <= i:
                    S[i][j] = S[j][i] = graph.sub(S[i][j], graph.mul(factors[pivot][i], S[j][pivot]))
            for b in columns:
                b[i] = graph.sub(b[i], graph.mul(factors[pivot][i], b[pivot]))
    solution = []
    for b in columns:
        x: dict[int, int] = {}
        for pivot in reversed(order):
            known = graph.total(graph.mul(factor, x[i]) for i, factor in factors[pivot].items())
            x[pivot] = graph.sub(quotient(graph, b[pivot], S[pivot][pivot]), known)
        solution.append([x[k] for k in range(count)])
    return Eliminated(solution, [S[k][k] for k in range(count)])
