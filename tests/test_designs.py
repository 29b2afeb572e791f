"""Samples of studies: the same for a seed and a number whatever else is drawn, and spread as their
distributions say.
"""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from refusals import refused

from jourdain_jax.studies import Design, Levels, LogNormal, LogUniform, Normal, Uniform

TWO = {"mass": Normal(12.0, 0.3), "radius": Uniform(0.3, 0.4)}
SAMPLERS = ("random", "latin-hypercube", "sobol", "saltelli")


@pytest.mark.parametrize("sampler", SAMPLERS)
def test_a_sample_depends_on_its_number_alone(sampler):
    design = Design(TWO, sampler=sampler, samples=400, seed=7)
    together = design.values()
    for first, last in ((0, 1), (13, 14), (17, 230), (399, 400)):
        for name, column in design.values(first, last).items():
            assert_array_equal(column, together[name][first:last])
    assert not np.any(Design(TWO, sampler=sampler, samples=400, seed=8).values()["mass"] == together["mass"])


@pytest.mark.parametrize("sampler", ["random", "sobol"])
def test_more_samples_begin_with_the_same_ones(sampler):
    few, many = (Design(TWO, sampler=sampler, samples=n, seed=3).values(0, 100)["mass"] for n in (100, 5000))
    assert_array_equal(few, many)


@pytest.mark.parametrize("count", [1, 2, 3, 63, 64, 65, 777])
def test_a_latin_hypercube_has_one_sample_in_each_stratum(count):
    at = Design(TWO, sampler="latin-hypercube", samples=count, seed=1).values()
    assert_array_equal(np.sort(np.floor((at["radius"] - 0.3) / 0.1 * count)), np.arange(count))
    assert count < 777 or abs(np.mean(at["mass"]) - 12.0) < 1e-4


@pytest.mark.parametrize(
    ("distribution", "quantile"),
    [
        (Normal(2.0, 0.5), lambda p: {0.5: 2.0, 0.975: 2.0 + 0.5 * 1.959963984540054}[p]),
        (Uniform(-1.0, 3.0), lambda p: -1.0 + 4.0 * p),
        (LogNormal(2.0, 0.5), lambda p: 2.0 * np.exp({0.5: 0.0, 0.975: 0.5 * 1.959963984540054}[p])),
        (LogUniform(0.1, 10.0), lambda p: 0.1 * 100.0**p),
    ],
)
def test_quantiles_of_samples_are_those_of_the_distribution(distribution, quantile):
    values = Design({"x": distribution}, sampler="sobol", samples=2**14, seed=2).values()["x"]
    for p in (0.5, 0.975):
        assert_allclose(np.quantile(values, p), quantile(p), rtol=2e-3)


@pytest.mark.parametrize("sampler", ["random", "latin-hypercube", "sobol"])
def test_normal_quantities_have_the_correlation_asked_for(sampler):
    names = {"a": Normal(0.0, 1.0), "b": Normal(5.0, 2.0), "c": Normal(1.0, 0.1)}
    design = Design(
        names, sampler=sampler, samples=4096, seed=4, correlation={("a", "b"): 0.8, ("c", "b"): -0.3}
    )
    found = np.corrcoef(np.stack(list(design.values().values())))
    assert_allclose(found, [[1.0, 0.8, 0.0], [0.8, 1.0, -0.3], [0.0, -0.3, 1.0]], atol=4 / np.sqrt(4096))
    assert_allclose(np.std(design.values()["b"]), 2.0, rtol=0.05)


def test_a_grid_crosses_its_levels_and_a_table_is_taken_as_it_is():
    grid = Design({"a": Levels([1.0, 2.0]), "b": Levels([10.0, 20.0, 30.0])})
    assert len(grid) == 6
    assert_array_equal(grid.values()["a"], [1, 1, 1, 2, 2, 2])
    assert_array_equal(grid.values(2, 5)["b"], [30, 10, 20])
    table = Design({"a": [3.0, 1.0, 2.0], "b": np.arange(3)})
    assert_array_equal(table.values(1, 3)["a"], [1.0, 2.0])
    assert "3 values from 1 to 3" in str(table)


def test_impossible_correlations_are_refused():
    names = dict.fromkeys("abc", Normal(0.0, 1.0))
    refused(
        "not positive definite",
        Design,
        names,
        samples=8,
        correlation={("a", "b"): 0.9, ("b", "c"): 0.9, ("a", "c"): -0.9},
    )
    refused("give it once", Design, names, samples=8, correlation={("a", "b"): 0.9, ("b", "a"): -0.9})
