"""Modes of JAX that a user sets for their own code, and threads of their own, leave the package's results as
they are.
"""

import sys
import traceback
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from threading import Barrier

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose
from refusals import refused
from small_scenes import Bead

import jourdain_jax as jj

RATE = 2.0  # rad/s


class Spring(jj.Scene):
    """A particle on a spring, whose numbers are of several types and ranks."""

    mass: object = jj.parameter(1)
    stiffness: object = jj.parameter(RATE**2)
    coordinates = jj.coordinates("x y")

    def bodies(self, t, q):
        return {"bead": jj.Particle(self.mass, (q.x, q.y, 0))}

    def loads(self, motion):
        return jj.point_force(
            motion["bead"].point(),
            -self.stiffness * jnp.eye(3, dtype=jnp.float32) @ jnp.stack([motion.q.x, motion.q.y, 0.0]),
        )

    def velocity_constraints(self, motion):
        return {"along x": motion.u.y_rate}


def _end(stiffness, **options):
    return jj.simulate(Spring(stiffness=stiffness), {"x": 1}, ts=[0.0, 1.0], **options)["x"][-1]


SLOPE = -np.sin(RATE) / (2 * RATE)  # d/dk of cos(sqrt(k)) at k = RATE^2


def test_motions_and_their_derivatives_are_found_where_types_and_ranks_of_the_users_own_lines_must_fit():
    modes = {"jax_numpy_dtype_promotion": "strict", "jax_numpy_rank_promotion": "raise"}
    before = {name: getattr(jax.config, name) for name in modes}
    for name, mode in modes.items():
        jax.config.update(name, mode)
    try:
        motion = jj.simulate(Spring(), {"x": 1}, t1=1)
        assert_allclose(motion["x"][-1], np.cos(RATE), atol=1e-7)
        assert "reached" in str(motion)
        assert motion.accelerations().udot.shape == (201, 2)
        lanes = jj.rollout(
            Spring(), {"x": np.ones(2)}, parameters={"stiffness": np.array([1.0, 4.0])}, t1=1.0
        )
        assert_allclose(lanes["x"][:, -1], np.cos([1.0, 2.0]), atol=1e-7)
        assert_allclose(
            jax.grad(jax.jit(_end))(RATE**2), SLOPE, atol=1e-6
        )  # rules of derivatives are asked for once `simulate` has returned
        assert {name: getattr(jax.config, name) for name in modes} == modes
    finally:
        for name, mode in before.items():
            jax.config.update(name, mode)


def test_classes_of_scenes_may_be_written_in_several_threads_at_once():
    together, many = Barrier(4), 25
    before = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    try:

        def write(number):
            together.wait(timeout=60)
            for _ in range(many):
                kind = type("Kind", (Spring,), {"conventions": str(number), "__annotations__": {}})
                assert kind().conventions == str(number)
            return number

        with ThreadPoolExecutor(4) as threads:
            assert list(threads.map(write, range(4))) == [0, 1, 2, 3]
    finally:
        sys.setswitchinterval(before)


def test_numbers_of_extended_precision_are_rounded_and_complex_ones_named():
    wide = np.array([1.0, 4.0], np.longdouble)
    lanes = jj.rollout(Spring(), {"x": wide[:1].repeat(2)}, parameters={"stiffness": wide}, ts=wide - 1)
    assert_allclose(lanes["x"][:, -1], np.cos([3.0, 6.0]), atol=1e-6)
    assert jj.Sampled(wide, wide)(2.0) == 2.0
    assert all(
        scene.stiffness.dtype == np.float64
        for scene in (Spring(stiffness=wide[1]), Spring().replace(stiffness=np.array(4.0, np.longdouble)))
    )
    refused(
        "`ts` of `Sampled` is of type complex256, expected real numbers",
        jj.Sampled,
        wide.astype(np.clongdouble),
        wide,
    )


SKATE = jj.models.Skate()
SPEEDS = jnp.array([0.5, 1.0])


def _place(speed):
    return jj.simulate(SKATE, {"x_rate": speed, "heading_rate": 0.7}, ts=[0.5]).q[0]


def _converted(speed):
    function, constants = jax.closure_convert(lambda x: _place(x * speed), 1.0)
    return function(1.0, *constants)


WAYS = {
    "checkpoint": jax.vmap(jax.checkpoint(_place)),
    "scan": lambda speeds: jax.lax.scan(lambda none, speed: (none, _place(speed)), None, speeds)[1],
    "map": lambda speeds: jax.lax.map(_place, speeds, batch_size=2),
    "cond": jax.vmap(lambda speed: jax.lax.cond(speed > 0.0, _place, lambda speed: jnp.zeros(3), speed)),
    "closure_convert": jax.vmap(_converted),
}


@pytest.fixture(scope="module")
def plainly():
    return _with_cotangents(jax.vmap(_place))


@partial(jax.jit, static_argnums=0)
def _with_cotangents(function):
    found, back = jax.vjp(function, SPEEDS)
    return found, back(jnp.sin(found))[0]


@pytest.mark.parametrize("way", WAYS.values(), ids=WAYS)
def test_values_and_gradients(way, plainly):
    for found, expected in zip(_with_cotangents(way), plainly, strict=True):
        assert_allclose(found, expected, rtol=1e-12)


def test_with_floats_checked():
    with jax.debug_nans(True):
        assert_allclose(jax.jit(_place)(1.0), _place(1.0), rtol=1e-12)


class Slider(Bead):
    """A bead on a plane whose load has a mistake."""

    def loads(self, motion):
        return jj.point_force(motion["bead"].point(), self.pull(motion))


class WrongShapes(Slider):
    """Its mistake is noticed by JAX."""

    def pull(self, motion):
        return jnp.ones((3, 4)) @ jnp.ones(3)  # the mistake


class WrongName(Slider):
    """Its mistake is noticed by the package."""

    def pull(self, motion):
        return motion.q.z * jnp.ones(3)  # the mistake


def lines(error):
    """The lines of the traceback below the one that called, without those of what wraps public functions (in
    tests, jaxtyping too).
    """
    wrappers = (str(Path("scene", "arguments.py")), str(Path("jaxtyping", "_decorator.py")))
    return [
        frame.line
        for frame in traceback.extract_tb(error.__traceback__)[1:]
        if not frame.filename.endswith(wrappers)
    ]


@pytest.mark.parametrize("scene", [WrongShapes(), WrongName()], ids=["noticed by JAX", "noticed here"])
@pytest.mark.parametrize(
    "call",
    [lambda s: jj.simulate(s, {}, t1=1.0), jj.report, lambda s: jj.start(s, x=0.1)],
    ids=["simulate", "report", "start"],
)
def test_the_traceback_of_a_mistake_in_a_method_shows_the_lines_of_its_author(scene, call):
    with pytest.raises((TypeError, AttributeError)) as caught:
        call(scene)
    shown = lines(caught.value)
    assert shown[-1].endswith("# the mistake")
    assert shown[-2].startswith("return jj.point_force")
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
