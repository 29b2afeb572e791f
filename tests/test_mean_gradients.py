"""Gradients of the means of studies: the derivative of a mean over fixed probabilities, and what events do to
it.
"""

import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.special import ndtri

import jourdain_jax as jj
from jourdain_jax.studies import End, Happened, LogNormal, LogUniform, Normal, Quantity, Uniform


class Thrown(jj.Scene):
    """A particle thrown upwards: z = z0 + v t - g t^2 / 2; it may reach the ground."""

    gravity: float = jj.parameter(9.0)
    coordinates = jj.coordinates("z")

    def bodies(self, t, q):
        return {"ball": jj.Particle(1.0, [0.0, 0.0, q.z])}

    def loads(self, motion):
        return jj.gravity(motion, self.gravity)

    def events(self, motion):
        return {"ground": motion.q.z}


COUNT, TIME = 64, 0.5
OUTPUTS = {
    "height": End("z", "m"),
    "landed": Happened("ground"),
    "square": Quantity(lambda motion: motion.q_end[0] ** 2, "m^2"),
}
HOW = {"t1": TIME, "outputs": OUTPUTS, "rtol": 1e-10, "atol": 1e-10}


HEIGHT, SPEED = Normal(20.0, 0.5), Uniform(1.0, 3.0)


def thrown(z=HEIGHT, v=SPEED, **more):
    return jj.Study(
        Thrown(), start={"z": z, "z_rate": v}, **({"sampler": "sobol", "samples": COUNT, "seed": 3} | more)
    )


def test_gradients_are_those_of_the_closed_form():
    study = thrown()
    found = study.mean_gradients(parameters=("gravity",), **HOW)
    u = study.design.probabilities(0, COUNT)
    x = study.design.values()
    height = x["z_at_start"] + x["z_rate_at_start"] * TIME - 4.5 * TIME**2
    moved = {
        "z_at_start.mean": np.ones(COUNT),
        "z_at_start.sigma": ndtri(u[:, 0]),
        "z_rate_at_start.low": TIME * (1 - u[:, 1]),
        "z_rate_at_start.high": TIME * u[:, 1],
        "gravity": np.full(COUNT, -0.5 * TIME**2),
    }
    assert found.names == tuple(moved)
    assert_allclose(found.mean, [height.mean(), 0.0, (height**2).mean()], rtol=1e-9, atol=1e-12)
    for name, moves in moved.items():
        assert found.of("height", name) == pytest.approx(moves.mean(), rel=1e-8, abs=1e-9)
        assert found.of("square", name) == pytest.approx((2 * height * moves).mean(), rel=1e-8, abs=1e-7)
    error = np.std(2 * height * moved["z_at_start.sigma"], ddof=1) / np.sqrt(COUNT)
    assert_allclose(found.standard_error[2, 1], error, rtol=1e-7)
    assert found.warnings == ()
    assert found.failed == 0
    assert "z_at_start.sigma" in str(found)


@pytest.mark.parametrize(
    "how", [LogNormal(20.0, 0.1), LogUniform(18.0, 22.0), Normal(20.0, 0.0), Uniform(18.0, 22.0)]
)
def test_values_of_distributions_have_their_derivatives(how):
    u = np.linspace(0.05, 0.95, 7)
    names = list(vars(how))
    assert list(how.derivatives(u)) == names
    for name in names:
        step = 1e-6
        up, down = (
            type(how)(**(vars(how) | {name: getattr(how, name) + sign * step}))
            for sign in ((1, 0) if name == "sigma" else (1, -1))
        )
        rough = (up.values(u) - down.values(u)) / (step if name == "sigma" else 2 * step)
        assert_allclose(how.derivatives(u)[name], rough, rtol=1e-4, atol=1e-6)


def test_columns_of_a_table_are_shifted():
    found = thrown(
        np.linspace(19.0, 21.0, COUNT), np.linspace(1.0, 3.0, COUNT), sampler="random", samples=None, seed=0
    ).mean_gradients(**HOW)
    assert found.names == ("z_at_start.shift", "z_rate_at_start.shift")
    assert_allclose(found.gradient[0], [1.0, TIME], rtol=1e-9)
    with pytest.raises(ValueError, match=r"there is no `hight`; .*`height`"):
        found.of("hight", "z_at_start.shift")


def test_where_lanes_end_in_different_ways_it_is_said_and_what_has_no_derivative_is_nan():
    with pytest.warns(jj.SensitivityWarning) as warned:
        found = thrown(Uniform(0.05, 3.0)).mean_gradients(**HOW)
    texts = [str(one.message) for one in warned]
    assert texts == list(found.warnings)
    assert any("the means of landed have no pathwise derivative" in text for text in texts)
    assert any(
        f"{round(found.mean[1] * COUNT)} of 64 samples end at an event, others at another event or at none"
        in text
        for text in texts
    )
    assert 0 < found.mean[1] < 1
    assert np.isnan(found.gradient[1]).all()
    assert np.isfinite(found.gradient[0]).all()


def test_lanes_that_fail_are_left_out_and_named():
    class Steep(Thrown):
        def loads(self, motion):
            return jj.gravity(motion, jnp.where(motion.q.z > 20.0, jnp.nan, self.gravity))

    with pytest.warns(jj.SensitivityWarning, match="motions failed and are omitted"):
        found = jj.Study(
            Steep(), start={"z": Uniform(15.0, 25.0), "z_rate": 0.0}, samples=COUNT, seed=3
        ).mean_gradients(**HOW)
    assert 0 < found.failed < COUNT
    assert found.lanes[0] == COUNT - found.failed
    assert_allclose(
        found.of("height", "z_at_start.low") + found.of("height", "z_at_start.high"), 1.0, rtol=1e-9
    )
