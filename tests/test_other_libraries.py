"""Pages that hand scenes, motions and fits to other libraries run, and their results are right."""

import importlib

import numpy as np
import pytest
from numpy.testing import assert_allclose
from pages import DOCS, run

import jourdain_jax as jj


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
    assert found["gravity"] == pytest.approx(3.7, abs=2e-3)


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


@pytest.fixture(scope="module")
def parked():
    """What the script of the page on parking leaves."""
    pytest.importorskip("casadi")
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(DOCS / "howto")
        yield importlib.import_module("park_by_casadi")


def test_casadi_has_the_rates_of_the_engine(parked):
    q, u, f = [0.3, -0.2, 0.4, 0.2, -0.1], {"x_rate": 0.7, "steer_rate": 0.3}, np.array([200.0, 30.0])
    names = parked.car.coordinate_names.entries
    state = jj.start(parked.car, **dict(zip(names, q, strict=True)), **u)
    expected = np.asarray(jj.accelerations(parked.car, 0.0, state.q, state.u, inputs=f).udot)
    found = np.ravel(
        parked.casadi.evalf(parked.rates(parked.casadi.DM([*q, *u.values()]), parked.casadi.DM(f)))
    )
    assert_allclose(found[:5], state.u, rtol=1e-12)
    assert_allclose(found[5:], expected[[0, 3]], rtol=1e-10)


def test_ipopt_parks_a_car_with_a_trailer_through_casadi(parked):
    assert parked.parked.stats()["success"]
    assert_allclose(parked.motion.q[-1], [0.0, -2.5, 0.0, 0.0, 0.0], atol=5e-3)
    assert 0.59 < np.max(np.abs(parked.motion["steer"])) < 0.61  # at its bound
    told = (DOCS / "howto" / "parking.md").read_text(encoding="utf-8")
    assert f"{parked.end:.2f} s" in told


def test_ipopt_parks_it_through_opty(parked):
    for library in ("opty", "cyipopt", "Cython", "sympy"):
        pytest.importorskip(library)
    found = importlib.import_module("park_by_opty")
    assert found.info["status"] in (0, 1)  # solved, or to an acceptable level
    effort = found.step * float(parked.casadi.sumsqr(parked.parked.value(parked.f)))
    assert_allclose(found.info["obj_val"], 0.92 * effort, rtol=0.02)
    x = found.solution.reshape(9, -1)
    assert_allclose(x[:7, -1], [0.0, -2.5, 0.0, 0.0, 0.0, 0.0, 0.0], atol=1e-6)
