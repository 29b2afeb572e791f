"""Statistics of studies: right, and the same bits whatever the order of blocks. Sobol' indices against closed forms."""

import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy import special

import jourdain_jax as jj
from jourdain_jax.ensembles.statistics import Grid, combined, counts_of_block, extremes_of_block, sums_of_block

BLOCK = 256


def _blocks():
    generator = np.random.default_rng(5)
    values = generator.normal(size=(10 * BLOCK - 7, 3)) * [1.0, 1e-3, 50.0] + [0.0, 1e3, 1.0]
    values[:, 2] += 20 * values[:, 0]
    values[generator.uniform(size=len(values)) < 0.2, 1] = np.nan
    values[3 * BLOCK, 0] = 1e6  # far beyond the grid
    return values, [values[i : i + BLOCK] for i in range(0, len(values), BLOCK)]


def _statistics(order):
    _, blocks = _blocks()
    grid = Grid.of(blocks[0])
    chosen = [blocks[i] for i in order]
    counts = sum(counts_of_block(grid, block) for block in chosen)
    extremes = np.stack([extremes_of_block(block) for block in chosen])
    extremes = np.stack([extremes[:, 0].min(axis=0), extremes[:, 1].max(axis=0)])
    return combined("abc", grid, [sums_of_block(grid, block) for block in chosen], counts, extremes)


def test_means_and_covariances_are_those_of_all_values():
    values, _ = _blocks()
    found = _statistics(range(10))
    for i in range(3):
        own = values[np.isfinite(values[:, i]), i]
        assert found.lanes[i, i] == own.size
        assert found.mean[i] == pytest.approx(own.mean(), rel=1e-13)
        assert found.deviation[i] == pytest.approx(own.std(ddof=1), rel=1e-12)
        for j in range(3):
            both = values[np.isfinite(values[:, [i, j]]).all(axis=1)]
            assert found.covariance[i, j] == pytest.approx(np.cov(both[:, i], both[:, j])[0, 1], rel=1e-9)


def test_the_order_of_blocks_does_not_change_a_bit():
    one, other = _statistics(range(10)), _statistics([3, 9, 0, 1, 8, 2, 7, 4, 6, 5])
    for name in ("mean", "covariance", "counts", "extremes", "lanes"):
        assert_array_equal(getattr(one, name), getattr(other, name))


@pytest.mark.parametrize("level", [0.0, 0.025, 0.5, 0.975, 0.9999, 1.0])
def test_a_quantile_lies_within_its_stated_limits(level):
    values, _ = _blocks()
    found = _statistics(range(10))
    for i, name in enumerate("abc"):
        own = np.sort(values[np.isfinite(values[:, i]), i])
        low, high = found.quantile(name, level)
        assert low <= own[max(1, int(np.ceil(level * own.size))) - 1] <= high
    assert found.quantile("b", level)[1] - found.quantile("b", level)[0] < 1e-5  # a cell: of the range of 6e-3


def test_a_histogram_holds_every_value():
    values, _ = _blocks()
    counts, edges = _statistics(range(10)).histogram("a")
    assert counts.sum() == len(values)
    assert edges[-1] == 1e6
    expected, _ = np.histogram(values[:, 0], edges)
    assert_array_equal(counts, expected)


def test_what_never_has_a_value_has_no_statistics():
    nothing = np.full((8, 1), np.nan)
    grid = Grid.of(nothing)
    found = combined("a", grid, [sums_of_block(grid, nothing)], counts_of_block(grid, nothing), extremes_of_block(nothing))
    assert np.isnan(found.mean[0])
    assert np.isnan(found.quantile("a", 0.5)).all()


# Sobol' indices. -------------------------------------------------------------------------------------------------


def _ishigami(samples):
    """f = sin x1 + 7 sin^2 x2 + 0.1 x3^4 sin x1 on (-pi, pi)^3 (Ishigami and Homma 1990), its indices in closed form."""
    a, b, pi = 7.0, 0.1, np.pi
    design = jj.Design(dict.fromkeys(("x1", "x2", "x3"), jj.Uniform(-pi, pi)), sampler="saltelli", samples=samples, seed=1)
    x = design.values()
    values = np.sin(x["x1"]) + a * np.sin(x["x2"]) ** 2 + b * x["x3"] ** 4 * np.sin(x["x1"])
    one, two, three = 0.5 * (1 + b * pi**4 / 5) ** 2, a**2 / 8, b**2 * pi**8 * (1 / 18 - 1 / 50)
    variance = one + two + three
    return design, values, np.array([one, two, 0.0]) / variance, np.array([one + three, two, three]) / variance


def test_the_indices_of_ishigamis_function_lie_within_their_limits():
    design, values, first, total = _ishigami(5 * 2**13)
    found = jj.sobol_indices(values, design.names)
    assert np.all(np.abs(found.first - first) <= found.first_half_width)
    assert np.all(np.abs(found.total - total) <= found.total_half_width)
    assert np.all(found.first_half_width < 0.04)
    assert "0.4" in str(found)


def test_the_indices_are_those_of_salib():
    sobol = pytest.importorskip("SALib.analyze.sobol")
    design, values, _, _ = _ishigami(5 * 2**10)
    found = jj.sobol_indices(values, design.names)
    problem = {"num_vars": 3, "names": list(design.names), "bounds": [[-np.pi, np.pi]] * 3}
    other = sobol.analyze(problem, values, calc_second_order=False, seed=1)
    assert_allclose(found.first, other["S1"], atol=1e-2)  # it takes out the mean of all samples, not of A and B
    assert_allclose(found.total, other["ST"], atol=1e-2)
    assert_allclose(found.total_half_width, other["ST_conf"], rtol=0.4)


def test_groups_without_a_value_are_left_out_and_counted():
    design, values, _, _ = _ishigami(5 * 2**10)
    values[12] = np.nan
    found = jj.sobol_indices(values, design.names)
    assert (found.groups, found.left_out) == (2**10 - 1, 1)
    assert "1 groups" in str(found)
    with pytest.raises(ValueError, match="a multiple of 5"):
        jj.sobol_indices(values[:-1], design.names)
    with pytest.raises(ValueError, match="that varies"):
        jj.sobol_indices(np.ones(20), design.names)
    with pytest.raises(ValueError, match="that varies"):
        jj.sobol_indices(np.tile([1.0, 2.0, 3.0, 4.0, 1.0], 4), design.names)


class Pendulum(jj.Scene):
    """A pendulum that is let go at an angle and stops where it hangs down."""

    length: object = jj.parameter(1.0, unit="m", positive=True)
    gravity: object = jj.parameter(9.81, unit="m/s^2")
    coordinates = jj.coordinates("angle")
    example = {"angle": 1.0}

    def bodies(self, t, q):
        return {"bob": jj.Particle(1.0, self.length * jnp.stack([jnp.sin(q.angle), 0.0 * q.angle, -jnp.cos(q.angle)]))}

    def loads(self, motion):
        return (jj.gravity(motion, self.gravity),)

    def events(self, motion):
        return {"down": motion.q.angle}


def test_the_indices_of_a_pendulums_period_lie_within_their_limits(tmp_path):
    """T / 4 = sqrt(L / g) K(sin(angle / 2)), with the complete elliptic integral K."""
    ranges = {"length": (0.5, 1.5), "gravity": (9.0, 10.5), "angle_at_start": (0.2, 2.8)}
    length, gravity, angle = (jj.Uniform(*limits) for limits in ranges.values())
    study = jj.Study(Pendulum(), vary={"length": length, "gravity": gravity}, start={"angle": angle}, sampler="saltelli", samples=5 * 2**9, seed=4)
    result = study.run(tmp_path / "pendulum.zarr", t1=3.0, rtol=1e-8, outputs={"quarter": jj.EventTime("down")}, progress=False)
    assert result.counts == {"event": len(result)}

    def quarter(length, gravity, angle):
        return np.sqrt(length / gravity) * special.ellipk(np.sin(angle / 2) ** 2)

    at = study.design.values()
    found = result.to_xarray()["quarter"].values
    assert_allclose(found, quarter(*at.values()), rtol=1e-7)

    nodes, weights = np.polynomial.legendre.leggauss(40)
    points = [low + (high - low) * (nodes + 1) / 2 for low, high in ranges.values()]
    values = quarter(*np.meshgrid(*points, indexing="ij"))
    mean = np.einsum("ijk,i,j,k->", values, *[weights / 2] * 3)
    centred = values - mean
    variance = np.einsum("ijk,i,j,k->", centred**2, *[weights / 2] * 3)
    indices = result.sensitivity("quarter")
    for i in range(3):
        alone = np.tensordot(np.tensordot(np.moveaxis(centred, i, 0), weights / 2, (2, 0)), weights / 2, (1, 0))  # mean given quantity i
        given_others = np.tensordot(np.moveaxis(centred, i, 0), weights / 2, (0, 0))
        first = np.sum(alone**2 * weights / 2) / variance
        total = 1 - np.einsum("ij,i,j->", given_others**2, weights / 2, weights / 2) / variance
        assert abs(indices.first[i] - first) <= indices.first_half_width[i] < 0.15
        assert abs(indices.total[i] - total) <= indices.total_half_width[i] < 0.15
    assert "length" in str(indices)
    with pytest.raises(ValueError, match="no output `period`"):
        result.sensitivity("period")


def test_what_lies_beyond_the_grid_is_printed_and_drawn_as_that(tmp_path):
    """The grid spans twice the range of the first block; the middle between its edge and the extreme says nothing."""
    angles = np.r_[np.linspace(0.0, 1.0, 2048), np.linspace(2.0, 12.0, 2000)]
    study = jj.Study(jj.models.TiltingDisc(), start={"yaw": angles, "lean": 0.1})
    found = study.run(tmp_path / "discs.zarr", t1=1e-6, outputs={"yaw": jj.End("yaw", "rad")}, progress=False)
    assert found.quantile("yaw", 0.975) == (pytest.approx(1.5), pytest.approx(12.0))
    median, *beyond = str(found).split()[-3:]
    assert float(median) == pytest.approx(0.9884, abs=1e-3)
    assert beyond == [">", "1.5"]
    (axis,) = found.plot().axes
    assert [text.get_text() for text in axis.get_legend().get_texts()] == ["anywhere in here"]
    counts, edges, _ = axis.patches[1].get_data()
    assert (counts[-1], edges[-1]) == (2000, pytest.approx(12.0))
