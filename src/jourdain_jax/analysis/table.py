"""Tables as text: columns side by side, matrices with the names of their rows."""

from collections.abc import Sequence

import numpy as np

from jourdain_jax.scene.printing import in_digits


def table(rows: Sequence[tuple[str, ...]]) -> list[str]:
    """Lines with the cells of all rows in columns, indented by two blanks."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return ["  " + "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows]


def matrix(name: str, values, row_names: Sequence[str], column_names: Sequence[str]) -> list[str]:
    """A matrix under the names of its columns."""
    shape, digits = np.shape(values), in_digits(np.ravel(values))
    return table([(name, *column_names), *((row, *digits[k * shape[1] : (k + 1) * shape[1]]) for k, row in enumerate(row_names))])


def complex_numbers(values) -> list[str]:
    """Texts such as `-0.5+2.1i`."""
    values = np.asarray(values)
    parts = in_digits(np.concatenate([values.real, values.imag]))
    pairs = zip(parts[: len(values)], parts[len(values) :], strict=True)
    return [real if imag == "0" else f"{real}{imag if imag.startswith('-') else f'+{imag}'}i" for real, imag in pairs]


def linearization_text(found) -> str:
    """M, C, K and F of the named coordinates with their eigenvalues; A and B where none are named."""
    if found.A.ndim != 2:
        return f"Linearizations of shape {found.A.shape[:-2]}; named coordinates: {', '.join(found.coordinates) or 'none'}"
    lines = [f"Small motions: residual {float(found.residual):.1e} (zero if the motion is steady), pivot {float(found.pivot):.2g}"]
    names = found.coordinates
    if names:
        lines += [line for what in ("M", "C", "K") for line in matrix(what, getattr(found, what), names, names)]
        lines += matrix("F", found.F, names, found.inputs) if found.inputs else []
        lines.append(f"  coupling to what is not named {float(found.coupling):.1e}")
        values = found.eigenvalues()
    else:
        lines += matrix("A", found.A, found.states, found.states)
        lines += matrix("B", found.B, found.states, found.inputs) if found.inputs else []
        values = found.state_eigenvalues()
    return "\n".join([*lines, "  eigenvalues in 1/s: " + ", ".join(complex_numbers(values))])
