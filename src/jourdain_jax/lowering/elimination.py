"""Linear systems of nodes solved by unrolled elimination, with pivots chosen once.

A pivot that is a number or depends on parameters alone cannot vanish on the way and is taken first; the others are judged by the smallest
value they take, relative to their row, at all probes. Among good pivots the one that fills in least is taken.
"""

from dataclasses import dataclass

import numpy as np

from jourdain_jax.program.evaluate import Probes
from jourdain_jax.program.graph import Graph

GOOD = 0.02  # of a pivot, relative to its row, at the worst probe


@dataclass(frozen=True)
class Eliminated:
    """`solution[column][k]` of `A x_k = b_k`, and the pivots that may vanish: along the motion, or for some parameters."""

    solution: list[list[int]]
    pivots: list[int]


def eliminate(graph: Graph, A: list[list[int]], right: list[list[int]], probes: Probes) -> Eliminated:
    """Solve a system; `right[row]` holds the right-hand sides of that row. With more rows than unknowns, the best rows are used."""
    A, right = [list(row) for row in A], [list(row) for row in right]
    count = len(A[0]) if A else 0
    rows, columns = set(range(len(A))), set(range(count))
    order: list[tuple[int, int]] = []
    while columns:
        r, c = _best(graph, A, rows, columns, probes)
        rows.remove(r)
        columns.remove(c)
        order.append((r, c))
        inverse = graph.div(graph.one, A[r][c])
        for other in rows:
            if A[other][c] == graph.zero:
                continue
            factor = graph.mul(A[other][c], inverse)
            for k in columns:
                A[other][k] = graph.sub(A[other][k], graph.mul(factor, A[r][k]))
            right[other] = [graph.sub(a, graph.mul(factor, b)) for a, b in zip(right[other], right[r], strict=True)]
    solution: dict[int, list[int]] = {}
    for r, c in reversed(order):
        known = [(A[r][k], solution[k]) for k in solution if A[r][k] != graph.zero]
        rest = [graph.sub(b, graph.total(graph.mul(a, x[j]) for a, x in known)) for j, b in enumerate(right[r])]
        solution[c] = [quotient(graph, b, A[r][c]) for b in rest]
    return Eliminated([solution[c] for c in range(count)], [A[r][c] for r, c in order if graph.op[A[r][c]] != "const"])


def quotient(graph: Graph, a: int, b: int) -> int:
    """a/b, by the reciprocal of b where that is in the graph already."""
    return graph.mul(a, graph.div(graph.one, b))


def _best(graph: Graph, A, rows: set[int], columns: set[int], probes: Probes) -> tuple[int, int]:
    places = [(r, c) for r in sorted(rows) for c in sorted(columns) if A[r][c] != graph.zero]
    if not places:
        raise ZeroDivisionError("the rows are dependent")
    values = dict(zip(places, np.abs(probes(A[r][c] for r, c in places)), strict=True))
    largest = {r: np.max([v for (s, _), v in values.items() if s == r], axis=0) for r in {r for r, _ in places}}

    def cost(place):
        r, c = place
        with np.errstate(all="ignore"):
            ratio = values[place] / np.where(largest[r] > 0, largest[r], 1.0)
        worst = np.min(np.where(np.isfinite(ratio), ratio, 0.0))
        fill = (sum(A[r][k] != graph.zero for k in columns) - 1) * (sum(A[k][c] != graph.zero for k in rows) - 1)
        fixed = not graph.varies[A[r][c]] and worst > 0
        return (0, fill, not fixed, graph.operations([A[r][c]]), -worst) if fixed or worst > GOOD else (1, -worst)

    return min(places, key=cost)


def solve_symmetric(graph: Graph, M: list[list[int]], right: list[int], probes: Probes) -> list[int]:
    """`M^-1 right` for a symmetric positive definite M, as L D L'."""
    count = len(right)
    S, b = [list(row) for row in M], list(right)
    left = set(range(count))
    order: list[int] = []
    factors: dict[tuple[int, int], int] = {}
    while left:
        pivot = min(left, key=lambda k: (sum(S[k][j] != graph.zero for j in left), graph.varies[S[k][k]], graph.operations([S[k][k]])))
        left.remove(pivot)
        order.append(pivot)
        for i in sorted(left):
            if S[i][pivot] == graph.zero:
                continue
            factor = factors[i, pivot] = quotient(graph, S[i][pivot], S[pivot][pivot])
            for j in sorted(left):
                if j <= i and S[j][pivot] != graph.zero:
                    S[i][j] = S[j][i] = graph.sub(S[i][j], graph.mul(factor, S[j][pivot]))
            b[i] = graph.sub(b[i], graph.mul(factor, b[pivot]))
    x: dict[int, int] = {}
    for pivot in reversed(order):
        known = graph.total(graph.mul(factors[i, pivot], x[i]) for i in x if (i, pivot) in factors)
        x[pivot] = graph.sub(quotient(graph, b[pivot], S[pivot][pivot]), known)
    return [x[k] for k in range(count)]
