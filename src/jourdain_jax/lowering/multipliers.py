"""Enforce constraints by multipliers, and project states, on the graph. All speeds stay in the state.

    M udot = f + A' lambda,   A udot = -drift          S lambda = -(drift + A M^-1 f),   S = A M^-1 A'
    q <- q - G' (G G')^-1 g(t, q)                      one step of Gauss-Newton; G = dg/dq
    u <- u - M^-1 A' S^-1 phi(t, q, u)                 exact if the constraints are affine in the speeds

S is symmetric, positive definite if the constraints are independent, and sparse: tridiagonal for a chain.
Elimination leaves a remainder of each diagonal entry of S. The ratio of remainder and entry is the squared
sine of the angle between this constraint and the earlier ones. If it is 1e-k, accelerations lose k digits.

A constraint whose row vanishes at some configuration has a small entry instead of a small angle. Entries are
therefore bounded from below by their size at a probe with the same parameters (`Probes.in_the_middle`). The
entry of a constraint that is nonlinear in the speeds may be small, though. Such a constraint becomes
undetermined where the remainder of its row, a row of L^-1 A, passes through zero and reverses.

If M is singular but every admissible velocity has inertia, `M + A' W A` with positive weights W replaces M.
This changes only the multipliers, because A udot is prescribed.

Enforce constraints if all speeds are in the state: by multipliers, or, if multipliers are not unique, by
independent speeds y:

    A udot = -drift:   udot = C ydot + c          by elimination of the dependent speeds z
    C' M C ydot = C' (f - M c)                                                                         (41)
    z <- z + dz,   A_z dz = -phi(t, q, u)         projection of the speeds
"""

from typing import NamedTuple

import numpy as np

from jourdain_jax.calculus.reals import largest, real_type, undecided
from jourdain_jax.lowering.elimination import eliminate, quotient, solve_symmetric
from jourdain_jax.program.derivative import matrix
from jourdain_jax.program.evaluate import Probes
from jourdain_jax.program.graph import Graph, NodeList
from jourdain_jax.program.polynomial import NormalForms
from jourdain_jax.structure.structure import Structure

Columns = list[NodeList]


class Accelerations(NamedTuple):
    """Accelerations and monitored quantities."""

    udot: NodeList
    sines: NodeList  # of angles between each constraint and the earlier ones; or pivots of independent speeds
    margins: NodeList  # remainder of each entry minus its lower limit; must stay positive
    directions: Columns = []  # of constraints; must not reverse within a step
    squares: NodeList = []  # for each constraint: the remainder of its entry, and its size


def accelerations_by_multipliers(
    graph: Graph,
    M: Columns,
    f: NodeList,
    A: Columns,
    drift: NodeList,
    probes: Probes,
    forms: NormalForms,
    *,
    affine: bool,
) -> Accelerations:
    """Return the accelerations that satisfy all constraints. `probes` give the typical sizes of entries;
    `affine`: whether constraints are affine in the speeds.
    """
    # columns of M^-1 A', and M^-1 f
    *impulses, free = (list(column) for column in solve_symmetric(graph, M, [*A, f]).solution)
    S = _products(graph, A, impulses, forms)
    for r in range(len(A)):
        alone = all(S[r][s] == graph.zero for s in range(len(A)) if s != r)
        if alone and not graph.varies[S[r][r]]:  # scale by the entry if this costs nothing
            impulses[r] = [forms.simplified(quotient(graph, n, S[r][r])) for n in impulses[r]]
            S[r][r] = graph.one
    right = [graph.neg(graph.add(d, graph.dot(row, free))) for d, row in zip(drift, A, strict=True)]
    solved = solve_symmetric(graph, S, [right] if affine else [right, *map(list, zip(*A, strict=True))])
    multipliers = solved.solution[0]
    udot = [graph.add(w, graph.dot(column, multipliers)) for w, *column in zip(free, *impulses, strict=True)]
    left = [(r, pivot) for r, pivot in enumerate(solved.pivots) if graph.varies[pivot]]
    sines = [
        graph.call("sqrt", graph.call("max", graph.zero, graph.div(pivot, S[r][r]))) for r, pivot in left
    ]
    # square of the smallest sine or relative length; below it, round-off decides how a motion continues
    least = graph.const(undecided(real_type()) ** 2)
    sizes = [graph.call("max", S[r][r], probes.in_the_middle(S[r][r])) for r, _ in left]
    margins = [graph.sub(pivot, graph.mul(least, size)) for (_, pivot), size in zip(left, sizes, strict=True)]
    if affine:
        squares = [n for (_, pivot), size in zip(left, sizes, strict=True) for n in (pivot, size)]
        return Accelerations(udot, sines, margins, squares=squares)
    signs = [[margin, *[graph.zero] * (len(f) - 1)] for margin in margins]
    rows = [[column[r] for column in solved.forward[1:]] for r, _ in left]
    return Accelerations(udot, sines, [], [*signs, *rows])


def with_inertia_of_rows(graph: Graph, M: Columns, A: Columns, probes: Probes) -> Columns:
    """Return `M + A' W A`, which is positive definite if every admissible velocity has inertia. The added
    inertia has about the size of M.
    """
    made, speeds = [list(row) for row in M], range(len(M))
    heavy = np.nanmedian(largest(probes([row[i] for i, row in enumerate(M)]), 0))
    for row in A:
        size = np.nanmedian(np.sum(probes(row) ** 2, axis=0))
        w = float(2.0 ** np.round(np.log2(heavy / size))) if size > 0 else 1.0
        weighted = [graph.mul(graph.const(w), n) for n in row]
        for i in (i for i in speeds if row[i] != graph.zero):
            for j in (j for j in speeds if row[j] != graph.zero):
                made[i][j] = graph.add(made[i][j], graph.mul(weighted[min(i, j)], row[max(i, j)]))
    return made


def projected_coordinates(graph: Graph, q: NodeList, closure: NodeList) -> NodeList:
    """Return the coordinates after one Gauss-Newton step towards `closure = 0`."""
    G = matrix(graph, closure, q)
    correction = solve_symmetric(graph, _products(graph, G, G, NormalForms(graph, 0)), [closure]).solution[0]
    return _less(graph, q, G, correction)


def projected_speeds(
    graph: Graph, M: Columns, A: Columns, u: NodeList, phi: NodeList, forms: NormalForms
) -> NodeList:
    """Return the speeds projected onto `phi = 0` in the metric of M."""
    impulses = solve_symmetric(graph, M, A).solution
    multipliers = solve_symmetric(graph, _products(graph, A, impulses, forms), [phi]).solution[0]
    return _less(graph, u, impulses, multipliers)


def _less(graph: Graph, x: NodeList, rows: Columns, factors: NodeList) -> NodeList:
    """Return `x - rows' factors`."""
    return [graph.sub(n, graph.dot(column, factors)) for n, *column in zip(x, *rows, strict=True)]


def _products(graph: Graph, A: Columns, X: Columns, forms: NormalForms) -> Columns:
    """Return the symmetric product `A X'`."""
    S = [[graph.zero] * len(A) for _ in A]
    used = [[k for k, n in enumerate(row) if n != graph.zero] for row in A]
    for r in range(len(A)):
        for s in range(r + 1):
            S[r][s] = S[s][r] = forms.simplified(graph.total(graph.mul(A[r][k], X[s][k]) for k in used[r]))
    return S


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
