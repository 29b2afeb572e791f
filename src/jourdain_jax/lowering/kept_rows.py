"""Enforce constraints if all speeds are in the state: by multipliers, or, if multipliers are not unique, by
independent speeds y:

    A udot = -drift:   udot = C ydot + c          by elimination of the dependent speeds z
    C' M C ydot = C' (f - M c)                                                                         (41)
    z <- z + dz,   A_z dz = -phi(t, q, u)         projection of the speeds
"""

from jourdain_jax.lowering.elimination import eliminate, solve_symmetric
from jourdain_jax.lowering.multipliers import (
    Accelerations,
    Columns,
    accelerations_by_multipliers,
    projected_speeds,
    with_inertia_of_rows,
)
from jourdain_jax.program.derivative import matrix
from jourdain_jax.program.graph import Graph, NodeList
from jourdain_jax.program.polynomial import NormalForms
from jourdain_jax.structure.structure import Structure


class KeptRows:
    """Method to enforce constraints if all speeds are in the state. `massless`: whether M may be singular;
    `probes` and, if needed, `far`: states at which the pivots of independent speeds are examined.
    """

    def __init__(self, graph: Graph, structure: Structure, massless: bool, probes, far):
        self.graph, self.probes, self.far, self.independent = graph, probes, far, structure.independent
        self.by_partition = (massless or structure.dependent_rows) and structure.well_conditioned
        self.massless, self.affine = massless and not self.by_partition, structure.affine

    @property
    def description(self) -> str:
        """Describe the method for the summary."""
        if self.by_partition:
            return "all speeds in the state, accelerations from the independent ones"
        return "constraints enforced by multipliers" + (
            ", with inertia added along the constraints" if self.massless else ""
        )

    def accelerations(
        self, M: Columns, f: NodeList, A: Columns, drift: NodeList, forms: NormalForms
    ) -> Accelerations:
        """Return the accelerations that satisfy all constraints, and the monitored pivots."""
        if self.by_partition:
            return self._accelerations_by_partition(M, f, A, drift, forms)
        return accelerations_by_multipliers(
            self.graph, self._inertia(M, A), f, A, drift, self.probes, forms, affine=self.affine
        )

    def projected_speeds(self, M: Columns, u: NodeList, phi: NodeList, forms: NormalForms) -> NodeList:
        """Return the speeds projected onto `phi = 0`."""
        A = matrix(self.graph, phi, u)
        if not self.by_partition:
            return projected_speeds(self.graph, self._inertia(M, A), A, u, phi, forms)
        dependent, moved = self._dependent(len(u)), list(u)
        A_z, right = [[row[k] for k in dependent] for row in A], [[self.graph.neg(n)] for n in phi]
        change = eliminate(self.graph, A_z, right, self.probes, self.far).solution
        for k, (dz,) in zip(dependent, change, strict=True):
            moved[k] = self.graph.add(u[k], dz)
        return moved

    def _dependent(self, count: int) -> NodeList:
        return [k for k in range(count) if k not in self.independent]

    def _accelerations_by_partition(
        self, M: Columns, f: NodeList, A: Columns, drift: NodeList, forms: NormalForms
    ) -> Accelerations:
        graph, speeds, dependent = self.graph, range(len(f)), self._dependent(len(f))
        right = [
            [*(graph.neg(row[k]) for k in self.independent), graph.neg(d)]
            for row, d in zip(A, drift, strict=True)
        ]
        found = eliminate(graph, [[row[k] for k in dependent] for row in A], right, self.probes, self.far)
        by_speed = {k: forms.all_simplified(row) for k, row in zip(dependent, found.solution, strict=True)}
        freedoms = range(len(self.independent))
        for i, k in enumerate(self.independent):
            by_speed[k] = [graph.one if j == i else graph.zero for j in (*freedoms, None)]
        *C, c = ([by_speed[k][j] for k in speeds] for j in (*freedoms, -1))
        rest = [graph.sub(force, graph.dot(row, c)) for force, row in zip(f, M, strict=True)]
        moved = [[graph.dot(row, column) for row in M] for column in C]  # M C
        inertia = [[graph.zero] * len(C) for _ in C]
        for i in freedoms:
            for j in range(i + 1):
                inertia[i][j] = inertia[j][i] = forms.simplified(graph.dot(C[i], moved[j]))
        force = [forms.simplified(graph.dot(column, rest)) for column in C]
        ydot = solve_symmetric(graph, inertia, [force]).solution[0]
        udot = [graph.add(graph.dot([column[k] for column in C], ydot), c[k]) for k in speeds]
        return Accelerations(udot, found.pivots, [])

    def _inertia(self, M: Columns, A: Columns) -> Columns:
        return with_inertia_of_rows(self.graph, M, A, self.probes) if self.massless else M
