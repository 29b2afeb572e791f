"""Join the operands of a machine-code call to the arrays that it takes on a CPU or a GPU.

The rows of a start are vectors and numbers, some of them with a batch axis. On a CPU they become one array
with a batch axis. On a GPU, the rows that all lanes share form a separate array without batch axis. Saved
times also have no batch axis if lanes share them.
"""

from collections.abc import Sequence
from itertools import groupby
from typing import Any, NamedTuple

import numpy as np
from jax import lax
from jaxtyping import Array


class Operands(NamedTuple):
    """Operands of one call, some of them with batch axes."""

    batch: tuple[int, ...]  # batch sizes, one for each `vmap`
    ranks: tuple[int, ...]  # ranks of the operands without batch axes
    samples: int  # number of leading operands that are samples
    others: int  # number of trailing operands that are separate arrays; those in between are rows of a start
    # rows of a start that are not operands: index of the first row, and values
    constant: tuple[tuple[int, tuple[float, ...]], ...]
    counted: bool  # whether the last operand is the number of trial steps, which a CPU does not take

    def _laned(self, x: Array, rank: int) -> Array:
        """Return an operand with all batch axes."""
        shape = (*self.batch, *x.shape[x.ndim - rank :])
        return lax.broadcast_in_dim(x, shape, range(len(shape) - x.ndim, len(shape)))

    def _rows(self, values: Sequence) -> list[tuple[Any, int, bool]]:
        """Return each vector, number or constant of a start, with its rank and whether all lanes share it."""
        constant, row, found = dict(self.constant), 0, list[tuple[Any, int, bool]]()
        operands = [*range(self.samples, len(values) - self.others)]
        while operands or row in constant:
            if row in constant:
                found.append((np.array(constant[row]), 1, True))
                row += len(constant[row])
            else:
                x, rank = values[k := operands.pop(0)], self.ranks[k]
                if count := x.shape[-1] if rank else 1:
                    found.append((x, rank, x.ndim == rank))
                row += count
        return found

    def shared(self, values: Sequence) -> tuple[bool, ...]:
        """Return for each row of a start whether all lanes share it."""
        rows = self._rows(values)
        return tuple(is_shared for x, rank, is_shared in rows for _ in range(x.shape[-1] if rank else 1))

    def _joined(self, rows: list, dtype, laned: bool) -> Array:
        """Join rows to one array; `laned`: with all batch axes. Neighbours with equal batch axes are joined
        first; then the missing axes are added.
        """
        found = []
        for _, some in groupby(rows, lambda row: np.shape(row[0])[: np.ndim(row[0]) - row[1]]):
            each = []
            for x, rank, _ in some:
                x = lax.convert_element_type(x, dtype)
                each.append(
                    lax.transpose(x, (x.ndim - 1, *range(x.ndim - 1))) if rank else lax.expand_dims(x, (0,))
                )
            # XLA compiles a concatenation of numbers faster with the batch axis last (`markers.entries_of`)
            part = lax.concatenate(each, 0)
            part = lax.transpose(part, (*range(1, part.ndim), 0))
            found.append(self._laned(part, 1) if laned else part)
        found = found or [np.zeros(1, dtype)]  # nothing reads the number of an array without rows
        return lax.concatenate(found, found[0].ndim - 1)

    def side_by_side(self, *values: Array) -> list[Array]:
        """Return the arrays for a CPU. The batch axis is first; samples that lanes share have none."""
        rows, last, end = self._rows(values), len(values) - self.others, len(values) - self.counted
        start = self._joined(rows, values[-1].dtype, True)
        return [*values[: self.samples], start, *map(self._laned, values[last:end], self.ranks[last:end])]

    def given_once(self, *values: Array) -> list[Array]:
        """Return the arrays for a GPU. The shared rows of a start form an array of their own, without batch
        axis, after that of the other rows. If all lanes share the times, these have no batch axis either. The
        number of trial steps is the largest of the batch.
        """
        rows, last, end = self._rows(values), len(values) - self.others, len(values) - self.counted
        starts = [
            self._joined([x for x in rows if x[2] is shared], values[-1].dtype, not shared)
            for shared in (False, True)
        ]
        others = [*map(self._laned, values[last:end], self.ranks[last:end])]
        if others and values[end - 1].ndim == self.ranks[end - 1]:
            others[-1] = values[end - 1]
        tries = [lax.reduce_max(lax.expand_dims(x, (0,)), range(1, x.ndim + 1)) for x in values[end:]]
        return [*values[: self.samples], *starts, *others, *tries]
