"""What the source of a step asks of a writer beside arithmetic and memory: branches, loops over stages and rows.

    if_any(c, body)            what the body does counts where c holds in any lane; lanes are told apart by `where`
    over_stages(n, body, x)    x <- body(i, x)
    each(rows, body)           the body for every row, none of which needs what another one makes

So each is one operation to whoever writes the source in another way than as instructions one after the other.
"""

import math
import operator
from collections.abc import Callable
from functools import reduce
from typing import Any

from jourdain_jax.native.ir import Value, Writer
from jourdain_jax.native.math_functions import power


class MachineWriter(Writer):
    """The source as machine code."""

    def power(self, x: Value, exponent: float) -> Value:
        """x^exponent"""
        return power(self, x, exponent)

    def if_any(self, condition: Value, body: Callable[[], object]) -> None:
        """Run what the body writes where the condition holds in any lane."""
        with self.when(self.any(condition)):
            body()

    def over_stages(self, count: int, body: Callable[[int, Any], Any], found: Any) -> Any:
        """Return what the body makes of what was found, stage by stage."""
        for i in range(count):
            found = body(i, found)
        return found

    def is_first(self, i: int) -> bool:
        """Return whether this is known to be the first stage."""
        return i == 0

    def at_first(self, i: int, first: Any, otherwise: Any) -> Any:
        """Return `first` in the first stage, otherwise the other."""
        return first if i == 0 else otherwise

    def table(self, numbers: Any) -> Any:
        """Return numbers that stages look up."""
        return numbers

    def every(self, pointer: Value, rows: range) -> list[Value]:
        """Return what is in rows of memory: as many values as there are rows."""
        return [self.load(pointer, row) for row in rows]

    def least(self, values: list[Value]) -> Value:
        """Return the least of all rows of the values, infinity where there are none."""
        return reduce(self.smaller, values, self.number(math.inf))

    def in_any(self, truths: list[Value]) -> Value:
        """Return whether one of all rows of the truth values holds."""
        return reduce(operator.or_, truths, self.literal(0, self.truth))

    def entry(self, stages: list[int], number: int) -> int:
        """Return the stage with this number."""
        return stages[number]

    def may_count(self, weights: Any, j: int) -> bool:
        """Return whether a weight may be other than zero."""
        return bool(weights[j] != 0)

    def each(self, rows: range, body: Callable[[Any], object]) -> None:
        """Call the body for the number of every row."""
        # 12 numbers of a state; more are gone through by loops, whose code is short
        if len(rows) <= 12:
            for i in rows:
                body(i)
        else:
            with self.counted(rows.start, rows.stop) as i:
                body(i)

    def _total(self, rows: range, added: Callable[[Value, Any], Value]) -> Value:
        total = self.room()
        self.store(0.0, total)
        self.each(rows, lambda i: self.store(added(self.load(total), i), total))
        return self.load(total)

    def sum_of_squares(self, rows: range, value: Callable[[Any], Value]) -> Value:
        """Return the sum of the squares of the values of all rows."""
        return self._total(rows, lambda total, i: self.fma(x := value(i), x, total))

    def largest(self, rows: range, value: Callable[[Any], Value]) -> Value:
        """Return the largest of the values of all rows, none of which is negative."""
        return self._total(rows, lambda total, i: self.larger(total, value(i)))
