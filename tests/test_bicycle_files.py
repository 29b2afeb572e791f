"""Measured bicycle files: what ships is read or refused as intended, and every refusal says what to do."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import jourdain_jax as jj
from jourdain_jax.bicycle import interval, measured_bicycle, read_bicycle, sample_parameters, shipped_bicycles
from jourdain_jax.bicycle.parameters import PARAMETER_NAMES, PARAMETERS

jax.config.update("jax_enable_x64", True)

SHIPPED = ["Balanceassistv1", "Benchmark", "Browser", "Browserins", "Crescendo", "Fisher", "Pista", "Rigid", "Silver"]
SHIPPED += ["Tms", "Yellow", "Yellowrev"]
GOOD = shipped_bicycles()["Browser"].read_text()


def _written(folder, text, name="SomeBenchmark.txt"):
    path = folder / name
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


def _refusal(path):
    with pytest.raises(ValueError) as refusal:
        read_bicycle(path)
    assert str(path) in str(refusal.value)
    return str(refusal.value)


def test_twelve_bicycles_ship():
    assert sorted(shipped_bicycles()) == SHIPPED


@pytest.mark.parametrize("name", [name for name in SHIPPED if name != "Tms"])
def test_a_shipped_bicycle_is_read(name):
    bicycle = read_bicycle(shipped_bicycles()[name])
    assert bicycle.name == name
    assert tuple(bicycle.values) == tuple(bicycle.sigmas) == PARAMETER_NAMES == tuple(PARAMETERS)
    assert all(np.isfinite(value) for value in bicycle.values.values())
    assert all(sigma >= 0 for sigma in bicycle.sigmas.values())


def test_values_sigmas_and_what_is_left_out_are_kept():
    browser = read_bicycle(shipped_bicycles()["Browser"])
    assert (browser.values["c"], browser.sigmas["c"]) == (0.0685808540382, 0.00169464113488)
    assert browser.without_sigma == ()
    assert read_bicycle(shipped_bicycles()["Balanceassistv1"]).without_sigma == ("g",)
    assert {"mG", "IGxx", "xS", "ISxz"} < set(read_bicycle(shipped_bicycles()["Rigid"]).ignored)
    assert read_bicycle(shipped_bicycles()["Silver"]).ignored == ("IRzz", "yB", "yH", "IFzz")


def test_a_bicycle_without_wheels_is_refused_by_name():
    message = _refusal(shipped_bicycles()["Tms"])
    assert "degenerate" in message
    for name in ("rR", "rF", "mR", "mF"):
        assert f"`{name}`" in message


def test_comments_blank_lines_spaces_and_plus_minus_signs_are_read(tmp_path):
    text = "\ufeff# a comment\n\n" + GOOD.replace("w = 1.121+/-0.002", "  w=1.121 ± 0.002  # wheelbase")
    text = text.replace("g = 9.81+/-0.01", "g = 9.81").replace("\n", "\r\n")
    bicycle = read_bicycle(_written(tmp_path, text))
    assert bicycle.values["w"] == 1.121
    assert bicycle.sigmas["w"] == 0.002
    assert bicycle.sigmas["g"] == 0.0
    assert bicycle.without_sigma == ("g",)


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ("lam = 0.39", "Lam = 0.39", ["line 15", "`Lam`", "`lam`"]),
        ("IBxx = ", "IBxxx = ", ["line 1", "`IBxxx`", "`IBxx`"]),
        ("w = 1.121", "wheelbase = 1.121", ["line 22", "unknown", "nearest"]),
        ("w = 1.121+/-0.002\n", "", ["missing `w`", "Add a line"]),
        ("w = 1.121", "w = 1,121", ["line 22", "`w`", "decimal point"]),
        ("w = 1.121", "w = long", ["line 22", "`w`", "`long`", "expected a number"]),
        ("w = 1.121", "w = 1_121", ["line 22", "`w`", "`1_121`", "expected a number"]),
        ("w = 1.121", "w = nan", ["line 22", "`w`", "finite"]),
        ("w = 1.121+/-0.002", "w = 1.121+/-inf", ["line 22", "sigma of `w`", "finite"]),
        ("w = 1.121+/-0.002", "w = 1.121+/-", ["line 22", "sigma of `w`"]),
        ("w = 1.121+/-0.002", "w = 1.121+/--0.002", ["line 22", "sigma of `w`", ">= 0"]),
        ("w = 1.121+/-0.002", "w 1.121", ["line 22", "expected `name = value`"]),
        ("w = 1.121", "c = 1.121", ["line 22", "`c`", "line 13"]),
        ("w = 1.121", "w = -1.121", ["degenerate", "`w` (wheelbase) must be positive", "w = -1.121"]),
        ("rF = 0.34", "rF = -0.34", ["degenerate", "`rF`", "must be positive"]),
        ("IFyy = 0.14", "IFyy = -0.14", ["degenerate", "`IFyy`", "must not be negative"]),
        ("lam = 0.399", "lam = 22.9", ["degenerate", "`lam`", "radians"]),
    ],
)
def test_a_bad_line_is_refused_with_its_number_name_and_a_remedy(tmp_path, old, new, expected):
    assert old in GOOD
    message = _refusal(_written(tmp_path, GOOD.replace(old, new)))
    for words in expected:
        assert words in message, message


@pytest.mark.parametrize(
    ("content", "expected"),
    [(b"", "empty"), (b"\x89PNG\r\n\xff\xfe", "not UTF-8"), (b"w = 1\0", "binary"), (b"#" * 1_000_001, "larger")],
)
def test_a_file_that_is_no_parameter_file_is_refused(tmp_path, content, expected):
    assert expected in _refusal(_written(tmp_path, content))


def test_a_missing_file_and_a_folder_are_refused(tmp_path):
    _written(tmp_path, GOOD, "MineBenchmark.txt")
    assert "`MineBenchmark.txt`" in _refusal(tmp_path / "MineBenchmrk.txt")
    assert "cannot be read" in _refusal(tmp_path)


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ("IFyy = 0.14", "IFyy = 0.24", "`IFyy` > 2 `IFxx`"),
        ("IHxz = -0.07", "IHxz = -0.27", "not positive definite"),
        ("zB = -0.53", "zB = 0.53", "below the ground"),
        ("g = 9.81", "yB = 0.1\nIRzz = 0.5\ng = 9.81", "`yB` = 0.1 is ignored"),
    ],
)
def test_an_odd_value_is_a_warning_not_a_refusal(tmp_path, old, new, expected):
    assert old in GOOD
    warnings = read_bicycle(_written(tmp_path, GOOD.replace(old, new))).warnings
    assert any(expected in warning for warning in warnings), warnings


def test_samples_have_the_measured_mean_and_sigma():
    bicycle = read_bicycle(shipped_bicycles()["Browser"])
    samples = sample_parameters(bicycle, jax.random.key(0), 4000)
    values = np.array([bicycle.values[name] for name in samples.names])
    sigmas = np.array([bicycle.sigmas[name] for name in samples.names])
    standard = (np.asarray(samples.values) - values) / sigmas
    assert np.abs(standard.mean(0)).max() < 5 / np.sqrt(4000)
    assert np.abs(standard.std(0) - 1).max() < 5 / np.sqrt(2 * 4000)
    assert np.abs(np.corrcoef(standard.T) - np.eye(len(values))).max() < 5 / np.sqrt(4000)
    assert bool(samples.physical.all())
    assert samples.refused == {}


def test_a_parameter_without_sigma_does_not_vary():
    samples = sample_parameters(read_bicycle(shipped_bicycles()["Benchmark"]), jax.random.key(0), 5)
    assert np.ptp(np.asarray(samples.values), axis=0).max() == 0


def test_unphysical_samples_are_counted_and_named(tmp_path):
    text = GOOD.replace("IHzz = 0.0955686343473+/-0.000737521114809", "IHzz = 0.0955686343473+/-0.1")
    samples = sample_parameters(read_bicycle(_written(tmp_path, text)), jax.random.key(1), 2000)
    (sentence,) = samples.refused
    assert "`IHzz`" in sentence
    negative = int((samples.by_name()["IHzz"] < 0).sum())
    assert int(samples.refused[sentence]) == negative == int((~samples.physical).sum()) > 100


def test_limits_are_those_of_the_samples_that_have_the_quantity():
    values = jnp.concatenate([jnp.linspace(0.0, 1.0, 1001), jnp.full(999, jnp.nan)])
    result = interval(values)
    assert_allclose([result.value, result.low, result.high], [0.5, 0.025, 0.975], rtol=1e-12)
    assert float(result.fraction) == 1001 / 2000
    counted = jnp.arange(2000) < 2000 - 999 // 3
    assert float(interval(values, counted=counted, nominal=0.4).fraction) == 1001 / (2000 - 333)
    assert float(interval(values, nominal=0.4).value) == 0.4


def test_a_quantity_that_no_sample_has_has_no_limits():
    result = interval(jnp.full(10, jnp.nan), nominal=jnp.nan)
    assert np.isnan([result.value, result.low, result.high]).all()
    assert float(result.fraction) == 0.0


def test_a_measured_bicycle_is_a_scene_and_a_prior():
    bicycle = measured_bicycle("Browser")
    assert bicycle.values == read_bicycle(shipped_bicycles()["Browser"]).values
    assert {name: float(getattr(bicycle.scene, name)) for name in bicycle.values} == bicycle.values
    assert {name: (prior.mean, prior.sigma) for name, prior in bicycle.prior.items()} == {
        name: (bicycle.values[name], sigma) for name, sigma in bicycle.sigmas.items() if sigma > 0
    }
    design = jj.Study(bicycle.scene, vary=bicycle.prior, sampler="sobol", samples=1024).design
    trail = design.values()["c"]
    assert_allclose([np.mean(trail), np.std(trail)], [bicycle.values["c"], bicycle.sigmas["c"]], rtol=0.01)
    with pytest.raises(ValueError, match=r"no measured bicycle `Browsr`.*Browser"):
        measured_bicycle("Browsr")


FLAT = "# a set of parameters\n---\n" + "".join(f"{name}: {value!r}\n" for name, value in read_bicycle(shipped_bicycles()["Browser"]).values.items())
HEADED = "parameterization: benchmark\nrider: False\ndescription: |\n  A bicycle: with c: 3.\nvalues:\n"
SECTION = HEADED + "".join(f"  {line}  # measured\n" for line in FLAT.splitlines()[2:]) + "note: c\n"


@pytest.mark.parametrize("text", [FLAT + "v: 5.0\n", SECTION])
@pytest.mark.parametrize("ending", ["yml", "yaml"])
def test_a_set_in_yaml_is_read(tmp_path, text, ending):
    bicycle = read_bicycle(_written(tmp_path, text, f"benchmark-browser.{ending}"))
    assert bicycle.values == read_bicycle(shipped_bicycles()["Browser"]).values
    assert bicycle.without_sigma == PARAMETER_NAMES
    assert bicycle.name == "benchmark-browser"


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ("parameterization: benchmark", "parameterization: principal", "line 1: parameterization `principal`, expected that of the benchmark"),
        ("  c: ", "  cc: ", "unknown parameter `cc`; the nearest valid name is `c`"),
        ("  c: ", "  c = ", "expected `name: value`"),
        ("values:\n", "values:\n  c: 0.1\n", "`c` was already given in line 6"),
        ("  w: 1.121", "  w: wide", "value of `w` is `wide`, expected a number"),
        ("  w: 1.121", "  w:", "got `w:`, expected `name: value`"),
    ],
)
def test_a_bad_line_in_yaml_is_refused_with_its_number(tmp_path, old, new, expected):
    assert SECTION.count(old) == 1
    assert expected in _refusal(_written(tmp_path, SECTION.replace(old, new), "set.yml"))
