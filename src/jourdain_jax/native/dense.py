"""Small dense linear algebra as loops of machine code, one matrix per lane: entries are vectors in memory, row by row.

    A+ = B' S^-2 J,   J A = B with orthogonal rows of lengths S     one-sided Jacobi rotations J
    M = L L'                                                        Cholesky

Sources: M. R. Hestenes, J. SIAM 6 (1958) 51-90, for rows in place of columns; J. Demmel and K. Veselic, SIAM J. Matrix Anal. Appl. 13 (1992) 1204-1245, on
its accuracy. What a lane computes depends on nothing but its own numbers.
"""

import sys

from jourdain_jax.native.ir import Value, Writer

_EPS = sys.float_info.epsilon


def _product_of_rows(w: Writer, a: Value, b: Value, count) -> Value:
    """The sum of products of so many numbers from two places on."""
    total = w.room()
    w.store(0.0, total)
    with w.counted(0, count) as k:
        w.store(w.fma(w.load(a, k), w.load(b, k), w.load(total)), total)
    return w.load(total)


def cleared(w: Writer, place: Value, count: int) -> None:
    """Zeros at so many places from one on."""
    with w.counted(0, count) as k:
        w.store(0.0, place, k)


def write_rotated(w: Writer, rows: int, columns: int) -> None:
    """`rotated(B)`: the rows of B made orthogonal in their first `columns` entries; the `rows` entries behind them turn with them."""
    width = rows + columns
    with w.procedure("rotated", "B") as (B,):
        turned = w.room(type="i1")
        # 40 of rotations; 6 to 10 are taken
        with w.counted(0, 40):
            w.store(w.literal(0, "i1"), turned)
            with w.counted(0, rows) as i, w.counted(i + 1, rows) as j:
                first, second = w.at(B, i * width), w.at(B, j * width)
                a, b, p = (_product_of_rows(w, x, y, columns) for x, y in ((first, first), (second, second), (first, second)))
                lengths = w.root(a) * w.root(b)
                slanted = w.magnitude(p) > lengths * (columns * _EPS)
                with w.when(w.any(slanted)):
                    w.store(w.literal(1, "i1"), turned)
                    zeta = (b - a) / (w.where(slanted, p, 1.0) * 2.0)
                    t = w.intrinsic("copysign", w.number(1.0) / (w.magnitude(zeta) + w.root(zeta * zeta + 1.0)), zeta)
                    c = w.number(1.0) / w.root(t * t + 1.0)
                    c, s = w.where(slanted, c, 1.0), w.where(slanted, c * t, 0.0)
                    with w.counted(0, width) as k:
                        x, y = w.load(first, k), w.load(second, k)
                        w.store(w.where(slanted, c * x - s * y, x), first, k)
                        w.store(w.where(slanted, s * x + c * y, y), second, k)
            done, on = w.label(), w.label()
            w.go(on, w.load(turned, type="i1"), done)
            w.place(done)
            w.give()
            w.place(on)


def write_inverted(w: Writer, rows: int, columns: int, cutoff: float) -> None:
    """`inverted(B, weights)`: after `rotated`, the weights S^-2 of the rows; zero for rows shorter than `cutoff` times the longest."""
    with w.procedure("inverted", "B weights") as (B, weights):
        longest, width = w.room(), rows + columns
        w.store(0.0, longest)
        with w.counted(0, rows) as i:
            row = w.at(B, i * width)
            length = w.root(_product_of_rows(w, row, row, columns))
            w.store(length, weights, i)
            w.store(w.larger(w.load(longest), length), longest)
        with w.counted(0, rows) as i:
            length = w.load(weights, i)
            short = length <= w.load(longest) * cutoff  # never where one is no number, which shows
            w.store(w.where(short, 0.0, w.number(1.0) / w.where(short, 1.0, length * length)), weights, i)


def write_solved(w: Writer, rows: int, columns: int) -> None:
    """`solved(B, weights, b, x)`: x = A+ b."""
    width = rows + columns
    with w.procedure("solved", "B weights b x") as (B, weights, b, x):
        with w.counted(0, columns) as k:
            w.store(0.0, x, k)
        with w.counted(0, rows) as i:
            row = w.at(B, i * width)
            share = w.load(weights, i) * _product_of_rows(w, w.at(row, columns), b, rows)
            with w.counted(0, columns) as k:
                w.store(w.fma(share, w.load(row, k), w.load(x, k)), x, k)


def write_cholesky(w: Writer, n: int) -> None:
    """`cholesky(M)`: L in place of the lower triangle of M; the identity where M is not positive definite to round-off, NaN where it is not finite."""
    with w.procedure("cholesky", "M") as (M,):
        finite, smallest = w.room(), w.room()
        w.store(0.0, finite)  # stays zero where all entries are finite
        w.store(1.0, smallest)
        with w.counted(0, n) as i, w.counted(0, n) as j:
            w.store(w.fma(w.load(M, i * n + j), 0.0, w.load(finite)), finite)
        with w.counted(0, n) as i:
            row = w.at(M, i * n)
            with w.counted(0, i) as j:
                other = w.at(M, j * n)
                rest = w.load(row, j) - _product_of_rows(w, row, other, j)
                w.store(rest / w.load(other, j), row, j)
            pivot = w.load(row, i) - _product_of_rows(w, row, row, i)
            w.store(w.smaller(w.load(smallest), pivot), smallest)
            w.store(w.root(pivot), row, i)
        is_finite = w.load(finite).equals(0.0)
        definite = w.load(smallest) > 16 * n * _EPS
        with w.counted(0, n) as i, w.counted(0, i + 1) as j:
            on_diagonal = w.converted("uitofp", i.equals(j), "double")
            one = w.spread(on_diagonal)
            w.store(w.where(is_finite, w.where(definite, w.load(M, i * n + j), one), float("nan")), M, i * n + j)


def write_triangular(w: Writer, n: int) -> None:
    """`forward(L, x)` and `backward(L, x)`: L^-1 x and L'^-1 x in place of x."""
    with w.procedure("forward", "L x") as (L, x), w.counted(0, n) as i:
        row = w.at(L, i * n)
        w.store((w.load(x, i) - _product_of_rows(w, row, x, i)) / w.load(row, i), x, i)
    with w.procedure("backward", "L x") as (L, x), w.counted(0, n) as before:
        i = w.literal(n - 1, "i64") - before
        row = w.at(L, i * n)
        value = w.load(x, i) / w.load(row, i)
        w.store(value, x, i)
        with w.counted(0, i) as k:
            w.store(w.load(x, k) - value * w.load(row, k), x, k)
