"""Parameters that follow from others in a fit, and numbers that follow from what was found."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose
from refusals import refused
from slopes import slope

import jourdain_jax as jj
from jourdain_jax.identification import MultipleShooting, log_density, log_likelihood, unbounded

Sleigh = jj.models.ChaplyginSleigh
START, TIMES = {"x_rate": 0.6, "heading_rate": 0.9}, np.linspace(0.0, 2.0, 21)
TRUTH = Sleigh(mass=2.0, offset=0.25, inertia=0.25)
TIED = {"offset": jj.bounds(0.05, 1.0), "inertia": lambda scene: 0.5 * scene.mass * scene.offset}


def measured(seed, repeats=()):
    motion, noise = jj.simulate(TRUTH, START, ts=TIMES), np.random.default_rng(seed)
    values = {
        name: np.asarray(motion[name]) + 0.01 * noise.normal(size=(*repeats, TIMES.size))
        for name in ("x", "heading")
    }
    return jj.Experiment(TIMES, values, 0.01, start=START)


@pytest.fixture(scope="module")
def data():
    return measured(0)


@pytest.fixture(scope="module")
def found(data):
    return jj.fit(Sleigh(mass=2.0), data, free=TIED)


def test_a_tied_parameter_follows_and_its_interval_with_it(found):
    assert found.labels == ("offset",)
    assert found.converged
    tied, offset = found.tied["inertia"], found["offset"]
    assert_allclose(found.scene.inertia, found.scene.offset, rtol=1e-15)  # 0.5 * 2 kg * offset
    for name in ("value", "standard_error", "low", "high"):
        assert_allclose(getattr(tied, name), getattr(offset, name), rtol=1e-12)
    assert tied.unit == "kg m^2"
    assert "(tied)" in str(found)


def test_the_page_of_a_fit_tells_tied_parameters(found, tmp_path):
    found.report(tmp_path / "fit.html")
    assert re.search(
        rf"inertia +kg m\^2 +{found.scene.inertia:.6g} .*\(tied\)", (tmp_path / "fit.html").read_text()
    )


def test_the_fit_is_at_the_greatest_likelihood_along_the_tie(found, data):
    def along(offset):
        return float(log_likelihood(Sleigh(mass=2.0, offset=offset, inertia=offset), data))

    best, step = float(found.scene.offset), float(found["offset"].standard_error)
    below, at, above = (along(best + k * step) for k in (-1, 0, 1))
    down = 2 * at - above - below  # one standard error is half a unit down to either side
    assert_allclose(down, 1.0, rtol=0.05)
    assert abs(above - below) < 0.02 * down  # the parabola's top is within a hundredth of one


def test_a_density_has_the_slope_along_the_tie(data):
    density = log_density(Sleigh(mass=2.0), data, free={"offset": unbounded(0.1), "inertia": TIED["inertia"]})
    at = lambda offset: density.unconstrain({"offset": offset})
    assert_allclose(jax.grad(density)(at(0.3))[0], slope(lambda x: density(at(x)), 0.3, 1e-5), rtol=1e-6)
    assert_allclose(density.scene_at(at(0.3)).inertia, 0.3, rtol=1e-14)


def test_ties_of_a_batch_and_in_pieces_are_those_of_one_fit(found, data):
    batch = jj.fit_batch(Sleigh(mass=2.0), measured(0, (3,)), free=TIED)
    assert_allclose(batch.scene.inertia, batch.scene.offset, rtol=1e-15)
    assert_allclose(batch.tied["inertia"].standard_error, batch["offset"].standard_error, rtol=1e-12)
    assert_allclose(
        batch.derived(lambda scene: scene.inertia).standard_error, batch["offset"].standard_error, rtol=1e-9
    )
    pieces = jj.fit(Sleigh(mass=2.0), data, free=TIED, shooting=MultipleShooting(pieces=2))
    assert_allclose(pieces.scene.inertia, found.scene.inertia, rtol=1e-4)


def test_ties_follow_from_ties_before_them(data):
    free = {
        "offset": None,
        "inertia": lambda scene: scene.offset * 1.0,
        "mass": lambda scene: 8.0 * scene.inertia,
    }
    density = log_density(Sleigh(), data, free=free)
    scene = density.scene_at(density.unconstrain({"offset": 0.3}))
    assert_allclose(scene.mass, 8.0 * scene.offset, rtol=1e-15)


def test_a_combination_is_told_whose_parts_are_not(data):
    together = jj.fit(Sleigh(mass=2.0), data, free=("mass", "inertia", "offset"))
    known = jj.fit(Sleigh(mass=2.0), data, free=("inertia", "offset"))
    ratio = together.derived(lambda scene: scene.inertia / scene.mass, "m^2")
    assert np.isnan(together["inertia"].standard_error)
    assert_allclose(ratio.value, known["inertia"].value / 2.0, rtol=1e-5)
    assert_allclose(ratio.standard_error, known["inertia"].standard_error / 2.0, rtol=1e-3)
    assert_allclose((ratio.high - ratio.low) / 2, 1.959963985 * ratio.standard_error, rtol=1e-8)
    several = together.derived(lambda scene: jnp.stack([scene.mass, scene.offset, scene.offset**2]))
    offset = together["offset"]
    expected = np.array([np.nan, 1.0, 2 * offset.value]) * offset.standard_error
    assert_allclose(several.standard_error, expected, rtol=1e-9)


def test_a_derived_number_at_a_bound_has_no_interval(data):
    found = jj.fit(Sleigh(mass=2.0, offset=0.5), data, free=TIED | {"offset": jj.bounds(0.3, 1.0)})
    assert found.at_bound[0]
    assert np.isnan(found.derived(lambda scene: 2 * scene.offset).standard_error)
    assert found.derived(lambda scene: 2 * scene.mass).standard_error == 0


def test_derived_numbers_must_be_numbers(found):
    refused(r"the function returns .*offset.*, expected a number", found.derived, lambda scene: "offset")
