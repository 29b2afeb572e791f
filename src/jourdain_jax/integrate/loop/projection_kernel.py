"""Projection of coordinates or speeds in machine code: the method of `equations/projection.py` on the scalar
program of the constraints, for several lanes.

    x <- x - W (d A W)+ d r(x),   A = dr/dx for the free variables,   d: reciprocal row lengths

r: geometric constraints (x: coordinates) or velocity constraints (x: speeds); W = 1, or W = c L'^-1 with
c M c = L L' for the nearest speeds in the metric of the mass matrix. Lanes that have converged do not change;
those whose residuals are mere round-off at the start have.

    |r_i| <= 8 eps sum_k |A_ik| (|x_k| + eps max |x|)

Dense linear algebra is written as loops. Each lane has its own matrix; an entry for all lanes is a vector in
memory, and entries are stored row by row.

    A+ = B' S^-2 J,   J A = B with orthogonal rows of lengths S     one-sided Jacobi rotations J
    M = L L'                                                        Cholesky

Sources: M. R. Hestenes, J. SIAM 6 (1958) 51-90, with rows instead of columns; J. Demmel and K. Veselic, SIAM
J. Matrix Anal. Appl. 13 (1992) 1204-1245, on its accuracy. The results of a lane depend only on its own
numbers.
"""

import math
from dataclasses import dataclass
from functools import reduce
from operator import and_
from typing import Literal

from jourdain_jax.calculus.reals import Indices
from jourdain_jax.calculus.roots import QUIET, ROUND_OFF
from jourdain_jax.equations.projection import MOST_MOVES_OF_POSITIONS, MOST_MOVES_OF_SPEEDS
from jourdain_jax.integrate.loop.lanes import MachineWriter
from jourdain_jax.kernels.ffi import write_rows
from jourdain_jax.kernels.ir import Value
from jourdain_jax.kernels.scalar_program import as_real, unsupported, written_in_turn
from jourdain_jax.structure.row_program import RowProgram


def _product_of_rows(w: MachineWriter, a: Value, b: Value, count) -> Value:
    """Return the dot product of two vectors of `count` numbers in memory."""
    total = w.room()
    w.store(0.0, total)
    with w.counted(count) as k:
        w.store(w.fma(w.load(a, k), w.load(b, k), w.load(total)), total)
    return w.load(total)


def cleared(w: MachineWriter, place: Value, count: int) -> None:
    """Store `count` zeros from `place` on."""
    with w.counted(count) as k:
        w.store(0.0, place, k)


def write_rotated(w: MachineWriter, rows: int, columns: int) -> None:
    """Write `rotated(B)`, which rotates the rows of B until their first `columns` entries are orthogonal. The
    other `rows` entries rotate with them.
    """
    width = rows + columns
    with w.procedure("rotated", "B") as (B,):
        turned = w.room(type="i1")
        # at most 40 sweeps of rotations; 6 to 10 suffice
        with w.counted(40):
            w.store(w.literal(0, "i1"), turned)
            with w.counted(rows) as i, w.counted(rows, first=i + 1) as j:
                first, second = w.at(B, i * width), w.at(B, j * width)
                a, b, p = (
                    _product_of_rows(w, x, y, columns)
                    for x, y in ((first, first), (second, second), (first, second))
                )
                lengths = w.root(a) * w.root(b)
                slanted = w.magnitude(p) > lengths * (columns * w.eps)
                with w.when(w.any(slanted)):
                    w.store(w.literal(1, "i1"), turned)
                    zeta = (b - a) / (w.where(slanted, p, 1.0) * 2.0)
                    t = w.intrinsic(
                        "copysign", w.number(1.0) / (w.magnitude(zeta) + w.root(zeta * zeta + 1.0)), zeta
                    )
                    c = w.number(1.0) / w.root(t * t + 1.0)
                    c, s = w.where(slanted, c, 1.0), w.where(slanted, c * t, 0.0)
                    with w.counted(width) as k:
                        x, y = w.load(first, k), w.load(second, k)
                        w.store(w.where(slanted, c * x - s * y, x), first, k)
                        w.store(w.where(slanted, s * x + c * y, y), second, k)
            w.give_where(~w.load(turned, type="i1"))


def write_inverted(w: MachineWriter, rows: int, columns: int, cutoff: float) -> None:
    """Write `inverted(B, weights)`, which computes, after `rotated`, the weights `S^-2` of the rows. Rows
    shorter than `cutoff` times the longest have zero weight.
    """
    with w.procedure("inverted", "B weights") as (B, weights):
        longest, width = w.room(), rows + columns
        w.store(0.0, longest)
        with w.counted(rows) as i:
            row = w.at(B, i * width)
            length = w.root(_product_of_rows(w, row, row, columns))
            w.store(length, weights, i)
            w.store(w.larger(w.load(longest), length), longest)
        with w.counted(rows) as i:
            length = w.load(weights, i)
            short = length <= w.load(longest) * cutoff  # false for NaN, so that NaN is kept
            w.store(w.where(short, 0.0, w.number(1.0) / w.where(short, 1.0, length * length)), weights, i)


def write_solved(w: MachineWriter, rows: int, columns: int) -> None:
    """Write `solved(B, weights, b, x)`, which computes `x = A+ b`."""
    width = rows + columns
    with w.procedure("solved", "B weights b x") as (B, weights, b, x):
        cleared(w, x, columns)
        with w.counted(rows) as i:
            row = w.at(B, i * width)
            share = w.load(weights, i) * _product_of_rows(w, w.at(row, columns), b, rows)
            with w.counted(columns) as k:
                w.store(w.fma(share, w.load(row, k), w.load(x, k)), x, k)


def write_cholesky(w: MachineWriter, n: int) -> None:
    """Write `cholesky(M)`, which replaces the lower triangle of M by L. L is the identity if M is not
    positive definite to round-off, and NaN if M is not finite.
    """
    with w.procedure("cholesky", "M") as (M,):
        finite, smallest = w.room(), w.room()
        w.store(0.0, finite)  # stays zero if all entries are finite
        w.store(1.0, smallest)
        with w.counted(n) as i, w.counted(n) as j:
            w.store(w.fma(w.load(M, i * n + j), 0.0, w.load(finite)), finite)
        with w.counted(n) as i:
            row = w.at(M, i * n)
            with w.counted(i) as j:
                other = w.at(M, j * n)
                rest = w.load(row, j) - _product_of_rows(w, row, other, j)
                w.store(rest / w.load(other, j), row, j)
            pivot = w.load(row, i) - _product_of_rows(w, row, row, i)
            w.store(w.smaller(w.load(smallest), pivot), smallest)
            w.store(w.root(pivot), row, i)
        is_finite = w.load(finite).equals(0.0)
        definite = w.load(smallest) > 16 * n * w.eps
        with w.counted(n) as i, w.counted(i + 1) as j:
            on_diagonal = w.converted("uitofp", i.equals(j), "double")
            one = w.spread(on_diagonal)
            w.store(
                w.where(is_finite, w.where(definite, w.load(M, i * n + j), one), float("nan")), M, i * n + j
            )


def write_triangular(w: MachineWriter, n: int) -> None:
    """Write `forward(L, x)` and `backward(L, x)`, which replace `x` by `L^-1 x` and by `L'^-1 x`."""
    with w.procedure("forward", "L x") as (L, x), w.counted(n) as i:
        row = w.at(L, i * n)
        w.store((w.load(x, i) - _product_of_rows(w, row, x, i)) / w.load(row, i), x, i)
    with w.procedure("backward", "L x") as (L, x), w.counted(n) as before:
        i = w.literal(n - 1, "i64") - before
        row = w.at(L, i * n)
        value = w.load(x, i) / w.load(row, i)
        w.store(value, x, i)
        with w.counted(i) as k:
            w.store(w.load(x, k) - value * w.load(row, k), x, k)


LARGEST_PROGRAM = 60_000  # tuning: operations

Kind = Literal["positions", "speeds", "determined speeds"]


@dataclass(frozen=True)
class Rows:
    """Variables to project, and their constraints."""

    program: RowProgram
    kind: Kind
    # constraints are affine in these variables: one matrix suffices, and a second step removes round-off
    affine: bool = False

    @property
    def moving(self) -> Indices:
        """Return the nodes of the projected variables."""
        return self.program.q if self.kind == "positions" else self.program.u

    @property
    def residuals(self) -> Indices:
        """Return the nodes of the residuals."""
        return self.program.g if self.kind == "positions" else self.program.phi

    @property
    def slopes(self) -> dict[tuple[int, int], int]:
        """Return the nodes of the derivatives of the residuals."""
        return self.program.G if self.kind == "positions" else self.program.A

    @property
    def metric(self) -> dict[tuple[int, int], int] | None:
        """Return the nodes of the mass matrix; None if no metric is needed."""
        return self.program.M if self.kind == "speeds" else None

    @property
    def given(self) -> list[int]:
        """Return the nodes of a sample's arguments. They are followed by flags of free entries and typical
        lengths of the constraints.
        """
        program = self.program
        return [
            *program.entries,
            program.t,
            *program.q,
            *(() if self.kind == "positions" else (*program.u, *program.inputs)),
        ]

    def reason_against(self) -> str:
        """Return why machine code does not project these variables; empty if it does."""
        if self.kind == "speeds" and self.program.M is None:
            return "the mass matrix is too large"
        rows, columns = len(self.residuals), len(self.moving)
        # Limit on entries of a matrix. Measured in ms for speeds of trailers off the constraints, by machine
        # code and by XLA, alone, then per sample of a batch: 6 trailers 0.09 and 0.08, 0.015 and 0.050; 12
        # trailers (2,812 entries) 0.63 and 0.19, 0.11 and 0.19.
        if max((rows + columns) * rows, columns**2) > 3_000:
            return "there are too many constraints"
        nodes = [
            *self.residuals,
            *self.slopes.values(),
            *({} if self.metric is None else self.metric).values(),
        ]
        if self.program.graph.operations(nodes) > LARGEST_PROGRAM:
            return "the scalar program is too large"
        return unsupported(self.program.graph, nodes)


def write(w: MachineWriter, of: Rows, cutoff: float) -> None:
    """Write the module of a projection. Its arguments are `of.given`, flags of free entries, and typical
    lengths; its results are the projected variables and the residual.

    `cutoff`: singular values below this fraction of the largest count as zero.
    """
    rows, columns = len(of.residuals), len(of.moving)
    _write_values(w, of, "residuals", dict(enumerate(of.residuals)))
    write_rotated(w, rows, columns)
    write_inverted(w, rows, columns, cutoff)
    write_solved(w, rows, columns)
    if of.metric is not None:
        _write_values(w, of, "masses", {i * columns + k: node for (i, k), node in of.metric.items()})
        write_cholesky(w, columns)
        write_triangular(w, columns)
        _write_metric(w, of)
    _write_values(w, of, "slopes", {i * (rows + columns) + k: node for (i, k), node in of.slopes.items()})
    _write_settled(w, of)
    _write_factored(w, of)
    _write_moved(w, of)
    _write_row(w, of)
    write_rows(w, len(of.given) + columns + rows, columns + rows)


def _write_values(w: MachineWriter, of: Rows, name: str, nodes: dict[int, int]) -> None:
    """Write a function `name(state, found)`, which stores the values of nodes at their places in `found`."""
    with w.procedure(name, "state found") as (state, found):
        known = {n: w.load(state, k) for k, n in enumerate(of.given)}
        places = list(nodes)
        for k, value in written_in_turn(w, of.program.graph, nodes.values(), known):
            w.store(as_real(w, value), found, places[k])


def _write_metric(w: MachineWriter, of: Rows) -> None:
    """Write `metric(state, L, c)`, which computes the scales c of the speeds, and the Cholesky factor L of
    the mass matrix in scaled speeds, with identity rows for held speeds.
    """
    n, first_free = len(of.moving), len(of.given)
    with w.procedure("metric", "state L c") as (state, L, c):
        cleared(w, L, n * n)
        w.run("masses", state, L)
        with w.counted(n) as i:
            w.store(_scale_of_speed(w, w.load(L, i * n + i)), c, i)
        with w.counted(n) as i, w.counted(i + 1) as k:
            scaled = w.load(c, i) * w.load(L, i * n + k) * w.load(c, k)
            both = (w.load(state, i + first_free) > 0.0) & (w.load(state, k + first_free) > 0.0)
            alone = w.spread(w.converted("uitofp", i.equals(k), "double"))
            w.store(w.where(both, scaled, alone), L, i * n + k)
        w.run("cholesky", L)


def _scale_of_speed(w: MachineWriter, own: Value) -> Value:
    """Return the scale of a speed from its diagonal entry of the mass matrix, as in
    `equations/reductions.py: speed_scale`.
    """
    heavy = own > 0.0
    return w.where(heavy, w.number(1.0) / w.root(w.where(heavy, own, 1.0)), 1.0)


def _write_settled(w: MachineWriter, of: Rows) -> None:
    """Write `settled(state, quiet)`, which stores the number of steps without change: `QUIET` in lanes whose
    residuals are mere round-off, and 0 in others.
    """
    nodes, bound = [*of.residuals, *of.slopes.values()], [w.number(0.0)] * len(of.residuals)
    with w.procedure("settled", "state quiet") as (state, quiet):
        known = {n: w.load(state, k) for k, n in enumerate(of.given)}
        values = dict(written_in_turn(w, of.program.graph, nodes, known))
        found = [w.magnitude(as_real(w, values[k])) for k in range(len(nodes))]
        sizes = [w.magnitude(known[n]) for n in of.moving]
        least = reduce(w.larger, sizes) * w.eps
        for slope, (i, k) in zip(found[len(bound) :], of.slopes, strict=True):
            bound[i] = w.fma(slope, sizes[k] + least, bound[i])
        settled = [left <= most * (8 * w.eps) for left, most in zip(found, bound, strict=False)]  # not if NaN
        w.store(w.where(reduce(and_, settled), float(QUIET), 0.0), quiet)


def _write_factored(w: MachineWriter, of: Rows) -> None:
    """Write `factored(state, L, c, B, d, weights)`, which computes the matrix of the constraints, applies
    `rotated` and `inverted` to it, and stores its row scales in d.
    """
    rows, columns, first_free = len(of.residuals), len(of.moving), len(of.given)
    width, first_typical = rows + columns, first_free + columns
    with w.procedure("factored", "state L c B d weights") as (state, L, c, B, d, weights):
        cleared(w, B, rows * width)
        w.run("slopes", state, B)
        with w.counted(rows) as i:
            row, square = w.at(B, i * width), w.room()
            with w.counted(columns) as k:
                slope = w.load(row, k)
                slope = slope if of.metric is None else slope * w.load(c, k)
                w.store(w.where(w.load(state, k + first_free) > 0.0, slope, 0.0), row, k)
            if of.metric is not None:
                w.run("forward", L, row)
            w.store(0.0, square)
            with w.counted(columns) as k:
                slope = w.load(row, k)
                w.store(w.fma(slope, slope, w.load(square)), square)
            length = w.larger(w.root(w.load(square)), w.load(state, i + first_typical))
            there = length > 0.0
            scale = w.where(there, w.number(1.0) / w.where(there, length, 1.0), 1.0)
            w.store(scale, d, i)
            with w.counted(columns) as k:
                w.store(w.load(row, k) * scale, row, k)
            w.store(1.0, row, i + columns)
        w.run("rotated", B)
        w.run("inverted", B, weights)


def _write_moved(w: MachineWriter, of: Rows) -> None:
    """Write `moved(state, L, c, B, d, weights, x)`, which makes one step of the variables by the `factored`
    matrix.
    """
    rows, columns, first_free = len(of.residuals), len(of.moving), len(of.given)
    first = of.given.index(of.moving[0])
    with w.procedure("moved", "state L c B d weights x") as (state, L, c, B, d, weights, x):
        left = w.room(rows)
        w.run("residuals", state, left)
        with w.counted(rows) as i:
            w.store(w.load(left, i) * w.load(d, i), left, i)
        w.run("solved", B, weights, left, x)
        if of.metric is not None:
            w.run("backward", L, x)
        with w.counted(columns) as k:
            change = w.load(x, k)
            change = change if of.metric is None else change * w.load(c, k)
            moves = w.load(state, k + first_free) > 0.0  # held variables must not change even by round-off
            w.store(w.load(state, k + first) - w.where(moves, change, 0.0), x, k)


def _write_row(w: MachineWriter, of: Rows) -> None:
    """Write `row(state, found)`, which computes the results of a block of samples from their arguments. The
    iteration ends when steps no longer change the variables (see `calculus/roots.py`).
    """
    rows, columns = len(of.residuals), len(of.moving)
    first = of.given.index(of.moving[0])
    most = MOST_MOVES_OF_POSITIONS if of.kind == "positions" else MOST_MOVES_OF_SPEEDS
    with w.procedure("row", "state found") as (state, found):
        n = columns if of.metric is not None else 0
        sizes = n * n, n, rows * (rows + columns), rows, rows, columns
        L, c, *factors, x = (w.room(max(count, 1)) for count in sizes)
        quiet, changed = w.room(), w.room()
        w.run("settled", state, quiet)
        with w.when(w.any(w.load(quiet) < float(QUIET))):
            if of.metric is not None:
                w.run("metric", state, L, c)
            if of.affine:
                w.run("factored", state, L, c, *factors)
            with w.counted(2 if of.affine else most):
                going = w.load(quiet) < float(QUIET)
                with w.when(w.any(going)):
                    if not of.affine:
                        w.run("factored", state, L, c, *factors)
                    w.run("moved", state, L, c, *factors, x)
                    w.store(-math.inf, changed)
                    with w.counted(columns) as k:
                        old, new = w.load(state, k + first), w.load(x, k)
                        beyond = w.magnitude(new - old) > (w.magnitude(old) + 1.0) * (ROUND_OFF * w.eps)
                        w.store(w.where(beyond, 1.0, w.load(changed)), changed)
                        w.store(w.where(going, new, old), state, k + first)
                    still = w.where(w.load(changed) > 0.0, 0.0, w.load(quiet) + 1.0)
                    w.store(w.where(going, still, w.load(quiet)), quiet)
        with w.counted(columns) as k:
            w.store(w.load(state, k + first), found, k)
        w.run("residuals", state, w.at(found, columns))
