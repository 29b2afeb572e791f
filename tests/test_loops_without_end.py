"""A loop of the user's that does not end is named while a scene is probed, in whatever method it stands; and reasons for not lowering are true."""

import jax
import jax.numpy as jnp
import pytest
from small_scenes import OnPlane

import jourdain_jax as jj
from jourdain_jax.eager import numpy_backend


def endless(x):
    return jax.lax.while_loop(lambda c: jnp.abs(c - x) >= 0.0, lambda c: 0.5 * (c + x), 0.0 * x)


def endless_where_negative(x):
    """A root by Newton's method, which does not arrive where there is none."""
    return jax.lax.while_loop(lambda c: jnp.abs(c * c - x) > 1e-12, lambda c: 0.5 * (c + x / c), 1.0 + 0.0 * x)


class Looped(jj.Scene):
    """A mass on a line; the loop stands in one of its methods."""

    coordinates = jj.coordinates("x y")
    where = ""
    loop = staticmethod(endless)

    def asked(self, where, x):
        return type(self).loop(x) if where == self.where else x

    def bodies(self, t, q):
        return {"mass": jj.Particle(1.0, jnp.stack([q.x, self.asked("bodies", q.y), 0.0 * q.x]))}

    def loads(self, motion):
        return (jj.Load(generalized={"x_rate": self.asked("loads", -motion.q.x)}),)

    def velocity_constraints(self, motion):
        return {"row": motion.u.y_rate - self.asked("rows", motion.q.x)}


@pytest.mark.parametrize("where", ["bodies", "loads", "rows"])
def test_a_loop_that_does_not_end_is_named(where, monkeypatch):
    monkeypatch.setattr(Looped, "where", where)
    with pytest.raises(ValueError, match=r"a `while_loop` in `endless` \(line \d+ of test_loops_without_end.py\) does not end"):
        jj.lower(Looped())


def test_a_loop_that_ends_at_some_states_only_is_no_reason_to_refuse_the_scene(monkeypatch):
    monkeypatch.setattr(Looped, "where", "rows")
    monkeypatch.setattr(Looped, "loop", staticmethod(endless_where_negative))
    monkeypatch.setattr(numpy_backend, "MOST_TURNS", 300)
    assert jj.structure_of(Looped()).rank == 1


class Kinked(OnPlane):
    """A row with a magnitude, at whose kink a probe lies."""

    def velocity_constraints(self, motion):
        return {"row": motion.u.y_rate - jnp.abs(motion.q.x) * motion.u.x_rate}


def test_no_scene_is_said_to_have_derivatives_of_its_own_that_has_none():
    for scene in (Kinked(), jj.models.TwoWheelAxleRedundant()):
        said = jj.report(scene).lowering if isinstance(scene, Kinked) else jj.lower(scene, every_speed=True).summary()
        assert "derivative of its own" not in said
