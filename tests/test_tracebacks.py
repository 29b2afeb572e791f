"""Errors in a user's own methods show the user's lines, not those of the package between them."""

import traceback
from pathlib import Path

import jax
import jax.numpy as jnp
import pytest

import jourdain_jax as jj


class Slider(jj.Scene):
    """A bead on a plane whose load has a mistake."""

    coordinates = jj.coordinates("x y")

    def bodies(self, t, q):
        return {"bead": jj.Particle(1.0, jnp.stack([q.x, q.y, 0.0 * q.x]))}

    def loads(self, motion):
        return (jj.point_force(motion["bead"].point(), self.pull(motion)),)


class WrongShapes(Slider):
    """Its mistake is noticed by JAX."""

    def pull(self, motion):
        return jnp.ones((3, 4)) @ jnp.ones(3)  # the mistake


class WrongName(Slider):
    """Its mistake is noticed by the package."""

    def pull(self, motion):
        return motion.q.z * jnp.ones(3)  # the mistake


def lines(error) -> list[str]:
    """The lines of the traceback below the one that called, without those of what wraps public functions (in tests, jaxtyping too)."""
    wrappers = (str(Path("scene", "tracebacks.py")), str(Path("jaxtyping", "_decorator.py")))
    return [frame.line for frame in traceback.extract_tb(error.__traceback__)[1:] if not frame.filename.endswith(wrappers)]


@pytest.mark.parametrize("scene", [WrongShapes(), WrongName()], ids=["noticed by JAX", "noticed here"])
@pytest.mark.parametrize("call", [lambda s: jj.simulate(s, {}, t1=1.0), jj.report, lambda s: jj.start(s, x=0.1)], ids=["simulate", "report", "start"])
def test_the_traceback_of_a_mistake_in_a_method_shows_the_lines_of_its_author(scene, call):
    with pytest.raises((TypeError, AttributeError)) as caught:
        call(scene)
    shown = lines(caught.value)
    assert shown[-1].endswith("# the mistake")
    assert shown[-2].startswith("return (jj.point_force")
    assert len(shown) <= 3  # with a lambda above
    assert any("JAX_TRACEBACK_FILTERING=off shows them" in note for note in caught.value.__notes__)


def test_all_lines_are_shown_where_jax_is_told_to_show_its_own():
    before = jax.config.jax_traceback_filtering
    jax.config.update("jax_traceback_filtering", "off")
    try:
        with pytest.raises(AttributeError) as caught:
            jj.simulate(WrongName(), {}, t1=1.0)
    finally:
        jax.config.update("jax_traceback_filtering", before)
    assert len(lines(caught.value)) > 10


def test_errors_of_the_package_itself_keep_their_lines():
    with pytest.raises(ValueError, match="no coordinate or speed `z`") as caught:
        jj.simulate(jj.models.Skate(), {"z": 1.0}, t1=1.0)
    assert len(lines(caught.value)) > 2
