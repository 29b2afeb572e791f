"""Long chains of bodies take a time in proportion to their length: counted in operations and entries, not in seconds.

Elimination in a narrow band is compared with dense matrices.
"""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
from numpy.testing import assert_allclose, assert_array_equal

import jourdain_jax as jj
from jourdain_jax.build import structure
from jourdain_jax.build.assembling import assemble
from jourdain_jax.calculus import sparse_slopes
from jourdain_jax.calculus.sparse_slopes import Pattern
from jourdain_jax.lowering import ignorable
from jourdain_jax.models import TrailerChain
from jourdain_jax.program.evaluate import Probes
from jourdain_jax.program.graph import Graph
from jourdain_jax.program.identity_test import identity_probes


def links(count: int) -> tuple[Pattern, np.ndarray]:
    """Rods in a row whose ends are points of a plane, and points on a zigzag: their rows in an order of no use."""
    order = np.random.default_rng(0).permutation(count)
    entries = [(int(order[i]), 2 * j + axis) for i in range(count) for j in (i, i + 1) for axis in range(2)]
    points = np.stack([np.arange(count + 1.0), np.arange(count + 1) % 2 * 0.3], axis=1).ravel()
    return Pattern.of(entries, (count, 2 * count + 2)), points


def looking(pattern: Pattern, squares: np.ndarray):
    """Of the squared lengths of those rods."""

    def look(q, which):
        G = np.zeros((len(q), *pattern.shape))
        difference = [q[:, pattern.columns[4 * k + 2 : 4 * k + 4]] - q[:, pattern.columns[4 * k : 4 * k + 2]] for k in range(pattern.shape[0])]
        for k, d in enumerate(difference):
            row = pattern.rows[4 * k]
            G[:, row, pattern.columns[4 * k : 4 * k + 4]] = np.concatenate([-2 * d, 2 * d], axis=1)
        residual = np.zeros((len(q), pattern.shape[0]))
        residual[:, pattern.rows[::4]] = np.stack([np.sum(d**2, axis=1) for d in difference], axis=1)
        return residual - squares, G[:, pattern.rows, pattern.columns]

    return look


def test_rows_of_a_chain_lie_in_a_narrow_band_whatever_their_order():
    short, long = (links(count)[0].band for count in (100, 200))
    assert short.width == long.width == 1
    assert len(long.places) < 2.05 * len(short.places)
    assert links(30)[0].band is None  # few rows are dense
    everywhere = Pattern.of([(i, k) for i in range(70) for k in range(80)], (70, 80))
    assert everywhere.band is None


def test_chains_are_assembled_in_a_band_as_by_dense_matrices():
    pattern, points = links(80)
    q = points + 0.4 * np.random.default_rng(1).normal(size=(6, len(points)))
    low, high, generic = np.full(len(points), -2.0), np.full(len(points), 82.0), np.ones(6, bool)
    look = looking(pattern, np.full(80, 1.09))
    found = assemble(look, pattern, q, low, high, generic)
    dense = replace(pattern, fewest=1000)
    assert pattern.band is not None
    assert dense.band is None
    expected = assemble(look, dense, q, low, high, generic)
    assert found.on_rows.all()
    assert_array_equal(found.on_rows, expected.on_rows)
    assert_allclose(found.q, expected.q, rtol=0, atol=1e-9)


def test_a_band_knows_rows_that_depend_on_each_other():
    pattern, _ = links(64)
    values = np.random.default_rng(3).uniform(0.5, 1.0, (2, len(pattern.rows)))
    values[1, pattern.rows == pattern.rows[40]] = 0.0  # no row at all
    values /= np.where(pattern.lengths(values) > 0, pattern.lengths(values), 1.0)[:, pattern.rows]
    f = np.ones((2, 64))
    x, size = pattern.band.solved(values, np.zeros(2), f)
    G = pattern.dense(values)[0]
    assert_allclose(x[0], np.linalg.solve(G @ G.T, f[0]), rtol=1e-10)
    exact = np.linalg.norm(np.linalg.inv(G @ G.T), np.inf)
    assert 0.1 * exact < size[0] < 1.001 * exact
    assert not size[1] < sparse_slopes.REGULAR


def test_nearly_dependent_rows_are_known_although_every_pivot_is_large():
    n = 120  # pivots of 1/4, the inverse grows with 3^n
    pattern = Pattern.of([(i, i) for i in range(n)] + [(i + 1, i) for i in range(n - 1)], (n, n))
    values = np.concatenate([[1.0], np.full(n - 1, 0.5), np.full(n - 1, np.sqrt(0.75))])[None]
    assert not pattern.band.solved(values, np.zeros(1), np.ones((1, n)))[1][0] < sparse_slopes.REGULAR


def test_what_acts_by_less_than_round_off_is_not_left_out():
    n = 8
    graph = Graph()
    headings = [graph.input(f"q_{i}", True) for i in range(n)]
    rate = graph.one
    for q in headings:  # the last one changes the rate by some 1e-5 to the power of the number of those before
        rate = graph.add(graph.one, graph.mul(graph.const(1e-5), graph.mul(graph.call("cos", q), rate)))
    states = {f"q_{i}": np.random.default_rng(i).normal(size=12) for i in range(n)}
    builder = SimpleNamespace(graph=graph, identity_probes=identity_probes(Probes(graph, states), ()))
    assert ignorable._with_slopes(builder, [rate], headings, np.ones(12, bool)) == set(headings)
    sine, cosine = (graph.call(name, headings[1]) for name in ("sin", "cos"))
    none = graph.add(graph.mul(sine, sine), graph.mul(cosine, cosine))
    assert ignorable._with_slopes(builder, [none], headings[1:2], np.ones(12, bool)) == set()


def test_a_motion_finds_the_structure_of_its_scene_once(monkeypatch):
    looked, probed = [], structure._probed_structure
    monkeypatch.setattr(structure, "_probed_structure", lambda scene: looked.append(scene) or probed(scene))
    motion = jj.simulate(TrailerChain(trailers=2, car_mass=1.2345), t1=0.1)
    motion.raise_if_failed()
    assert len(looked) == 1
