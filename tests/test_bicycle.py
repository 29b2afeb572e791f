"""Bicycles: files of measured parameters and of raw measurements, stability speeds, and the whole job from
files to tables and rides.
"""

import json
import re
from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose
from oracles import whipple_bicycle as oracle
from oracles.hang_lines import mean_of_intersections
from refusals import refused

import jourdain_jax as jj
from jourdain_jax.bicycle import (
    PARAMETER_NAMES,
    PARAMETERS,
    Refused,
    benchmark_from_measurements,
    eigenvalues,
    interval,
    measured_bicycle,
    read_bicycle,
    read_readings,
    run,
    sample_parameters,
    shipped_bicycles,
    shipped_measurements,
    stability_speeds,
    study,
    table,
    write_results,
)
from jourdain_jax.cli import main
from jourdain_jax.cli.bicycle_verbs import prefixes

# Measured bicycle files: what ships is read or refused as intended, and every refusal says what to do.


SHIPPED = """
Balanceassistv1 Benchmark Browser Browserins Crescendo Fisher Pista Rigid Silver Tms Yellow Yellowrev
"""
GOOD = shipped_bicycles()["Browser"].read_text()


def shipped(name):
    return read_bicycle(shipped_bicycles()[name])


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
    assert sorted(shipped_bicycles()) == SHIPPED.split()


@pytest.mark.parametrize("name", [name for name in SHIPPED.split() if name != "Tms"])
def test_a_shipped_bicycle_is_read(name):
    bicycle = shipped(name)
    assert bicycle.name == name
    assert tuple(bicycle.values) == tuple(bicycle.sigmas) == PARAMETER_NAMES == tuple(PARAMETERS)
    assert all(np.isfinite(value) for value in bicycle.values.values())
    assert all(sigma >= 0 for sigma in bicycle.sigmas.values())


def test_values_sigmas_and_what_is_left_out_are_kept():
    browser = shipped("Browser")
    assert (browser.values["c"], browser.sigmas["c"]) == (0.0685808540382, 0.00169464113488)
    assert browser.without_sigma == ()
    assert shipped("Balanceassistv1").without_sigma == ("g",)
    assert {"mG", "IGxx", "xS", "ISxz"} < set(shipped("Rigid").ignored)
    assert shipped("Silver").ignored == ("IRzz", "yB", "yH", "IFzz")


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
        ("w = 1.121", "wheelbase = 1.121", ["line 22", "unknown", "valid names"]),
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
    [
        (b"", "empty"),
        (b"\x89PNG\r\n\xff\xfe", "not UTF-8"),
        (b"w = 1\0", "binary"),
        (b"#" * 1_000_001, "larger"),
    ],
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
    bicycle = shipped("Browser")
    samples = sample_parameters(bicycle, jax.random.key(0), 4000)
    values = np.array([bicycle.values[name] for name in PARAMETER_NAMES])
    sigmas = np.array([bicycle.sigmas[name] for name in PARAMETER_NAMES])
    standard = (samples.values - values) / sigmas
    assert np.abs(standard.mean(0)).max() < 5 / np.sqrt(4000)
    assert np.abs(standard.std(0) - 1).max() < 5 / np.sqrt(2 * 4000)
    assert np.abs(np.corrcoef(standard.T) - np.eye(len(values))).max() < 5 / np.sqrt(4000)
    assert samples.physical.all()
    assert samples.refused == {}


def test_a_parameter_without_sigma_does_not_vary():
    samples = sample_parameters(shipped("Benchmark"), jax.random.key(0), 5)
    assert np.ptp(samples.values, axis=0).max() == 0


def test_unphysical_samples_are_counted_and_named(tmp_path):
    text = GOOD.replace("IHzz = 0.0955686343473+/-0.000737521114809", "IHzz = 0.0955686343473+/-0.1")
    samples = sample_parameters(read_bicycle(_written(tmp_path, text)), jax.random.key(1), 2000)
    (sentence,) = samples.refused
    assert "`IHzz`" in sentence
    negative = int((samples.by_name()["IHzz"] < 0).sum())
    assert samples.refused[sentence] == negative == int((~samples.physical).sum()) > 100


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
    assert bicycle.values == shipped("Browser").values
    assert {name: float(getattr(bicycle.scene, name)) for name in bicycle.values} == bicycle.values
    assert {name: (prior.mean, prior.sigma) for name, prior in bicycle.prior.items()} == {
        name: (bicycle.values[name], sigma) for name, sigma in bicycle.sigmas.items() if sigma > 0
    }
    design = jj.Study(bicycle.scene, vary=bicycle.prior, sampler="sobol", samples=1024).design
    trail = design.values()["c"]
    assert_allclose([np.mean(trail), np.std(trail)], [bicycle.values["c"], bicycle.sigmas["c"]], rtol=0.01)
    refused(r"no measured bicycle `Browsr`.*Browser", measured_bicycle, "Browsr")


FLAT = "# a set of parameters\n---\n" + "".join(
    f"{name}: {value!r}\n" for name, value in shipped("Browser").values.items()
)
HEADED = "parameterization: benchmark\nrider: False\ndescription: |\n  A bicycle: with c: 3.\nvalues:\n"
SECTION = HEADED + "".join(f"  {line}  # measured\n" for line in FLAT.splitlines()[2:]) + "note: c\n"


@pytest.mark.parametrize("text", [FLAT + "v: 5.0\n", SECTION])
@pytest.mark.parametrize("ending", ["yml", "yaml"])
def test_a_set_in_yaml_is_read(tmp_path, text, ending):
    bicycle = read_bicycle(_written(tmp_path, text, f"benchmark-browser.{ending}"))
    assert bicycle.values == shipped("Browser").values
    assert bicycle.without_sigma == PARAMETER_NAMES
    assert bicycle.name == "benchmark-browser"


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        (
            "parameterization: benchmark",
            "parameterization: principal",
            "line 1: parameterization `principal`, expected the benchmark's",
        ),
        ("  c: ", "  cc: ", "unknown parameter `cc`; did you mean `c`"),
        ("  c: ", "  c = ", "expected `name: value`"),
        ("values:\n", "values:\n  c: 0.1\n", "`c` was already given in line 6"),
        ("  w: 1.121", "  w: wide", "value of `w` is `wide`, expected a number"),
        ("  w: 1.121", "  w:", "got `w:`, expected `name: value`"),
    ],
)
def test_a_bad_line_in_yaml_is_refused_with_its_number(tmp_path, old, new, expected):
    assert SECTION.count(old) == 1
    assert expected in _refusal(_written(tmp_path, SECTION.replace(old, new), "set.yml"))


# Parameters of bicycles from periods, hang angles and lengths: against the published ones, with their
# covariance.


# what follows from the places of mass centres; these are least squares here, published as means over pairs of
# lines
ABOUT_CENTRES = ("xB", "zB", "xH", "zH", "IByy", "IHyy")
DELFT = ["Browser", "Browserins", "Crescendo", "Fisher", "Pista", "Yellow", "Yellowrev"]


def off(name, of=None):
    """Values less published ones over published sigmas, and sigmas over published ones, by parameter."""
    found, published = benchmark_from_measurements(name), measured_bicycle(name)
    sigma = published.sigmas
    return {
        n: ((found.values[n] - published.values[n]) / sigma[n], found.sigmas[n] / sigma[n])
        for n in of or PARAMETER_NAMES
    }


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
    readings, found, published = (
        read_readings(shipped_measurements()[name]),
        benchmark_from_measurements(name),
        measured_bicycle(name),
    )
    for part, hung_by in (("B", (0.0, -found.values["rR"])), ("H", (found.values["w"], -found.values["rF"]))):
        angles, beside = (
            [readings.means[f"{what}{part}{k}"] for k in readings.hangings[part]] for what in ("alpha", "a")
        )
        x, z = mean_of_intersections(np.deg2rad(angles), np.array(beside), found.values["lam"])
        digits = 1e-3 if name == "Balanceassistv1" else 1e-9  # its file gives three of them
        assert_allclose(
            [hung_by[0] + x, hung_by[1] + z],
            [published.values[f"x{part}"], published.values[f"z{part}"]],
            atol=digits,
        )


def test_a_fork_measured_apart_from_its_handlebar_and_a_frame_on_a_table():
    """The sigma of the trail is smaller than the published one; here the trail keeps the correlation of the
    radius with the tilt.
    """
    of = off("Rigid")
    of_table = {
        n: of[n] for n in ("w", "lam", "rR", "IRxx", "IRyy", "IFxx", "IFyy", "IBxx", "IBzz", "IBxz", "mH")
    }
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
    for name, sigma in (
        ("lR", 0.001),
        ("alphaB2", 0.2),
        ("TtP1", 5.93377589066e-06),
        ("gamma", 0.2),
        ("dF", 0.01),
    ):
        (line,) = [line for line in text.splitlines() if line.split("=")[0].strip() == name]
        value = float(line.partition("=")[2].partition("+/-")[0])
        ends = [
            benchmark_from_measurements(
                write(tmp_path, text.replace(line, f"{name} = {value + by!r}"))
            ).values
            for by in (1e-4 * sigma, -1e-4 * sigma)
        ]
        slope = np.array([(ends[0][n] - ends[1][n]) / 2e-4 for n in PARAMETER_NAMES])
        # what this reading adds to the covariance: known exactly, it is gone
        less = benchmark_from_measurements(
            write(tmp_path, text.replace(line, f"{name} = {value!r}+/-0.0"))
        ).covariance
        assert_allclose(
            whole.covariance - less,
            np.outer(slope, slope),
            rtol=1e-5,
            atol=1e-9 * np.abs(whole.covariance).max(),
        )


def test_samples_have_the_covariance():
    found = benchmark_from_measurements("Browser")
    samples = np.asarray(sample_parameters(found, jax.random.key(0), 20000).values)
    sigma = np.array([found.sigmas[n] for n in PARAMETER_NAMES])
    assert_allclose(
        np.cov(samples.T) / np.outer(sigma, sigma), found.covariance / np.outer(sigma, sigma), atol=0.03
    )
    i, j = PARAMETER_NAMES.index("IRxx"), PARAMETER_NAMES.index("IFxx")
    assert found.covariance[i, j] / (sigma[i] * sigma[j]) > 0.99  # both are gauged by one rod


def test_a_study_takes_measurements_and_its_limits_are_narrower(tmp_path):
    measured, published = (
        study(of["Crescendo"], samples=400) for of in (shipped_measurements(), shipped_bicycles())
    )
    width = [
        one.speeds["weave_speed"]["high"] - one.speeds["weave_speed"]["low"] for one in (measured, published)
    ]
    assert 0.5 < width[0] / width[1] < 0.75  # 0.199 and 0.331 m/s with 2,000 samples
    assert isinstance(study(write(tmp_path, "g = 9.81"), samples=10), Refused)


def write(folder, text):
    path = folder / "OneMeasured.txt"
    path.write_text(text)
    return path


READINGS = shipped_measurements()["Browser"].read_text()


@pytest.mark.parametrize(
    ("text", "told"),
    [
        (
            READINGS.replace("TtH3", "TtH9"),
            "missing `alphaH3`, `aH3`, `TtH3`, which the parameters of a bicycle need",
        ),
        (READINGS.replace("dP =", "dQ ="), "missing `dP`"),
        (READINGS.replace("w = 1.121+/-0.002", "w"), "got `w`, expected `name = reading+/-sigma`"),
        (
            READINGS.replace("w = 1.121+/-0.002", "w = 1.1, long"),
            "reading of `w` is `long`, expected a number",
        ),
        (READINGS.replace("w = 1.121+/-0.002", "w = 1.1+/--0.1"), "sigma of `w` is -0.1"),
        (READINGS + "w = 1.2\n", "`w` was already given in line"),
        (
            READINGS.replace("TcB1 = 1.7", "TcB1 = 0.7"),
            "no bicycle has these readings: `IByy` (rear frame moment of inertia about y) must not",
        ),
    ],
)
def test_bad_files_are_refused_by_name(text, told, tmp_path):
    with pytest.raises(ValueError) as refusal:
        benchmark_from_measurements(write(tmp_path, text))
    assert told in str(refusal.value)
    assert "OneMeasured.txt" in str(refusal.value)


def test_an_unknown_bicycle_is_refused_with_the_nearest_one():
    refused(r"no measurements of a bicycle `Browsr`.*`Browser`", benchmark_from_measurements, "Browsr")


def test_several_readings_count_as_their_mean(tmp_path):
    path = write(tmp_path, READINGS.replace("w = 1.121+/-0.002", "w = 1.120+/-0.002, 1.122+/-0.002"))
    readings = read_readings(path)
    assert_allclose([readings.means["w"], readings.sigmas["w"]], [1.121, 0.002 / np.sqrt(2)])
    assert jnp.isfinite(benchmark_from_measurements(path).covariance).all()


# The real job: measured bicycles in, stability speeds with uncertainty and rides out.


@pytest.fixture(scope="module")
def studies():
    """A measured bicycle, one that has no capsize speed, and one that is refused."""
    shipped = shipped_bicycles()
    return run([shipped[name] for name in ("Rigid", "Yellowrev", "Tms")], samples=60)


def test_the_speeds_are_those_of_the_linear_formulas(studies):
    # from the published appendix formulas, evaluated on the same files
    rigid = studies[0].speeds
    assert_allclose(rigid["weave_speed"]["value"], 5.0083877167528, rtol=1e-9)
    assert_allclose(rigid["capsize_speed"]["value"], 6.4290536046576, rtol=1e-9)
    assert_allclose(studies[1].speeds["weave_speed"]["value"], 3.7592036310992, rtol=1e-9)


def test_a_file_that_is_missing_is_named(tmp_path, capsys):
    assert main(["bicycle", "missing.txt", "--out", str(tmp_path)]) == 1
    assert "refused: missing.txt: cannot be read" in capsys.readouterr().out


def test_a_degenerate_file_is_refused_by_name(tmp_path):
    (refused,) = run([shipped_bicycles()["Tms"]], samples=60)
    assert isinstance(refused, Refused)
    assert "rR" in refused.error
    write_results([refused], tmp_path / "result.json")
    (row,) = json.loads((tmp_path / "result.json").read_text())
    assert row["weave_speed"] is None
    assert "refused" in table([refused])


def test_the_command_writes_its_table_and_figures(tmp_path, capsys):
    command = ["bicycle", "Rigid", "Tms", "--samples", "60", "--out"]
    assert main([*command, str(tmp_path / "out")]) == 1  # one file was refused
    written = ["eigenvalues.png", "result.json", "ride.gif", "ride.png"]
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == written
    assert "5.0084" in capsys.readouterr().out


def test_figures_of_two_bicycles_with_one_name_have_two_names():
    assert prefixes(["Rigid"]) == [""]
    assert prefixes([]) == []
    assert prefixes(["Rigid", "my bike", "Rigid", "my_bike"]) == [
        "Rigid-",
        "my_bike-",
        "Rigid-2-",
        "my_bike-2-",
    ]


# Stability speeds of linear bicycles: published numbers, eigenvalues on either side, and derivatives.


BENCHMARK = (oracle.M, oracle.C1, oracle.K0, oracle.K2, 9.81)
RIDEABLE = [name for name in shipped_bicycles() if name != "Tms"]

speeds_of = jax.jit(stability_speeds)


def test_decompositions_of_a_batch_wait_for_each_other():
    """With jaxlib 0.10, two batched LAPACK calls that run at the same time can wait forever on two cores."""
    program = jax.jit(jax.vmap(stability_speeds)).lower(*(jnp.ones((9, 2, 2)),) * 4, jnp.ones(9))
    before, calls = {}, []
    for name, value in re.findall(r"^  (?:ROOT )?%?([\w.-]+) = (.*)", program.compile().as_text(), re.M):
        needs = re.findall(r"%([\w.-]+)", value)
        before[name] = set(needs).union(*(before.get(need, ()) for need in needs))
        calls += [name] if "lapack_" in value else []
    assert len(calls) == 5  # LU of M and two triangular solutions, roots, eigenvalues
    assert all(one in before[after] for one, after in pairwise(calls))


eigenvalues_of = jax.jit(eigenvalues)


def _parameters(name):
    return shipped(name).values


def _matrices(parameters):
    parts = oracle.matrices(parameters, jnp.cos, jnp.sin)
    return (*(jnp.array(parts[name]) for name in ("M", "C1", "K0", "K2")), jnp.asarray(parameters["g"]))


def _growth_rates(matrices, speed):
    """Ascending real parts of numpy's eigenvalues of the first-order system, and their imaginary parts."""
    values = np.linalg.eigvals(oracle.state_matrix(float(speed), *map(np.asarray, matrices)))
    return values[np.lexsort((values.imag, values.real))]


def test_the_appendix_formulas_give_the_published_matrices():
    for matrix, published in zip(_matrices(_parameters("Benchmark"))[:4], BENCHMARK[:4], strict=True):
        assert_allclose(matrix, published, rtol=1e-14, atol=1e-13)


@pytest.mark.parametrize("speed", oracle.EIGENVALUES)
def test_the_benchmark_eigenvalues_are_the_published_ones(speed):
    castering, capsize, *weave = oracle.EIGENVALUES[speed]
    (found,) = eigenvalues_of(*BENCHMARK, np.array([float(speed)]))
    assert_allclose(
        found,
        [castering, capsize, *sorted(weave, key=lambda root: (root.real, root.imag))],
        rtol=1e-12,
        atol=1e-12,
    )


def test_the_benchmark_speeds_are_the_published_ones():
    found = speeds_of(*BENCHMARK)
    close = {"rtol": 5e-14, "atol": 0}
    assert_allclose(found.weave_speed, oracle.WEAVE_SPEED, **close)
    assert_allclose(found.capsize_speed, oracle.CAPSIZE_SPEED, **close)
    assert_allclose(found.double_root_speed, oracle.DOUBLE_ROOT_SPEED, **close)
    assert_allclose(found.stable_from, found.weave_speed, **close)
    assert_allclose(found.stable_to, found.capsize_speed, **close)
    assert found.stable_range_exists


@pytest.mark.parametrize("name", RIDEABLE)
def test_the_eigenvalues_cross_where_the_speeds_say(name):
    matrices = _matrices(_parameters(name))
    found = speeds_of(*matrices)

    def growth(v, pair):
        values = _growth_rates(matrices, v)
        return values[(values.imag != 0) == pair][-1].real

    assert growth(found.weave_speed * (1 - 1e-6), True) > 0 > growth(found.weave_speed * (1 + 1e-6), True)
    assert abs(growth(found.weave_speed, True)) < 1e-11
    if np.isnan(found.capsize_speed):
        assert all(growth(v, False) < 0 for v in np.linspace(found.weave_speed, 50.0, 50))
        assert found.stable_to == 50.0
    else:
        assert (
            growth(found.capsize_speed * (1 - 1e-6), False)
            < 0
            < growth(found.capsize_speed * (1 + 1e-6), False)
        )

    below, above = (
        _growth_rates(matrices, found.double_root_speed * (1 + shift))[2:] for shift in (-1e-6, 1e-6)
    )
    assert (below.imag == 0).all()
    assert (above.imag != 0).all()
    assert_allclose(below.real.mean(), above.real.mean(), rtol=1e-2)

    assert found.stable_range_exists
    middle = 0.5 * (found.stable_from + found.stable_to)
    assert (_growth_rates(matrices, middle).real < 0).all()


@pytest.mark.parametrize("name", ["Pista", "Rigid"])
def test_modes_keep_their_names_along_the_speeds(name):
    found = np.asarray(eigenvalues_of(*_matrices(_parameters(name)), np.linspace(0.0, 10.0, 401)))
    assert np.abs(np.diff(found.real, axis=0)).max() < 0.6  # without names they would jump by several 1/s
    assert (found[-1].imag[:2] == 0).all()
    assert found[-1, 2] == np.conj(found[-1, 3])


def test_speeds_beyond_the_largest_are_not_reported():
    found = speeds_of(*BENCHMARK, max_speed=5.0)
    assert np.isnan(found.capsize_speed)
    assert_allclose([found.weave_speed, found.stable_to], [oracle.WEAVE_SPEED, 5.0], rtol=1e-13)


def test_speeds_scale_with_the_square_root_of_gravity_and_with_nothing_else():
    M, C1, K0, K2, g = BENCHMARK
    here, there = speeds_of(*BENCHMARK), speeds_of(*(7.0 * A for A in (M, C1, K0, K2)), 4.0 * g)
    for name in ("weave_speed", "capsize_speed", "double_root_speed", "stable_from", "stable_to"):
        assert_allclose(getattr(there, name), 2.0 * getattr(here, name), rtol=1e-13)


def test_derivatives_of_the_speeds_are_those_of_the_formulas():
    """Those by gravity, too: all speeds grow with its square root."""

    def speeds(parameters):
        found = stability_speeds(*_matrices(parameters))
        both = jnp.stack([found.weave_speed, found.capsize_speed, found.double_root_speed])
        return both, both

    parameters = _parameters("Benchmark")
    for derivative in (jax.jacfwd, jax.jacrev):
        slopes, found = jax.jit(derivative(speeds, has_aux=True))(parameters)
        for name, (*_, weave, capsize) in oracle.AT_5.items():
            assert_allclose(slopes[name][:2], [weave, capsize], rtol=1e-10, atol=1e-10)
        assert_allclose(slopes["g"], found / (2 * 9.81), rtol=1e-12)
