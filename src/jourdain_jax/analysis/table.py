"""Tables as text: columns side by side, matrices with the names of their rows."""

from collections.abc import Sequence

import numpy as np

from jourdain_jax.scene.printing import in_digits


def table(rows: Sequence[tuple[str, ...]]) -> list[str]:
    """Return lines with the cells of all rows in columns, indented by two blanks."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return ["  " + "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows]


def matrix(name: str, values, row_names: Sequence[str], column_names: Sequence[str]) -> list[str]:
    """Return a matrix under the names of its columns."""
    shape, digits = np.shape(values), in_digits(np.ravel(values))
    return table([(name, *column_names), *((row, *digits[k * shape[1] : (k + 1) * shape[1]]) for k, row in enumerate(row_names))])


def complex_numbers(values) -> list[str]:
    """Return texts such as `-0.5+2.1i`."""
    values = np.asarray(values)
    parts = in_digits(np.concatenate([values.real, values.imag]))
    pairs = zip(parts[: len(values)], parts[len(values) :], strict=True)
    return [real if imag == "0" else f"{real}{imag if imag.startswith('-') else f'+{imag}'}i" for real, imag in pairs]
