"""Solve linear systems of nodes by unrolled elimination, with pivots chosen once (`pivots.py`)."""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float

from jourdain_jax.equations.reductions import SMALLEST_PIVOT
from jourdain_jax.lowering.pivots import FEW, Pivot, Pivots, products
from jourdain_jax.program.evaluate import Probes
from jourdain_jax.program.graph import Graph
from jourdain_jax.program.identity_test import IdentityProbes

Rows = list[list[int]]  # rows of a matrix whose entries are nodes


@dataclass(frozen=True)
class Eliminated:
    """Solution of `A x_k = b_k` as `solution[column][k]`, and the pivots, which may vanish along the motion
    or for some parameters.
    """

    solution: Rows
    pivots: list[int]
    forward: Rows = field(default_factory=list)  # for a symmetric system, `L^-1 right`


def pivots_ok(pivots: list[int], probes: Probes | IdentityProbes) -> Bool[np.ndarray, "probes"]:
    """Return at which probes division by these pivots is accurate: none is far below its typical size."""
    sizes = np.abs(probes(pivots))
    return np.all(sizes > SMALLEST_PIVOT * usual(sizes)[:, None], axis=0)


def usual(sizes: Float[np.ndarray, "nodes probes"]) -> Float[np.ndarray, "nodes"]:
    """Return the median of each value over the probes at which it is defined; NaN if there are none."""
    known = np.any(~np.isnan(sizes), axis=1)
    found = np.full(len(sizes), np.nan)
    found[known] = np.nanmedian(sizes[known], axis=1)
    return found


def eliminate(
    graph: Graph, A: Rows, right: Rows, probes: Probes, far: Callable[[], Probes] | None
) -> Eliminated:
    """Solve a linear system by elimination. `right[row]`: right-hand sides of a row. If there are more rows
    than unknowns, the system must be consistent.

    `far`: function that returns probes with angles over full turns; it is called only if needed.
    """
    system = Pivots(graph, A, right, probes, far)
    count = len(system.columns)
    order: list[Pivot] = []
    while system.columns:
        order.append(system.best())
        system.eliminated(order[-1])
    solution: dict[int, list[int]] = {}
    for pivot in reversed(order):
        rest = []
        for r in pivot.rows:
            row = system.A[r]
            known = [(row[k], x) for k, x in solution.items() if row[k] != graph.zero]
            less = lambda j, known=known: graph.total(graph.mul(a, x[j]) for a, x in known)
            rest.append([graph.sub(b, less(j)) for j, b in enumerate(system.right[r])])
        found = [products(graph, b, pivot.inverse) for b in zip(*rest, strict=True)]
        values = map(list, zip(*found, strict=True)) if found else ([] for _ in pivot.columns)
        solution |= zip(pivot.columns, values, strict=True)
    monitored = [pivot.monitored for pivot in order if graph.op[pivot.monitored] != "const"]
    return Eliminated([solution[c] for c in range(count)], monitored)


def quotient(graph: Graph, a: int, b: int) -> int:
    """Return a/b as the product of a and the reciprocal of b, because several quotients can share the
    reciprocal.
    """
    return graph.mul(a, graph.div(graph.one, b))


def solve_symmetric(graph: Graph, M: Rows, right: Rows) -> Eliminated:
    """Solve a system with a symmetric positive definite matrix M by factorisation L D L'. `right` and the
    solution have one list per column; the pivots are D.
    """
    count = len(M)
    S, columns = [list(row) for row in M], [list(column) for column in right]
    left = set(range(count))
    order: list[int] = []
    factors: dict[int, dict[int, int]] = {}  # column of L, by pivot

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
    return Eliminated(solution, [S[k][k] for k in range(count)], columns)
