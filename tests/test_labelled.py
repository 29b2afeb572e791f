"""Motions as labelled arrays and tables, and how scenes and motions show themselves in notebooks."""

import sys

import jax
import numpy as np
import pytest
from numpy.testing import assert_array_equal
from refusals import refused
from small_scenes import OnLine

import jourdain_jax as jj

TIMES = np.linspace(0.0, 0.4, 5)


@pytest.fixture(scope="module")
def motion():
    disc = jj.models.TiltingDiscQuaternion()
    return jj.simulate(disc, jj.start(disc, **disc.example), ts=TIMES)


@pytest.fixture(scope="module")
def lanes():
    starts = {"x_rate": np.linspace(0.5, 2.0, 3), "heading_rate": 0.7}
    masses = {"mass": np.array([1.0, 2.0, 3.0])}
    return jj.rollout(jj.models.Skate(), starts, parameters=masses, ts=TIMES)


def test_a_motion_becomes_a_dataset_with_names_times_and_units(motion):
    data = motion.to_xarray(units={"x": "m"})
    assert_array_equal(data.time, motion.ts)
    for name in (*motion.scene.coordinate_names.entries, *motion.scene.speed_names.entries):
        assert data[name].dims == ("time",)
        assert_array_equal(data[name], motion[name])
    quaternion = [name for name in motion.scene.coordinate_names.entries if name.startswith("attitude")]
    assert {data[name].attrs["units"] for name in quaternion} == {"1"}
    assert (data.time.attrs["units"], data.x.attrs["units"], data.mass.attrs["units"]) == ("s", "m", "kg")
    assert "units" not in data.y.attrs  # nobody said it
    assert float(data.mass) == 1.0
    assert (int(data.result), data.result.attrs["flag_meanings"].split()[int(data.result)]) == (0, "success")
    assert data.attrs["scene"] == "TiltingDiscQuaternion"


def test_a_rollout_has_an_axis_of_lanes_with_their_codes_and_parameters(lanes):
    data = lanes.to_xarray()
    assert data.x.dims == ("lane", "time")
    assert_array_equal(data.x, lanes["x"])
    assert_array_equal(data.result, lanes.result)
    assert_array_equal(data.mass, [1.0, 2.0, 3.0])
    assert_array_equal(data.steps, lanes.lanes.accepted)
    one = data.sel(lane=1).sel(time=0.2, method="nearest")
    assert float(one.x_rate) == float(lanes.lane(1)["x_rate"][2])


def test_tables_have_one_row_for_each_time_of_each_lane(motion, lanes):
    table = motion.to_pandas()
    assert_array_equal(table.index, motion.ts)
    assert_array_equal(table["x"], motion["x"])
    many = lanes.to_pandas()
    assert many.index.names == ["lane", "time"]
    assert_array_equal(many.loc[2]["y"], lanes.lane(2)["y"])


class _Named(OnLine):
    steps: float = jj.parameter(1.0, unit="m")


class _Timed(jj.Scene):
    coordinates = jj.coordinates("time")

    def bodies(self, t, q):
        return {"ball": jj.Particle(1.0, [q.time, 0.0, 0.0])}


@pytest.mark.parametrize(("scene", "name"), [(_Timed(), "time"), (_Named(), "steps")])
def test_a_name_of_two_arrays_is_refused(scene, name):
    """The coordinate would take the place of the axis, the parameter would be left out."""
    refused(f"`{name}` would name two arrays of the dataset", jj.simulate(scene, {}, ts=TIMES).to_xarray)


@pytest.mark.parametrize(("package", "ask"), [("xarray", "to_xarray"), ("pandas", "to_pandas")])
def test_a_missing_package_is_named_with_what_installs_it(motion, monkeypatch, package, ask):
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(ImportError, match=f"needs the package `{package}`, .* pip install {package}"):
        getattr(motion, ask)()


def test_wrong_names_and_traced_motions_are_refused(motion):
    refused(
        "`units` names `xx`, which is not a coordinate or speed of `TiltingDiscQuaternion`",
        motion.to_xarray,
        units={"xx": "m"},
    )
    with pytest.raises(TypeError, match="`to_xarray` was called inside jit"):
        jax.jit(lambda m: m.to_xarray() or 0)(motion)


def test_a_scene_shows_its_parameters_with_units_in_a_notebook(lanes):
    shown = jj.models.TiltingDisc(mass=2.5)._repr_html_()
    for part in (
        "<b>TiltingDisc</b> A thin disc",
        ">mass</th>",
        ">2.5</td>",
        ">kg</td>",
        "coordinates: x, y, yaw, lean, spin",
        "speeds: x_rate",
    ):
        assert part in shown
    assert "&lt;" in type("Odd", (jj.models.TiltingDisc,), {"__doc__": "a <b"})()._repr_html_()


def test_a_scene_is_drawn_at_its_example_start_in_a_notebook(drawn):
    assert "<img" in jj.models.TiltingDisc()._repr_html_()
    (axes,) = drawn[0].axes
    _, solid = axes.collections
    colours = np.unique(solid.get_facecolor().round(3), axis=0)
    assert np.sum(colours[:, 2] > 1.5 * colours[:, 0]) >= 2  # the disc is blue, painted and lit
    assert axes.get_zlim()[0] == 0.0  # it stands on the floor
    # where nothing can be drawn, the table alone is shown
    broken = type("Broken", (jj.models.TiltingDisc,), {"bodies": lambda self, t, q: 1 / 0})()._repr_html_()
    assert "<img" not in broken
    assert ">mass</th>" in broken


def test_a_rollout_shows_medians_and_bands_of_its_coordinates_in_a_notebook(lanes, drawn):
    shown = lanes._repr_html_()
    names = lanes.lanes.scene.coordinate_names.entries
    assert shown.startswith("<pre>Rollout of Skate: 3 lanes")
    assert len(drawn[0].axes) == len(names)
    assert [(len(axes.lines), len(axes.collections)) for axes in drawn[0].axes] == [(1, 2)] * len(names)
    low, high = (float(x) for x in (lanes.quantiles("x", [0.025]).min(), lanes.quantiles("x", [0.975]).max()))
    assert f"x: {low:.3g} to {high:.3g}" in [axes.get_title() for axes in drawn[0].axes]
