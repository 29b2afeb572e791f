"""Rows whose products lie in a narrow band, as those of a long chain, put to use as machine code; in a time that grows with the rows.

    x = C A' y,   (A A') y = r,   A A' = L D L'        A: rows in what is scaled by C, themselves scaled; zero in what is held

Lanes in which rows are not surely independent take the way of the others (`native/dense.py`), by one-sided rotations; only then is there a dense matrix.
Source of the estimate of how large the inverse is: as in `calculus/sparse_slopes.py`.
"""

from collections.abc import Sequence

from jourdain_jax.calculus.sparse_slopes import Band, Pattern
from jourdain_jax.native.dense import cleared
from jourdain_jax.native.ir import Value, Writer

PLACES = ("S", "L", "d", "c", "size", "B", "weights")  # entries, band, scales of rows and of what moves, how large the inverse is; of the dense way


def sizes(pattern: Pattern) -> tuple[int | None, ...]:
    """How many vectors are kept at each of the places; None for the dense matrix."""
    return len(pattern.rows), _band(pattern).size, *pattern.shape, 1, None, pattern.shape[0]


def _band(pattern: Pattern) -> Band:
    assert pattern.band is not None
    return pattern.band


def write_eliminated(w: Writer, pattern: Pattern) -> None:
    """`eliminated(L, size)`: the factors of a band in its place, and about how large the inverse is; `substituted(L, y)`: the solution in place of y."""
    band = _band(pattern)
    n, width = len(band.order), band.width
    column = lambda L, k: w.at(L, k * (width + 1), w.real)  # noqa: E731
    with w.function("forward_in_band", "void", {"below": "ptr", "y": "ptr", "k": "i64"}) as (below, y, k):
        own = w.load(w.real, y, k)
        with w.counted(1, width + 1) as j:
            w.store(w.load(w.real, y, k + j) - w.load(w.real, below, j) * own, y, k + j)
        w.give()
    with w.function("backward_in_band", "void", {"L": "ptr", "y": "ptr"}, attributes="noinline") as (L, y):
        with w.counted(0, n) as k:
            w.store(w.load(w.real, y, k) / w.load(w.real, column(L, k)), y, k)
        with w.counted(0, n) as before:
            k = w.literal(n - 1, "i64") - before
            with w.counted(1, width + 1) as j:
                w.store(w.load(w.real, y, k) - w.load(w.real, column(L, k), j) * w.load(w.real, y, k + j), y, k)
        w.give()
    with w.function("eliminated", "void", {"L": "ptr", "size": "ptr"}, attributes="noinline") as (L, size):
        x = w.room(w.real, n + width)
        cleared(w, x, n + width)
        with w.counted(0, n) as k:
            own = column(L, k)
            pivot = w.load(w.real, own)
            with w.counted(1, width + 1) as j:
                share, other = w.load(w.real, own, j) / pivot, column(L, k + j)
                with w.counted(0, w.literal(width + 1, "i64") - j) as i:
                    w.store(w.load(w.real, other, i) - share * w.load(w.real, own, i + j), other, i)
            with w.counted(1, width + 1) as j:
                w.store(w.load(w.real, own, j) / pivot, own, j)
            grown = w.load(w.real, x, k)
            w.store(grown + w.intrinsic("copysign", w.number(1.0), grown), x, k)
            w.call("forward_in_band", "void", own, x, k)
        w.call("backward_in_band", "void", L, x)
        w.store(w.number(0.0), size)
        with w.counted(0, n) as k:
            w.store(w.larger(w.load(w.real, size), w.magnitude(w.load(w.real, x, k))), size)
        w.give()
    with w.function("substituted", "void", {"L": "ptr", "y": "ptr"}, attributes="noinline") as (L, y):
        with w.counted(0, n) as k:
            w.call("forward_in_band", "void", column(L, k), y, k)
        w.call("backward_in_band", "void", L, y)
        w.give()


class _Tables:
    """Where entries and products are, as numbers in the module: loops over them are compiled in no time, whatever their length."""

    def __init__(self, w: Writer, pattern: Pattern):
        band = _band(pattern)
        of = {"rows": pattern.rows, "columns": pattern.columns, "places": band.places, "order": band.order}
        of |= dict(zip(("first", "second"), band.pairs, strict=True))
        self._w, self._tables = w, {name: w.whole_numbers(f"{name}_of_band", numbers.tolist()) for name, numbers in of.items()}

    def __call__(self, name: str, k: Value) -> Value:
        return self._w.load("i64", self._tables[name], k)


def write_factors(w: Writer, pattern: Pattern, free: Value, typical: Value, places: Sequence[Value], regular: float) -> None:
    """Inside a function: from the entries of the rows and the scales of what moves, at their places, to the factors of the band, and of the dense matrix for
    lanes whose inverse is not below `regular`.
    """
    band, (rows, columns), at = _band(pattern), pattern.shape, _Tables(w, pattern)
    S, L, d, c, size, B, weights = places
    cleared(w, d, rows)
    with w.counted(0, len(pattern.rows)) as e:
        i, k = at("rows", e), at("columns", e)
        slope = w.where(w.load(w.real, free, k) > 0.0, w.load(w.real, S, e) * w.load(w.real, c, k), 0.0)
        w.store(slope, S, e)
        w.store(w.fma(slope, slope, w.load(w.real, d, i)), d, i)
    with w.counted(0, rows) as i:
        length = w.larger(w.intrinsic("sqrt", w.load(w.real, d, i)), w.load(w.real, typical, i))
        there = length > 0.0
        w.store(w.where(there, w.number(1.0) / w.where(there, length, 1.0), 1.0), d, i)
    with w.counted(0, len(pattern.rows)) as e:
        w.store(w.load(w.real, S, e) * w.load(w.real, d, at("rows", e)), S, e)
    cleared(w, L, band.size)
    with w.counted(0, len(band.places)) as k:
        place = at("places", k)
        w.store(w.fma(w.load(w.real, S, at("first", k)), w.load(w.real, S, at("second", k)), w.load(w.real, L, place)), L, place)
    w.call("eliminated", "void", L, size)
    with w.when(w.any(~(w.load(w.real, size) < regular))):
        cleared(w, B, rows * (rows + columns))
        with w.counted(0, len(pattern.rows)) as e:
            w.store(w.load(w.real, S, e), B, at("rows", e) * (rows + columns) + at("columns", e))
        with w.counted(0, rows) as i:
            w.store(w.number(1.0), B, i * (rows + columns) + i + columns)
        w.call("rotated", "void", B)
        w.call("inverted", "void", B, weights)


def write_solution(w: Writer, pattern: Pattern, places: Sequence[Value], left: Value, x: Value, regular: float) -> None:
    """Inside a function: into x what moves by the shortest scaled solution of `A x = left`, given the factors."""
    band, (rows, columns), at = _band(pattern), pattern.shape, _Tables(w, pattern)
    S, L, _, c, size, B, weights = places
    y, shares = w.room(w.real, rows + band.width), w.room(w.real, rows)
    cleared(w, y, rows + band.width)
    with w.counted(0, rows) as k:
        w.store(w.load(w.real, left, at("order", k)), y, k)
    w.call("substituted", "void", L, y)
    with w.counted(0, rows) as k:
        w.store(w.load(w.real, y, k), shares, at("order", k))
    cleared(w, x, columns)
    with w.counted(0, len(pattern.rows)) as e:
        k = at("columns", e)
        w.store(w.fma(w.load(w.real, S, e), w.load(w.real, shares, at("rows", e)), w.load(w.real, x, k)), x, k)
    is_regular = w.load(w.real, size) < regular
    with w.when(w.any(~is_regular)):
        other = w.room(w.real, columns)
        w.call("solved", "void", B, weights, left, other)
        with w.counted(0, columns) as k:
            w.store(w.where(is_regular, w.load(w.real, x, k), w.load(w.real, other, k)), x, k)
    with w.counted(0, columns) as k:
        w.store(w.load(w.real, x, k) * w.load(w.real, c, k), x, k)
