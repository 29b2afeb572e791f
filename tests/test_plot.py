"""Figures of quantities against time show the values of the motion, in the requested unit."""

import matplotlib.pyplot as plt
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from small_scenes import BeadOnTurningWire

import jourdain_jax as jj

SLEIGH = jj.models.ChaplyginSleigh()
TS = np.linspace(0.0, 1.0, 6)


@pytest.fixture(scope="module")
def motions():
    return [jj.simulate(SLEIGH, {"x_rate": -0.6, "heading_rate": turning}, ts=TS) for turning in (0.5, 1.0)]


@pytest.fixture(scope="module")
def lanes():
    return jj.rollout(SLEIGH, {"heading_rate": np.linspace(0.5, 2.0, 21)}, ts=TS, progress=False)


@pytest.fixture(autouse=True)
def _closed():
    yield
    plt.close("all")


def overlap(figure, *artists):
    """Whether any two of these are drawn over one another."""
    figure.draw_without_rendering()
    boxes = [artist.get_window_extent() for artist in artists]
    return any(a.overlaps(b) for k, a in enumerate(boxes) for b in boxes[k + 1 :])


@pytest.mark.parametrize(
    ("name", "unit", "size"),
    [
        ("heading", "deg", 180 / np.pi),
        ("heading_rate", "rpm", 30 / np.pi),
        ("x", "cm", 100.0),
        ("x_rate", "km/h", 3.6),
        ("energy", "mJ", 1000.0),
    ],
)
def test_values_are_drawn_in_the_units_that_are_asked_for(motions, name, unit, size):
    figure, axes = jj.plot(motions[0], name, units={name: unit, "t": "ms"})
    energies = motions[0].energies()
    expected = energies.kinetic + energies.potential if name == "energy" else motions[0][name]
    (line,) = axes[0].lines
    assert_allclose(line.get_xydata(), np.stack([1000 * TS, size * expected], axis=1), rtol=1e-12, atol=1e-12)
    assert axes[0].get_ylabel() == f"{name} in {unit}"
    assert axes[0].get_xlabel() == "t in ms"
    assert figure is axes[0].figure


def test_the_energy_of_a_damped_motion_is_what_it_has_left():
    """The sum of the two others, and not the balance, which the work of the damper keeps constant."""
    motion = jj.simulate(BeadOnTurningWire(rate=0.0, damping=2.0), {"r": 1.0, "r_rate": 1.0}, ts=TS)
    assert motion.work is not None
    _, axes = jj.plot(motion, "energy", "kinetic energy")
    total, kinetic = (axis.lines[0].get_ydata() for axis in axes)
    assert_array_equal(total, kinetic)
    assert total[-1] < 0.2 * total[0]


def test_several_motions_lie_in_one_figure_with_their_labels(motions):
    figure, axes = jj.plot(motions, "x", "heading", labels=["slow", "fast"], title="Two sleighs")
    assert len(axes) == 2
    for axis, name in zip(axes, ("x", "heading"), strict=True):
        assert [line.get_label() for line in axis.lines] == ["slow", "fast"]
        assert len({line.get_color() for line in axis.lines}) == 2
        for line, motion in zip(axis.lines, motions, strict=True):
            assert_array_equal(line.get_ydata(), motion[name])
    (legend,) = figure.legends
    assert [text.get_text() for text in legend.get_texts()] == ["slow", "fast"]
    assert not overlap(figure, legend, axes[0].title, *axes)


def test_of_a_rollout_bands_hold_the_parts_that_are_asked_for(lanes):
    figure, axes = jj.plot(lanes, "heading", units={"heading": "deg"}, bands=(0.9, 0.5))
    (line,) = axes[0].lines
    assert_allclose(line.get_ydata(), np.rad2deg(np.median(lanes["heading"], axis=0)), atol=1e-12)
    wide, narrow = (band.get_paths()[0].vertices for band in axes[0].collections)
    for band, part in ((wide, 0.9), (narrow, 0.5)):
        at_end = band[np.isclose(band[:, 0], 1.0), 1]
        expected = np.rad2deg(np.quantile(lanes["heading"][:, -1], [(1 - part) / 2, (1 + part) / 2]))
        assert_allclose([at_end.min(), at_end.max()], expected, atol=1e-9)
    assert [text.get_text() for text in figure.legends[0].get_texts()] == [
        "90 % of samples",
        "50 % of samples",
        "median",
    ]
    assert axes[0].get_title(loc="left") == "21 samples; 0 stopped at an event, 0 failed"
    assert not overlap(figure, figure.legends[0], axes[0].title, *axes)


def test_rollouts_and_motions_share_a_figure_and_the_axes_of_a_user(lanes, motions, tmp_path):
    own, panels = plt.subplots(1, 2)
    figure, axes = jj.plot([lanes, motions[0]], "x", "y", labels=["many", "one"], bands=(), axes=panels)
    assert figure is own
    assert list(axes) == list(panels)
    assert [line.get_label() for line in panels[0].lines] == ["many, median", "one"]
    assert [text.get_text() for text in panels[0].get_legend().get_texts()] == ["many, median", "one"]
    with plt.rc_context({"svg.fonttype": "none"}):  # text as text
        jj.plot(motions, "x", path=tmp_path / "two.svg")
    written = (tmp_path / "two.svg").read_text()
    assert "motion 0" in written
    assert "motion 1" in written
