"""Long chains of bodies take a time in proportion to their length: counted in operations and entries, not in
seconds.

Sparse matrices are compared with dense matrices.
"""

from dataclasses import replace

import numpy as np
from numpy.testing import assert_allclose, assert_array_equal

from jourdain_jax.calculus.roots import shortest
from jourdain_jax.calculus.sparse_slopes import Pattern
from jourdain_jax.structure.assembly import assemble


def links(count):
    """Rods in a row whose ends are points of a plane, and points on a zigzag: their rows in an order of no
    use.
    """
    order = np.random.default_rng(0).permutation(count)
    entries = [(int(order[i]), 2 * j + axis) for i in range(count) for j in (i, i + 1) for axis in range(2)]
    points = np.stack([np.arange(count + 1.0), np.arange(count + 1) % 2 * 0.3], axis=1).ravel()
    return Pattern.of(entries, (count, 2 * count + 2)), points


def looking(pattern, squares):
    """Of the squared lengths of those rods."""

    def look(q, which):
        G = np.zeros((len(q), *pattern.shape))
        difference = [
            q[:, pattern.columns[4 * k + 2 : 4 * k + 4]] - q[:, pattern.columns[4 * k : 4 * k + 2]]
            for k in range(pattern.shape[0])
        ]
        for k, d in enumerate(difference):
            row = pattern.rows[4 * k]
            G[:, row, pattern.columns[4 * k : 4 * k + 4]] = np.concatenate([-2 * d, 2 * d], axis=1)
        residual = np.zeros((len(q), pattern.shape[0]))
        residual[:, pattern.rows[::4]] = np.stack([np.sum(d**2, axis=1) for d in difference], axis=1)
        return residual - squares, G[:, pattern.rows, pattern.columns]

    return look


def test_rows_of_a_chain_are_sparse_and_few_or_full_ones_are_not():
    assert links(100)[0].is_sparse
    assert not links(30)[0].is_sparse
    assert not Pattern.of([(i, k) for i in range(70) for k in range(80)], (70, 80)).is_sparse


def test_chains_are_assembled_by_sparse_matrices_as_by_dense_ones():
    pattern, points = links(80)
    q = points + 0.4 * np.random.default_rng(1).normal(size=(6, len(points)))
    low, high, generic = np.full(len(points), -2.0), np.full(len(points), 82.0), np.ones(6, bool)
    look = looking(pattern, np.full(80, 1.09))
    found = assemble(look, pattern, q, low, high, generic)
    dense = replace(pattern, fewest=1000)
    assert pattern.is_sparse
    assert not dense.is_sparse
    expected = assemble(look, dense, q, low, high, generic)
    assert found.on_rows.all()
    assert_array_equal(found.on_rows, expected.on_rows)
    assert_allclose(found.q, expected.q, rtol=0, atol=1e-9)


def test_rows_that_depend_on_each_other_have_the_shortest_solution_of_least_squares():
    pattern, _ = links(80)
    values = np.random.default_rng(3).uniform(0.5, 1.0, (3, len(pattern.rows)))
    values[1, pattern.rows == pattern.rows[40]] = 0.0  # no row at all
    values[2] = np.nan
    f = np.ones((3, 80))
    assert_allclose(pattern.shortest(values, f), shortest(pattern.dense(values), f), rtol=1e-7, atol=1e-12)


def test_nearly_dependent_rows_are_known_although_every_pivot_is_large():
    n = 120  # pivots of 1/4, the inverse grows with 3^n
    pattern = Pattern.of([(i, i) for i in range(n)] + [(i + 1, i) for i in range(n - 1)], (n, n))
    values = np.concatenate([[1.0], np.full(n - 1, 0.5), np.full(n - 1, np.sqrt(0.75))])[None]
    f = np.random.default_rng(4).normal(size=(1, n))
    assert pattern.is_sparse
    assert_allclose(pattern.shortest(values, f), shortest(pattern.dense(values), f), rtol=1e-6)
