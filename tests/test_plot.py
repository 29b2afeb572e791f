"""Figures of quantities against time show the values of the motion, in the requested unit."""

import jax.numpy as jnp
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
    return jj.rollout(SLEIGH, {"heading_rate": np.linspace(0.5, 2.0, 21)}, ts=TS)


@pytest.fixture(autouse=True)
def _closed():
    yield
    plt.close("all")


def overlap(figure, *artists):
    """Whether any two of these are drawn over one another."""
    figure.draw_without_rendering()
    boxes = [artist.get_window_extent() for artist in artists]
    return any(a.overlaps(b) for k, a in enumerate(boxes) for b in boxes[k + 1 :])


def texts(legend):
    return [text.get_text() for text in legend.get_texts()]


UNITS = {"heading": ("deg", 180 / np.pi), "heading_rate": ("rpm", 30 / np.pi), "x": ("cm", 100.0)}
UNITS |= {"x_rate": ("km/h", 3.6), "energy": ("mJ", 1000.0)}


def test_values_are_drawn_in_the_units_that_are_asked_for(motions):
    units = {name: unit for name, (unit, _) in UNITS.items()}
    figure, axes = jj.plot(motions[0], *units, units=units | {"t": "ms"})
    energies = motions[0].energies()
    for axis, (name, (unit, size)) in zip(axes, UNITS.items(), strict=True):
        expected = energies.kinetic + energies.potential if name == "energy" else motions[0][name]
        (line,) = axis.lines
        assert_allclose(line.get_xdata(), 1000 * TS, rtol=1e-12, atol=1e-12)
        assert_allclose(line.get_ydata(), size * expected, rtol=1e-12, atol=1e-12)
        symbol = {"x": "$x$", "x_rate": r"$\dot{x}$"}.get(name, name)
        assert axis.get_ylabel() == f"{symbol} in {unit}"
        assert axis.figure is figure
    assert axes[-1].get_xlabel() == "$t$ in ms"


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
    assert texts(legend) == ["slow", "fast"]
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
    assert texts(figure.legends[0]) == ["90 % of samples", "50 % of samples", "median"]
    assert axes[0].get_title(loc="left") == "21 samples; 0 stopped at an event, 0 failed"
    assert not overlap(figure, figure.legends[0], axes[0].title, *axes)


def test_labels_have_the_units_that_bodies_show_and_panels_have_letters():
    axle = jj.simulate(jj.models.model("two-wheel-axle-coordinates"), t1=0.1, ts=TS[:2] / 10)
    _, axes = jj.plot(axle, "x1", "psi1_rate", "phi", "energy")
    labels = [axis.get_ylabel() for axis in axes]
    assert labels == [r"$x_{1}$ in m", r"$\dot{\psi}_{1}$ in rad/s", r"$\phi$ in rad", "energy in J"]
    assert [axis.get_title(loc="right") for axis in axes] == ["(a)", "(b)", "(c)", "(d)"]
    wire = jj.simulate(BeadOnTurningWire(), {"r": 0.3}, t1=0.1)
    assert jj.plot(wire, "r")[1][0].get_ylabel() == "$r$ in m"
    assert not jj.plot(wire, "r")[1][0].get_title(loc="right")


class Bob(jj.Scene):
    """A bob on a rod of 1 m, and a body that one speed turns and moves by 1 m: their units stay open."""

    coordinates = jj.coordinates("a", "b")

    def bodies(self, t, q):
        return {
            "bob": jj.Particle(1.0, jj.vec(jnp.sin(q.a), 0, -jnp.cos(q.a))),
            "wheel": jj.RigidBody(1.0, jnp.eye(3), jj.vec(q.b, 3, 0), jj.rot_y(q.b)),
        }


def test_units_that_bodies_do_not_show_stay_open():
    _, axes = jj.plot(jj.simulate(Bob(), {"a": 0.1}, t1=0.1), "a", "b")
    assert [axis.get_ylabel() for axis in axes] == ["$a$", "$b$"]


@pytest.mark.parametrize(("style", "width"), [("column", 3.4), ("two_columns", 7.0)])
def test_a_style_sets_width_and_fonts(motions, style, width):
    with plt.style.context(f"jourdain_jax.views.{style}"):
        figure, axes = jj.plot(motions, "heading", "x_rate")
        figure.draw_without_rendering()
    assert figure.get_size_inches()[0] == width
    assert axes[0].yaxis.label.get_size() < 10
    assert not overlap(figure, *(axis.yaxis.label for axis in axes))
