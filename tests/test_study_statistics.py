"""Statistics of studies: right, and the same bits whatever the order of blocks. Sobol' indices against closed
forms.
"""

import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from refusals import refused
from scipy import special

import jourdain_jax as jj
from jourdain_jax.studies import Design, End, EventTime, Uniform, sobol_indices

# Sobol' indices. --------------------------------------------------------------------------------------------


def _ishigami(samples):
    """f = sin x1 + 7 sin^2 x2 + 0.1 x3^4 sin x1 on (-pi, pi)^3 (Ishigami and Homma 1990), its indices in
    closed form.
    """
    a, b, pi = 7.0, 0.1, np.pi
    design = Design(
        dict.fromkeys(("x1", "x2", "x3"), Uniform(-pi, pi)), sampler="saltelli", samples=samples, seed=1
    )
    x = design.values()
    values = np.sin(x["x1"]) + a * np.sin(x["x2"]) ** 2 + b * x["x3"] ** 4 * np.sin(x["x1"])
    one, two, three = 0.5 * (1 + b * pi**4 / 5) ** 2, a**2 / 8, b**2 * pi**8 * (1 / 18 - 1 / 50)
    variance = one + two + three
    return (
        design,
        values,
        np.array([one, two, 0.0]) / variance,
        np.array([one + three, two, three]) / variance,
    )


def test_the_indices_of_ishigamis_function_lie_within_their_limits():
    design, values, first, total = _ishigami(5 * 2**13)
    found = sobol_indices(values, design.names)
    assert np.all(np.abs(found.first - first) <= found.first_half_width)
    assert np.all(np.abs(found.total - total) <= found.total_half_width)
    assert np.all(found.first_half_width < 0.04)
    assert "0.4" in str(found)


def test_groups_without_a_value_are_left_out_and_counted():
    design, values, _, _ = _ishigami(5 * 2**10)
    values[12] = np.nan
    found = sobol_indices(values, design.names)
    assert (found.groups, found.left_out) == (2**10 - 1, 1)
    assert "1 groups" in str(found)
    refused("a multiple of 5", sobol_indices, values[:-1], design.names)
    for still in (np.ones(20), np.tile([1.0, 2.0, 3.0, 4.0, 1.0], 4)):
        refused("that varies", sobol_indices, still, design.names)


class Pendulum(jj.Scene):
    """A pendulum that is let go at an angle and stops where it hangs down."""

    length: object = jj.parameter(1.0, unit="m", positive=True)
    gravity: object = jj.parameter(9.81, unit="m/s^2")
    coordinates = jj.coordinates("angle")
    example = {"angle": 1.0}

    def bodies(self, t, q):
        return {"bob": jj.Particle(1.0, self.length * jnp.stack([jnp.sin(q.angle), 0.0, -jnp.cos(q.angle)]))}

    def loads(self, motion):
        return jj.gravity(motion, self.gravity)

    def events(self, motion):
        return {"down": motion.q.angle}


def test_a_study_has_the_indices_of_its_outputs(tmp_path):
    """T / 4 = sqrt(L / g) K(sin(angle / 2)), with the complete elliptic integral K."""
    ranges = {"length": (0.5, 1.5), "gravity": (9.0, 10.5), "angle_at_start": (0.2, 2.8)}
    length, gravity, angle = (Uniform(*limits) for limits in ranges.values())
    vary, sampled = {"length": length, "gravity": gravity}, {"samples": 5 * 2**6, "seed": 4}
    study = jj.Study(Pendulum(), vary=vary, start={"angle": angle}, sampler="saltelli", **sampled)
    outputs = {"quarter": EventTime("down")}
    result = study.run(tmp_path / "d.zarr", t1=3.0, rtol=1e-8, outputs=outputs, progress=False)
    assert result.counts == {"event": len(result)}

    def quarter(length, gravity, angle):
        return np.sqrt(length / gravity) * special.ellipk(np.sin(angle / 2) ** 2)

    at = study.design.values()
    found = result.to_xarray()["quarter"].values
    assert_allclose(found, quarter(*at.values()), rtol=1e-7)
    indices, expected = result.sensitivity("quarter"), sobol_indices(found, study.design.names)
    assert_array_equal(np.stack([indices.first, indices.total]), np.stack([expected.first, expected.total]))
    assert "length" in str(indices)
    refused("no output `period`", result.sensitivity, "period")


def test_what_lies_beyond_the_grid_is_printed_and_drawn_as_that(tmp_path):
    """The grid spans twice the range of the first block; the middle between its edge and the extreme says
    nothing.
    """
    angles = np.r_[np.linspace(0.0, 1.0, 2048), np.linspace(2.0, 12.0, 2000)]
    study = jj.Study(jj.models.TiltingDisc(), start={"yaw": angles, "lean": 0.1})
    found = study.run(tmp_path / "discs.zarr", t1=1e-6, outputs={"yaw": End("yaw", "rad")}, progress=False)
    assert found.quantile("yaw", 0.975) == (pytest.approx(1.5), pytest.approx(12.0))
    median, *beyond = str(found).split()[-3:]
    assert float(median) == pytest.approx(0.9884, abs=1e-3)
    assert beyond == [">", "1.5"]
    (axis,) = found.plot().axes
    assert [text.get_text() for text in axis.get_legend().get_texts()] == ["anywhere in here"]
    counts, edges, _ = axis.patches[1].get_data()
    assert (counts[-1], edges[-1]) == (2000, pytest.approx(12.0))
