"""Accelerations of all speeds by privileged ones, on the graph: where M is singular or rows depend on each other, multipliers are not determined.

A udot = -drift:   udot = C ydot + c          by elimination of the dependent speeds, with as many rows as there are
C' M C ydot = C' (f - M c)                                                                             (41)
z <- z + dz,   A_z dz = -phi(t, q, u)         speeds put back onto the rows
"""

from jourdain_jax.lowering.elimination import eliminate, solve_symmetric
from jourdain_jax.lowering.multipliers import Accelerations, Columns
from jourdain_jax.program.derivative import columns
from jourdain_jax.program.graph import Graph


class Partition:
    """Speeds divided into the `independent` ones (numbers) and all others; pivots are judged at `probes` and, where needed, `far`."""

    def __init__(self, graph: Graph, independent, probes, far):
        self.graph, self.independent, self.probes, self.far = graph, tuple(independent), probes, far

    def _dependent(self, count: int) -> list[int]:
        return [k for k in range(count) if k not in self.independent]

    def accelerations(self, M: Columns, f: list[int], A: Columns, drift: list[int], forms=None) -> Accelerations:
        """The accelerations under all rows."""
        graph, speeds, dependent = self.graph, range(len(f)), self._dependent(len(f))
        simple = (lambda n: n) if forms is None else forms.simplified
        right = [[*(graph.neg(row[k]) for k in self.independent), graph.neg(d)] for row, d in zip(A, drift, strict=True)]
        found = eliminate(graph, [[row[k] for k in dependent] for row in A], right, self.probes, self.far)
        by_speed = {k: [simple(n) for n in row] for k, row in zip(dependent, found.solution, strict=True)}
        freedoms = range(len(self.independent))
        for i, k in enumerate(self.independent):
            by_speed[k] = [graph.one if j == i else graph.zero for j in (*freedoms, None)]
        *C, c = ([by_speed[k][j] for k in speeds] for j in (*freedoms, -1))
        rest = [graph.sub(force, graph.dot(row, c)) for force, row in zip(f, M, strict=True)]
        moved = [[graph.dot(row, column) for row in M] for column in C]  # M C
        inertia = [[graph.zero] * len(C) for _ in C]
        for i in freedoms:
            for j in range(i + 1):
                inertia[i][j] = inertia[j][i] = simple(graph.dot(C[i], moved[j]))
        ydot = solve_symmetric(graph, inertia, [[simple(graph.dot(column, rest)) for column in C]]).solution[0]
        return Accelerations([graph.add(graph.dot([column[k] for column in C], ydot), c[k]) for k in speeds], found.pivots, [], {})

    def projected_speeds(self, u: list[int], phi: list[int]) -> list[int]:
        """The speeds on `phi = 0`, the independent ones as they are."""
        graph, dependent = self.graph, self._dependent(len(u))
        by_speed = columns(graph, phi, [u[k] for k in dependent])
        A_z = [list(row) for row in zip(*by_speed, strict=True)]
        change = eliminate(graph, A_z, [[graph.neg(n)] for n in phi], self.probes, self.far).solution
        moved = list(u)
        for k, (dz,) in zip(dependent, change, strict=True):
            moved[k] = graph.add(u[k], dz)
        return moved
