"""Text of results in a console and in a notebook: numbers, tables and matrices. Traced values are shown by
their shapes.
"""

import dataclasses
import html
from collections.abc import Callable, Sequence

import jax
import numpy as np

from jourdain_jax.calculus.reals import eps_of, is_traced
from jourdain_jax.scene.coordinates import parameters_of


class Printed:
    """Base of results: `print`, a console and a notebook show their `_text()`."""

    def __str__(self) -> str:
        return shapes_of(self) if is_traced(self) else self._text()

    def __repr__(self) -> str:
        return str(self)

    def _repr_html_(self) -> str:
        return f"<pre>{html.escape(str(self))}</pre>" + ("" if is_traced(self) else self._picture())

    def _picture(self) -> str:
        """Return HTML shown below the text in a notebook."""
        return ""

    def _text(self) -> str:
        raise NotImplementedError(f"`{type(self).__name__}` has no text for `print`; define `_text(self)`")


_picture: Callable = lambda scene: ""


def show_scenes_with(picture: Callable) -> None:
    """Set the function whose HTML, `picture(scene)`, notebooks show below a scene; a higher
    layer calls this.
    """
    global _picture
    _picture = picture


def scene_text(scene) -> str:
    """Return a scene as its constructor call: `ChaplyginSleigh(mass=1.3, inertia=0.4, offset=0.25)`. Large
    arrays are shown by their shape.
    """
    shown = []
    for field in (field for field in dataclasses.fields(scene) if field.repr):
        value = getattr(scene, field.name)
        if isinstance(value, jax.Array | np.ndarray):
            text = _value(value)
            text = f"[{text}]" if ", " in text else text
        else:
            plain = value is None or isinstance(value, bool | int | float | str)
            text = repr(value) if plain else type(value).__name__
        shown.append(f"{field.name}={text}")
    return f"{type(scene).__name__}({', '.join(shown)})"


def scene_html(scene) -> str:
    """Return HTML of a scene for a notebook: parameters with values and units, names of coordinates, speeds
    and inputs, and a picture at its example start.
    """
    left = "style='text-align:left'"
    cell = lambda text: f"<td {left}>{html.escape(text)}</td>"
    about = (type(scene).__doc__ or "").strip().split("\n")[0]
    rows = [
        f"<tr><th {left}>{html.escape(name)}</th>"
        f"{cell(_value(value))}{cell(known['unit'])}{cell(known['about'])}</tr>"
        for name, value, known in parameters_of(scene)
    ]
    heads = "".join(f"<th {left}>{head}</th>" for head in ("parameter", "value", "unit", ""))
    own = scene.coordinate_names, scene.speed_names, scene.inputs
    listed = zip(("coordinates", "speeds", "inputs"), own, strict=True)
    names = "".join(
        f"<div>{what}: {html.escape(', '.join(given.entries))}</div>"
        for what, given in listed
        if given.entries
    )
    table = f"<table><thead><tr>{heads}</tr></thead><tbody>{''.join(rows)}</tbody></table>" if rows else ""
    return (
        f"<div><b>{html.escape(type(scene).__name__)}</b> {html.escape(about)}{table}{names}</div>"
        + _picture(scene)
    )


def _value(value) -> str:
    if is_traced(value):
        return "being traced"
    if value.size > 6:
        return f"array of shape {value.shape}"
    return ", ".join(f"{float(x):.6g}" for x in value.ravel())


def in_digits(values) -> list[str]:
    """Return numbers as texts with six digits. Numbers below the round-off of the largest become 0."""
    values = np.asarray(values)
    least = eps_of(values) * np.nanmax(np.abs(values), initial=0.0, where=np.isfinite(values))
    return [f"{0.0 if abs(x) <= least else x:.6g}" for x in values]


def shapes_of(result) -> str:
    """Return a text about a result whose numbers are traced."""
    shapes = [tuple(leaf.shape) for leaf in jax.tree.leaves(result) if hasattr(leaf, "shape")]
    largest = max(shapes, key=lambda shape: (len(shape), shape), default=())
    name = type(result).__name__
    return (
        f"{name}, being traced: {len(shapes)} arrays, the largest of shape {largest}; print it outside of"
        " `jax.jit`, or use `jax.debug.print`"
    )


def table(rows: Sequence[tuple[str, ...]]) -> list[str]:
    """Return the rows as lines with aligned columns, indented by two blanks."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return [
        "  " + "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip()
        for row in rows
    ]


def matrix(name: str, values, row_names: Sequence[str], column_names: Sequence[str]) -> list[str]:
    """Return a matrix as lines of text, with names of its rows and columns."""
    shape, digits = np.shape(values), in_digits(np.ravel(values))
    return table(
        [
            (name, *column_names),
            *((row, *digits[k * shape[1] : (k + 1) * shape[1]]) for k, row in enumerate(row_names)),
        ]
    )


def complex_numbers(values) -> list[str]:
    """Return complex numbers as texts, such as `-0.5+2.1i`."""
    values = np.asarray(values)
    parts = in_digits(np.concatenate([values.real, values.imag]))
    pairs = zip(parts[: len(values)], parts[len(values) :], strict=True)
    return [
        real if imag == "0" else f"{real}{imag if imag.startswith('-') else f'+{imag}'}i"
        for real, imag in pairs
    ]
