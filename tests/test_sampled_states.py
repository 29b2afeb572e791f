"""States by which a scene is judged lie on its rows and in its domain, so that overconstrained linkages show their rank."""

import numpy as np
import pytest
from linkages import Parallelogram, SliderCrank, Windows, bennett, bricard

import jourdain_jax as jj
from jourdain_jax import structure_of
from jourdain_jax.build.domain import coordinate_bounds
from jourdain_jax.equations.projection import closure_residual

LINKAGES = {
    "Bennett": (bennett(0.7, 1.2), 3),
    "another Bennett": (bennett(1.1, 0.4, 0.8), 3),
    "Bricard": (bricard(1.0, 1.2, 0.8, 0.9, 1.1), 5),
    "another Bricard": (bricard(1.0, 0.9, 1.1, 1.0, 0.8), 5),
    "parallelogram": (Parallelogram(), 2),
    "slider-crank": (SliderCrank(), 2),
    "windows": (Windows(3), 9),
}


@pytest.mark.parametrize("name", LINKAGES)
def test_a_linkage_of_one_freedom_a_loop_has_its_rank_and_freedoms(name):
    scene, rank = LINKAGES[name]
    found = structure_of(scene)
    assert found.rank == rank
    assert found.degrees_of_freedom == len(scene.coordinate_names) - rank


@pytest.mark.parametrize("name", LINKAGES)
def test_probed_configurations_are_on_the_rows_and_in_the_domain(name):
    scene, _ = LINKAGES[name]
    found, (low, high) = structure_of(scene), coordinate_bounds(scene)
    closures = [np.max(np.abs(closure_residual(scene, t, q))) for t, q in zip(found.times[:8], found.coordinates[:8], strict=True)]
    assert max(closures) < 1e-11
    outside = np.maximum(low - found.coordinates, found.coordinates - high) / (high - low)
    assert found.random >= 4
    assert np.max(outside) <= 0.1


@pytest.mark.parametrize("name", ["Bennett", "parallelogram", "windows"])
def test_sampled_states_are_on_the_rows_and_in_the_domain(name):
    scene, _ = LINKAGES[name]
    t, q, _ = jj.sample_states(scene, 5, seed=3)
    low, high = coordinate_bounds(scene)
    assert max(np.max(np.abs(closure_residual(scene, *state))) for state in zip(t, q, strict=True)) < 1e-11
    assert np.all((q >= low - 0.1 * (high - low)) & (q <= high + 0.1 * (high - low)))
