"""Pages that hand scenes, motions and fits to other libraries run, and their results are right."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from pages import DOCS, run


def page(name, *libraries):
    for library in libraries:
        pytest.importorskip(library)
    return run(DOCS / "howto" / f"{name}.md")


def test_a_bicycle_is_stabilised_by_python_control():
    found = page("controller", "control")
    closed, poles = found["closed"].eigenvalues(), found["poles"]
    assert_allclose(np.sort_complex(closed), np.sort_complex(poles), rtol=1e-10)
    assert np.max(found["small"].eigenvalues().real) > 1.0
    assert found["ride"].succeeded
    assert abs(found["ride"].end["lean"]) < 1e-4


def test_numpyro_draws_a_posterior_that_arviz_trusts():
    found = page("posterior", "arviz", "numpyro")
    table = found["arviz"].summary(found["draws"], round_to="none")
    assert table["r_hat"].max() < 1.05
    assert table["ess_bulk"].min() > 100
    # skewed: the linearised error of the inertia, 0.095 kg m^2, is too small
    fit = found["found"]
    assert 1.2 < table["sd"]["inertia"] / fit["inertia"].standard_error < 2.5
    assert table["mean"]["offset"] == pytest.approx(fit["offset"].value, abs=1.5 * table["sd"]["offset"])


def test_optax_finds_gravity_through_a_rollout():
    found = page("optax", "optax")
    assert float(found["gravity"]) == pytest.approx(3.7, abs=2e-3)


def test_environments_of_gymnasium_agree_and_policies_keep_bicycles_upright():
    found = page("gymnasium", "gymnasium")
    assert len(found["alone"]) < len(found["steered"]) == 201
    assert found["falls"] == 0
    single, several = found["BicycleEnv"](), found["BicyclesEnv"](2)
    single.reset(seed=1)
    several.reset(seed=1)
    several.states["lean"][0] = single.state["lean"]
    for _ in range(3):
        seen, reward, _, _, _ = single.step(np.array([0.3]))
        both, rewards, fallen, late, _ = several.step(np.array([[0.3], [-0.3]]))
        assert_allclose(both[0], seen, atol=1e-7)
        assert rewards[0] == pytest.approx(reward, abs=1e-9)
    assert not np.any(fallen | late)
    several.ended[1] = True
    begun, rewards, _, _, _ = several.step(np.zeros((2, 1)))
    assert rewards[1] == 0.0
    assert_allclose(begun[1, 1:], 0.0)
