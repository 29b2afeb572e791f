"""Parameters of bicycles from periods, hang angles and lengths: against the published ones, with their covariance."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose
from oracles.hang_lines import mean_of_intersections

from jourdain_jax.bicycle import Refused, benchmark_from_measurements, measured_bicycle, sample_parameters, shipped_bicycles, shipped_measurements, study
from jourdain_jax.bicycle.from_measurements import SwungPart, TwistedPart, period
from jourdain_jax.bicycle.parameters import PARAMETER_NAMES
from jourdain_jax.bicycle.readings import read_readings
from jourdain_jax.cli import main

# what follows from the places of mass centres; these are least squares here, published as means over pairs of lines
ABOUT_CENTRES = ("xB", "zB", "xH", "zH", "IByy", "IHyy")
DELFT = ["Browser", "Browserins", "Crescendo", "Fisher", "Pista", "Yellow", "Yellowrev"]


def off(name, of=None):
    """Values less published ones over published sigmas, and sigmas over published ones, by parameter."""
    found, published = benchmark_from_measurements(name), measured_bicycle(name)
    sigma = published.sigmas
    return {n: ((found.values[n] - published.values[n]) / sigma[n], found.sigmas[n] / sigma[n]) for n in (of or PARAMETER_NAMES)}


def test_periods_of_the_scenes_are_those_of_the_formulas():
    found = jax.jit(period)(SwungPart(mass=2.0, inertia=0.3, length=0.4, gravity=9.8))
    assert_allclose(found, 2 * np.pi * np.sqrt((0.3 + 2.0 * 0.4**2) / (2.0 * 9.8 * 0.4)), rtol=1e-13)
    tilt, n = 0.7, np.array([-np.sin(0.7), np.cos(0.7)])
    along = n @ np.array([[0.3, 0.1], [0.1, 0.5]]) @ n
    found = jax.jit(period)(TwistedPart(Ixx=0.3, Izz=0.5, Ixz=0.1, tilt=tilt, stiffness=4.0))
    assert_allclose(found, 2 * np.pi * np.sqrt(along / 4.0), rtol=1e-13)


@pytest.mark.parametrize("name", DELFT)
def test_published_parameters_and_sigmas_follow_from_the_measurements(name):
    of = off(name)
    for parameter in set(PARAMETER_NAMES) - set(ABOUT_CENTRES):
        apart, ratio = of[parameter]
        assert abs(apart) < 1e-6, parameter
        assert abs(ratio - 1) < 1e-6, parameter
    assert max(abs(of[parameter][0]) for parameter in ABOUT_CENTRES) < 1.5
    assert max(of[parameter][1] for parameter in ABOUT_CENTRES) < 1.01  # least squares are hardly wider


@pytest.mark.parametrize("name", [*DELFT, "Balanceassistv1"])
def test_centres_of_mass_differ_by_how_lines_are_averaged_only(name):
    """Means over pairs of lines give the published places, and so do the lines of this package."""
    readings, found, published = read_readings(shipped_measurements()[name]), benchmark_from_measurements(name), measured_bicycle(name)
    for part, hung_by in (("B", (0.0, -found.values["rR"])), ("H", (found.values["w"], -found.values["rF"]))):
        angles, beside = ([readings.means[f"{what}{part}{k}"] for k in readings.hangings[part]] for what in ("alpha", "a"))
        x, z = mean_of_intersections(np.deg2rad(angles), np.array(beside), found.values["lam"])
        digits = 1e-3 if name == "Balanceassistv1" else 1e-9  # its file gives three of them
        assert_allclose([hung_by[0] + x, hung_by[1] + z], [published.values[f"x{part}"], published.values[f"z{part}"]], atol=digits)


def test_a_fork_measured_apart_from_its_handlebar_and_a_frame_on_a_table():
    """The sigma of the trail is smaller than the published one; here the trail keeps the correlation of the radius with the tilt."""
    of = off("Rigid")
    of_table = {n: of[n] for n in ("w", "lam", "rR", "IRxx", "IRyy", "IFxx", "IFyy", "IBxx", "IBzz", "IBxz", "mH")}
    assert max(abs(apart) for apart, _ in of_table.values()) < 1e-6
    assert max(abs(ratio - 1) for _, ratio in of_table.values()) < 1e-2
    assert abs(of["c"][0]) < 1e-6
    assert 0.6 < of["c"][1] < 0.8
    assert max(abs(apart) for apart, _ in of.values()) < 2.0


def test_a_file_with_rounded_values_is_met_within_its_digits():
    of = off("Balanceassistv1", [n for n in PARAMETER_NAMES if n not in (*ABOUT_CENTRES, "g")])
    assert max(abs(apart) for apart, _ in of.values()) < 0.1
    warnings = benchmark_from_measurements("Balanceassistv1").warnings
    assert any("part H miss its mass centre by up to 23.1 mm, 8 sigmas" in text for text in warnings)


@pytest.mark.parametrize("name", ["Gyro", "Rigidcl", "Stratos"])
def test_bicycles_without_published_parameters_are_bicycles(name):
    assert name not in shipped_bicycles()
    found = benchmark_from_measurements(name)
    assert all(sigma > 0 for sigma in found.sigmas.values())


def test_derivatives_by_readings_are_central_differences(tmp_path):
    text = shipped_measurements()["Browser"].read_text()
    whole = benchmark_from_measurements(write(tmp_path, text))
    for name, sigma in (("lR", 0.001), ("alphaB2", 0.2), ("TtP1", 5.93377589066e-06), ("gamma", 0.2), ("dF", 0.01)):
        (line,) = [line for line in text.splitlines() if line.split("=")[0].strip() == name]
        value = float(line.partition("=")[2].partition("+/-")[0])
        ends = [benchmark_from_measurements(write(tmp_path, text.replace(line, f"{name} = {value + by!r}"))).values for by in (1e-4 * sigma, -1e-4 * sigma)]
        slope = np.array([(ends[0][n] - ends[1][n]) / 2e-4 for n in PARAMETER_NAMES])
        # what this reading adds to the covariance: known exactly, it is gone
        less = benchmark_from_measurements(write(tmp_path, text.replace(line, f"{name} = {value!r}+/-0.0"))).covariance
        assert_allclose(whole.covariance - less, np.outer(slope, slope), rtol=1e-5, atol=1e-9 * np.abs(whole.covariance).max())


def test_samples_have_the_covariance():
    found = benchmark_from_measurements("Browser")
    samples = np.asarray(sample_parameters(found, jax.random.key(0), 20000).values)
    sigma = np.array([found.sigmas[n] for n in PARAMETER_NAMES])
    assert_allclose(np.cov(samples.T) / np.outer(sigma, sigma), found.covariance / np.outer(sigma, sigma), atol=0.03)
    i, j = PARAMETER_NAMES.index("IRxx"), PARAMETER_NAMES.index("IFxx")
    assert found.covariance[i, j] / (sigma[i] * sigma[j]) > 0.99  # both are gauged by one rod


def test_a_study_takes_measurements_and_its_limits_are_narrower(tmp_path):
    measured, published = (study(of["Crescendo"], samples=400) for of in (shipped_measurements(), shipped_bicycles()))
    width = [one.speeds["weave_speed"]["high"] - one.speeds["weave_speed"]["low"] for one in (measured, published)]
    assert 0.5 < width[0] / width[1] < 0.75  # 0.199 and 0.331 m/s with 2,000 samples
    assert isinstance(study(write(tmp_path, "g = 9.81"), samples=10), Refused)


def test_the_command_takes_measurements_by_name(tmp_path, capsys):
    assert main(["bicycle", "BrowserMeasured", "--samples", "60", "--no-figures", "--out", str(tmp_path)]) == 0
    assert "parameters from raw measurements, with their covariance" in capsys.readouterr().out


def write(folder, text):
    path = folder / "OneMeasured.txt"
    path.write_text(text)
    return path


GOOD = shipped_measurements()["Browser"].read_text()


@pytest.mark.parametrize(
    ("text", "told"),
    [
        (GOOD.replace("TtH3", "TtH9"), "missing `alphaH3`, `aH3`, `TtH3`; the parameters of a bicycle do not follow without"),
        (GOOD.replace("dP =", "dQ ="), "missing `dP`"),
        (GOOD.replace("w = 1.121+/-0.002", "w"), "got `w`, expected `name = reading+/-sigma`"),
        (GOOD.replace("w = 1.121+/-0.002", "w = 1.1, long"), "reading of `w` is `long`, expected a number"),
        (GOOD.replace("w = 1.121+/-0.002", "w = 1.1+/--0.1"), "sigma of `w` is -0.1"),
        (GOOD + "w = 1.2\n", "`w` was already given in line"),
        (GOOD.replace("TcB1 = 1.7", "TcB1 = 0.7"), "these readings belong to no bicycle: `IByy` (rear frame moment of inertia about y) must not be negative"),
    ],
)
def test_bad_files_are_refused_by_name(text, told, tmp_path):
    with pytest.raises(ValueError) as refusal:
        benchmark_from_measurements(write(tmp_path, text))
    assert told in str(refusal.value)
    assert "OneMeasured.txt" in str(refusal.value)


def test_an_unknown_bicycle_is_refused_with_the_nearest_one():
    with pytest.raises(ValueError, match=r"no measurements of a bicycle `Browsr`.*`Browser`"):
        benchmark_from_measurements("Browsr")


def test_several_readings_count_as_their_mean(tmp_path):
    path = write(tmp_path, GOOD.replace("w = 1.121+/-0.002", "w = 1.120+/-0.002, 1.122+/-0.002"))
    readings = read_readings(path)
    assert_allclose([readings.means["w"], readings.sigmas["w"]], [1.121, 0.002 / np.sqrt(2)])
    assert jnp.isfinite(benchmark_from_measurements(path).covariance).all()
