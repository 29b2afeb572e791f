"""Studies: every lane is the motion that `simulate` gives, and its bits do not depend on chunks, shares or
what else is kept.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import result_codes as results
import xarray
from numpy.testing import assert_allclose, assert_array_equal
from refusals import refused

import jourdain_jax as jj
from jourdain_jax.studies import End, EventTime, Happened, LargestMagnitude, Quantity

COUNT, BAD = 150, 37  # lanes; one whose radius is negative
OUTPUTS = {
    "final lean": End("lean", "rad"),
    "largest lean": LargestMagnitude("lean", "rad"),
    "fell": Happened("fallen"),
    "fall time": EventTime("fallen"),
    "distance": Quantity(lambda motion: jnp.hypot(motion.q_end[0], motion.q_end[1]), "m"),
}
ASKED = {"t1": 1.0, "ts": np.linspace(0.0, 1.0, 11), "rtol": 1e-6, "atol": 1e-6, "progress": False}
pytestmark = pytest.mark.usefixtures("small_blocks")


def discs():
    """A table of discs with random starts, one of which is none."""
    generator = np.random.default_rng(2)
    radius = generator.uniform(0.4, 0.6, COUNT)
    radius[BAD] = -0.5
    start = {
        "lean": generator.uniform(-0.6, 0.6, COUNT),
        "lean_rate": generator.normal(0.0, 0.5, COUNT),
        "spin_rate": -0.5,
    }
    return jj.Study(jj.models.TiltingDisc(), vary={"radius": radius}, start=start)


@pytest.fixture(scope="module")
def whole(tmp_path_factory, small_blocks):
    return discs().run(tmp_path_factory.mktemp("whole") / "discs.zarr", outputs=OUTPUTS, **ASKED)


def assert_same(found, expected):
    """All arrays and statistics have the same bits."""
    assert found.complete
    one, other = found.to_xarray().load(), expected.to_xarray().load()
    assert set(one.variables) == set(other.variables)
    for name in one.variables:
        assert_array_equal(one[name].values, other[name].values, err_msg=name)
    assert_same_statistics(found, expected)


def assert_same_statistics(found, expected):
    for name in ("mean", "covariance", "counts", "extremes", "lanes"):
        assert_array_equal(getattr(found.statistics, name), getattr(expected.statistics, name), err_msg=name)
    assert found.counts == expected.counts
    assert_array_equal(found.failed, expected.failed)


def test_every_lane_is_the_motion_that_simulate_gives(whole):
    arrays = whole.to_xarray()
    assert arrays.sizes["lane"] == COUNT
    fell = np.flatnonzero(arrays["fell"].values == 1.0)
    assert 3 < fell.size < COUNT
    outputs = jax.jit(lambda motion: {name: output.of(motion) for name, output in OUTPUTS.items()})
    for number in (0, 31, 32, COUNT - 1, int(fell[0])):
        lane = whole.lane(number)
        motion = lane.simulate()
        assert arrays["result"][number] == int(motion.result)
        assert arrays["steps"][number] == int(motion.accepted)
        for name, expected in outputs(motion).items():
            assert arrays[name][number] == pytest.approx(float(expected), rel=1e-9, abs=1e-9, nan_ok=True), (
                name
            )
        assert motion.scene.radius == lane.parameters["radius"] == float(arrays["radius"][number])
    assert "stopped at an event" in str(whole.lane(int(fell[0])))


def test_a_sample_shows_outputs_with_the_name_of_a_start_and_an_output_without_values_has_no_statistics(
    tmp_path,
):
    outputs = {"lean": End("lean"), "never": EventTime("fallen")}
    found = jj.Study(jj.models.TiltingDisc(), start={"lean": [0.1, 0.2]}).run(
        tmp_path / "d.zarr", t1=0.1, outputs=outputs, progress=False
    )
    assert np.isnan([found.mean("never"), *found.quantile("never", 0.5)]).all()
    assert f"  lean = {float(found.to_xarray()['lean'][1]):.6g}" in str(found.lane(1)).splitlines()


@pytest.mark.parametrize("level", [0.0, 0.025, 0.5, 0.975, 0.9999, 1.0])
def test_a_quantile_lies_within_its_stated_limits(whole, level):
    for name in ("final lean", "fall time", "distance"):
        own = np.sort(whole.to_xarray()[name].values)
        own = own[np.isfinite(own)]
        low, high = whole.quantile(name, level)
        assert low <= own[max(1, int(np.ceil(level * own.size))) - 1] <= high


def test_a_failed_lane_is_named_and_left_out_of_statistics(whole):
    assert whole.failed.tolist() == [BAD]
    assert whole.counts["bad_parameter"] == 1
    arrays = whole.to_xarray()
    assert arrays["result"][BAD] == results.BAD_PARAMETER
    assert all(np.isnan(arrays[name][BAD]) for name in OUTPUTS)
    own = np.delete(arrays["distance"].values, BAD)
    assert_allclose(whole.mean("distance"), own.mean(), rtol=1e-13)
    assert_allclose(whole.deviation("distance"), own.std(ddof=1), rtol=1e-12)
    assert whole.statistics.lanes[0, 0] == COUNT - 1
    values = [np.delete(arrays[name].values, BAD) for name in ("final lean", "distance")]
    assert_allclose(whole.statistics.covariance[0, 4], np.cov(*values)[0, 1], rtol=1e-9)
    assert f"failed: samples {BAD}" in str(whole)
    refused("radius", lambda: whole.lane(BAD).simulate())


def test_the_folder_opens_in_xarray_with_names_units_and_what_was_asked(whole):
    arrays = xarray.open_zarr(whole.store.path)
    assert arrays["final lean"].attrs["units"] == "rad"
    assert arrays["radius"].attrs["units"] == "m"
    assert set(arrays.coords) == {"radius", "lean_at_start", "lean_rate_at_start"}
    assert arrays.attrs["scene"].endswith("TiltingDisc")
    assert arrays.attrs["parameters"]["mass"] == {"value": 1.0, "unit": "kg"}
    assert arrays.attrs["start"] == {"spin_rate": -0.5}
    assert arrays.attrs["versions"]["jax"]
    meanings = arrays["result"].attrs["flag_meanings"].split()
    assert meanings[int(arrays["result"][BAD])] == "bad_parameter"
    assert [getattr(results, name.upper()) for name in meanings] == list(range(len(meanings)))


def test_netcdf_holds_the_same(whole, tmp_path):
    whole.to_netcdf(tmp_path / "discs.nc")
    with xarray.open_dataset(tmp_path / "discs.nc") as arrays:
        for name in whole.to_xarray().variables:
            assert_array_equal(arrays[name].values, whole.to_xarray()[name].values)
        assert arrays["final lean"].attrs["units"] == "rad"


def test_statistics_need_no_lanes(whole, tmp_path):
    found = discs().run(tmp_path / "discs.zarr", outputs=OUTPUTS, save="statistics", chunk=96, **ASKED)
    assert_same_statistics(found, whole)
    assert not found.to_xarray().variables
    assert sum(file.stat().st_size for file in found.store.path.rglob("*") if file.is_file()) < 50_000
    assert found.lane(3).kept == {}


def test_statistics_of_all_lanes_and_every_twelfth_whole(whole, tmp_path):
    found = discs().run(tmp_path / "discs.zarr", outputs=OUTPUTS, save="statistics", keep_every=12, **ASKED)
    assert_same_statistics(found, whole)
    arrays = found.to_xarray()
    for name in ("result", "final lean", *found.varied):
        assert_array_equal(arrays[name].values, whole.to_xarray()[name].values[::12])
    assert arrays["lean"].dims == ("saved_lane", "time")
    assert_array_equal(arrays["saved_lane"].values, np.arange(0, COUNT, 12))
    assert_array_equal(arrays["time"].values, ASKED["ts"])
    for place in (0, 12):
        assert_allclose(
            arrays["lean"][place].values, found.lane(12 * place).simulate()["lean"], rtol=1e-9, atol=1e-9
        )


def test_a_study_is_opened_without_its_scene(whole):
    found = jj.load_study(whole.store.path)
    assert str(found) == str(whole)
    refused(r"study\.run", found.lane, 0)
    with pytest.raises(IndexError, match="sample 150 does not exist"):
        whole.lane(COUNT)


def test_a_study_shows_its_table_and_a_histogram_of_each_output_in_a_notebook(whole, drawn):
    shown = whole._repr_html_()
    assert shown.startswith(f"<pre>Study in {whole.store.path}: {COUNT} of {COUNT} samples")
    axes = {axes.get_xlabel(): axes for axes in drawn[0].axes}
    assert len(axes) == len(OUTPUTS)
    assert axes["final lean (rad)"].lines[0].get_xdata() == [whole.mean("final lean")] * 2
    counts, edges = whole.histogram("distance", cells=40)
    bars = axes["distance (m)"].patches[0].get_data()
    assert_array_equal(bars.values, counts)
    assert_array_equal(bars.edges, edges)


def test_an_output_that_is_no_number_or_unknown_is_named(whole, tmp_path):
    refused(
        "expected one real number for a motion",
        lambda: discs().run(tmp_path / "discs.zarr", outputs={"all": lambda motion: motion.q_end}, **ASKED),
    )
    refused("no output `lean`", whole.mean, "lean")
    refused("`cells` is 0", whole.histogram, "final lean", 0)
