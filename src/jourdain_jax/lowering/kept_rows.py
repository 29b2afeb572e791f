"""Rows that are kept while all speeds stay in the state: by multipliers, or by privileged speeds where multipliers are not determined."""

import numpy as np

from jourdain_jax.build.structure import Structure
from jourdain_jax.lowering.multipliers import Accelerations, Columns, accelerations_by_multipliers, projected_speeds, with_inertia_of_rows
from jourdain_jax.lowering.partition import Partition
from jourdain_jax.program.derivative import columns
from jourdain_jax.program.graph import Graph


class KeptRows:
    """How they are kept. `massless`: M may be singular; `probes`, `far`: as in `Partition`."""

    def __init__(self, graph: Graph, structure: Structure, massless: bool, probes, far):
        self.graph, self.probes = graph, probes
        self.by_partition = (massless or structure.dependent_rows) and structure.well_conditioned
        self.massless = massless and not self.by_partition
        self._partition = Partition(graph, structure.independent, probes, far)

    @property
    def description(self) -> str:
        """In words."""
        if self.by_partition:
            return "all speeds in the state, their accelerations by privileged ones"
        return "rows kept by multipliers, by elimination" + (", with inertia along the rows" if self.massless else "")

    def accelerations(self, M: Columns, f: list[int], A: Columns, drift: list[int], forms=None) -> Accelerations:
        """The accelerations under all rows, and what must not vanish on the way."""
        if self.by_partition:
            return self._partition.accelerations(M, f, A, drift, forms)
        return accelerations_by_multipliers(self.graph, self._inertia(M, A), f, A, drift, self.probes, forms)

    def projected_speeds(self, M: Columns, u: list[int], phi: list[int], forms=None) -> list[int]:
        """The speeds on `phi = 0`."""
        if self.by_partition:
            return self._partition.projected_speeds(u, phi)
        A = [list(row) for row in zip(*columns(self.graph, phi, u), strict=True)]
        return projected_speeds(self.graph, self._inertia(M, A), u, phi, forms)

    def _inertia(self, M: Columns, A: Columns) -> Columns:
        """M, with inertia added along the rows where it may be singular: of the size of its own."""
        if not self.massless:
            return M
        heavy = np.nanmedian(np.max(np.abs(self.probes([row[i] for i, row in enumerate(M)])), axis=0))
        sizes = [np.nanmedian(np.sum(self.probes(row) ** 2, axis=0)) for row in A]
        return with_inertia_of_rows(self.graph, M, A, [float(2.0 ** np.round(np.log2(heavy / size))) if size > 0 else 1.0 for size in sizes])
