"""Rows that hold nothing at first and set in later, or elsewhere, are kept: none is left out unless an identity makes it follow from the others."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import result_codes as results
from small_scenes import OnPlane

import jourdain_jax as jj


class Slider(OnPlane):
    """A mass in a plane under a constant push; `row` says what else holds it."""

    domain = {"x": (-1.0, 1.0), "y": (-1.0, 1.0)}
    first = True
    row = None
    mass: jax.Array = jj.parameter(1.0)

    def loads(self, motion):
        return (jj.Load(generalized={"x_rate": 1.0 + 0.0 * motion.t, "y_rate": 0.5 + 0.0 * motion.t}),)

    def velocity_constraints(self, motion):
        rail = {"rail": motion.u.y_rate - 0.1 * motion.u.x_rate} if self.first else {}
        return rail | {"late": type(self).row(motion.t, motion.q, motion.u)}


def ramp(x):
    return jnp.clip(x, 0.0, 1.0) ** 2


SETS_IN = {
    "in time": (False, lambda t, q, u: jnp.where(t > 2.0, u.x_rate, 0.0)),
    "in time, slowly": (False, lambda t, q, u: ramp(t - 2.0) * u.x_rate),
    "in time, beside a rail": (True, lambda t, q, u: jnp.where(t > 2.0, u.x_rate, u.y_rate - 0.1 * u.x_rate)),
    "beyond a place": (True, lambda t, q, u: ramp(q.x - 1.5) * u.x_rate + u.y_rate - 0.1 * u.x_rate),
    "by a step that is flat here": (False, lambda t, q, u: jax.nn.relu(t - 2.0) * u.x_rate),
    "as a drift": (True, lambda t, q, u: u.y_rate - 0.1 * u.x_rate + jnp.maximum(t - 2.0, 0.0)),
    "by a loop": (True, lambda t, q, u: jax.lax.while_loop(lambda c: c[0] < t - 2.0, lambda c: (c[0] + 1.0, 1.0 + c[1]), (0.0, 0.0))[1] * u.x_rate),
}
FOLLOWS = {
    "the rail again": (True, lambda t, q, u: 3.0 * u.y_rate - 0.3 * u.x_rate),
    "the rail, times a branch": (True, lambda t, q, u: (1.0 + ramp(t - 2.0)) * (u.y_rate - 0.1 * u.x_rate)),
    "the rail, times what is flat here": (True, lambda t, q, u: jnp.exp(-jnp.maximum(q.x, 1.5)) * (u.y_rate - 0.1 * u.x_rate)),
    "nothing at all": (False, lambda t, q, u: jnp.tanh(t) * u.x_rate - u.x_rate * jnp.tanh(t)),
}


def slider(case, monkeypatch):
    first, row = case
    monkeypatch.setattr(Slider, "first", first)
    monkeypatch.setattr(Slider, "row", staticmethod(row))
    return Slider()


@pytest.mark.parametrize("name", SETS_IN)
def test_a_row_that_may_set_in_is_not_left_out(name, monkeypatch):
    scene = slider(SETS_IN[name], monkeypatch)
    assert jj.structure_of(scene).may_set_in == ("late",)
    with pytest.raises(jj.NotLowered, match="rows `late` follow from the others at all probed states, but nothing says that they do elsewhere or later"):
        jj.lower(scene)
    with pytest.raises(
        ValueError, match=r"of `Slider` (may set in where they do not follow from the others|are nonlinear in the speeds).*use jj.Formulation\('full'\)"
    ):
        jj.simulate(scene, {}, t1=1.0, formulation=jj.Formulation("minimal"))


@pytest.mark.parametrize("name", FOLLOWS)
def test_a_row_that_follows_by_an_identity_is_left_out(name, monkeypatch):
    scene = slider(FOLLOWS[name], monkeypatch)
    assert jj.structure_of(scene).may_set_in == ()
    assert jj.lower(scene).left_out == ("late",)


@pytest.mark.parametrize("use", ["simulate", "jit", "rollout"])
def test_a_motion_meets_a_row_that_has_set_in(use, monkeypatch):
    """The mass would be stopped along x when the row sets in: no motion without an impact, so it ends there with a result code, however it is simulated."""
    scene = slider(SETS_IN["in time"], monkeypatch)

    def speed(scene):
        motion = jj.simulate(scene, {}, ts=[1.5, 3.0])
        return motion.u[:, 0], motion.result

    if use == "rollout":
        lanes = jj.rollout(scene, {"x": jnp.zeros(2)}, ts=[1.5, 3.0]).lanes
        found, result = lanes.u[0, :, 0], lanes.result[0]
    else:
        found, result = (jax.jit(speed) if use == "jit" else speed)(scene)
    assert np.allclose(found, [1.5, np.nan], atol=1e-6, equal_nan=True)
    assert int(result) == results.STEP_TOO_SMALL


def test_a_linkage_that_is_overconstrained_keeps_its_program():
    assert jj.lower(jj.models.TwoWheelAxleRedundant()).left_out == ("wheel2 upright",)
