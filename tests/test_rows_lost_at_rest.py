"""Rows that are nonlinear in the speeds and lose their slope where these vanish: no motion is determined
beyond, whatever times are saved.
"""

from functools import cache

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import result_codes as results
from numpy.testing import assert_allclose
from refusals import refused
from small_scenes import InSpace, OnPlane

import jourdain_jax as jj

# rows in the speeds x, y, z, and in c, which falls through zero at `stop`; and speeds on them where c = 1
ROWS = {
    "speed": (lambda x, y, z, c: x**2 + y**2 - c**2, (0.6, 0.8, 0.3)),
    "one component": (lambda x, y, z, c: x**2 - c**2, (1.0, 0.4, 0.3)),
    "quadric": (lambda x, y, z, c: x**2 + y**2 + z**2 + x * y - 2.0 * c**2, (0.0, 1.0, 1.0)),
    "two rows": (
        lambda x, y, z, c: jnp.stack([x**2 + y**2 + z**2 - 2.0 * c**2, x + 2.0 * y - z - c]),
        (0.0, 1.0, 1.0),
    ),
    "weighted": (lambda x, y, z, c: 1e4 * (x**2 + 3.0 * z**2 - c**2), (0.5, 0.4, 0.5)),
}
# and such as determine the motion beyond, though their slope vanishes
PASSED = {
    "cube": (lambda x, y, z, c: x**3 - c**3, (1.0, 0.4, 0.3)),
    "magnitude": (lambda x, y, z, c: x * jnp.abs(x) - c, (1.0, 0.4, 0.3)),
}


@cache
def _lawful(row):
    class Lawful(InSpace):
        """A particle whose speeds obey a row."""

        stop: float = jj.parameter(0.7)
        pull: float = jj.parameter(0.0)

        def velocity_constraints(self, motion):
            u = motion.u
            return {"row": row(u.x_rate, u.y_rate, u.z_rate, 1.0 - motion.t / self.stop)}

        def loads(self, motion):
            return jj.gravity(motion, self.pull, (0.0, -1.0, 0.0))

    return Lawful


def _scene(row, stop, pull=0.0):
    return _lawful(row)(stop=stop, pull=pull)


def _end(scene, speeds, **options):
    return jj.simulate(scene, dict(zip(("x_rate", "y_rate", "z_rate"), speeds, strict=True)), **options)


CASES = [(name, {"backend": backend}) for name in ROWS for backend in ("native", "dense")]
CASES += [
    (name, options)
    for name in ("speed", "two rows")
    for options in ({"backend": "xla"}, {"solver": jj.Taylor()})
]


@pytest.mark.parametrize(("name", "options"), CASES, ids=str)
def test_no_lane_goes_through_a_row_that_is_lost(name, options):
    row, speeds = ROWS[name]
    scene = _scene(row, 0.7)
    ts = jnp.linspace(0.0, 2.0, 3 + 8 * len(name))[1:]

    def code(stop, pull):
        return _end(scene.replace(stop=stop, pull=pull), speeds, ts=ts, **options).result

    lanes = 4 if options.get("backend") in ("dense", "xla") else 32
    stops = jnp.concatenate(
        [ts[lanes // 2 : lanes], jnp.linspace(0.3, 1.7, lanes // 2)]
    )  # half of them are saved times
    pulls = jnp.asarray(np.random.default_rng(len(name)).choice([0.0, 0.7, 2.0], lanes))
    assert not np.isin(jax.jit(jax.vmap(code))(stops, pulls), (results.SUCCESS, results.EVENT)).any()


@pytest.mark.parametrize("backend", ["native", "xla"])
def test_no_step_is_so_long_that_it_misses_the_loss(backend):
    """For any tolerance and saved times: a step may begin as far before the loss as it ends behind."""
    row, speeds = ROWS["speed"]

    def code(ts, tolerance):
        options = {"solver": diffrax.Tsit5(), "rtol": tolerance, "atol": tolerance, "backend": backend}
        return _end(_scene(row, 1.0, 0.3), speeds, ts=ts, **options).result

    times = jnp.array([[0.1, 0.2, 2.0], [2 / 3, 4 / 3, 2.0]])
    found = jax.jit(jax.vmap(jax.vmap(code, (None, 0)), (0, None)))(
        times, jnp.array([1e-3, 1e-4, 1e-5, 1e-6])
    )
    assert np.all(found == results.STEP_TOO_SMALL)


@pytest.mark.parametrize("backend", ["native", "dense"])
@pytest.mark.parametrize("name", PASSED)
def test_motions_that_rows_determine_beyond_are_right_or_flagged(name, backend):
    row, speeds = PASSED[name]
    for count in (5, 40):
        motion = _end(_scene(row, 0.7), speeds, ts=jnp.linspace(0.0, 2.0, count + 1)[1:], backend=backend)
        c = 1.0 - float(motion.t_end) / 0.7
        expected = c if name == "cube" else np.sign(c) * np.sqrt(abs(c))
        assert int(motion.result) != results.SUCCESS or motion.u_end[0] == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize("size", [1.0, 1e-3, 1e-5, 1e-7])
def test_slow_motions_are_as_fast_ones(size):
    def end(speeds, pull):
        return _end(
            _scene(lambda x, y, z, c: (x**2 + y**2) / size**2 - 1.0, 0.7, pull),
            speeds,
            t1=1.0,
            backend="native",
        )

    found = end((0.6 * size, 0.8 * size, 0.0), 2.0 * size)
    assert found.result == results.SUCCESS
    assert_allclose(found.u_end[:2] / size, [0.69710104, -0.7169729], rtol=1e-6)


def test_derivatives_beyond_are_no_numbers():
    row, speeds = ROWS["speed"]

    def before_and_beyond(stop):
        motion = _end(_scene(row, stop), speeds, ts=[0.5, 2.0], backend="native")
        return jnp.stack([motion.q[0, 0], motion.q_end[0]])

    before, beyond = jax.jit(jax.jacrev(before_and_beyond))(0.7)
    assert_allclose(before, 0.6 * 0.5**2 / (2 * 0.7**2), rtol=1e-6)  # of x = 0.6 (t - t^2/(2 stop))
    assert np.isnan(beyond)


class Slider(OnPlane):
    """A mass in a plane under a constant push; `row` says what else holds it."""

    domain = {"x": (-1.0, 1.0), "y": (-1.0, 1.0)}
    first = True
    row = None
    mass: jax.Array = jj.parameter(1.0)

    def loads(self, motion):
        return jj.Load(generalized={"x_rate": 1.0 + 0.0 * motion.t, "y_rate": 0.5 + 0.0 * motion.t})

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
    "by a loop": (
        True,
        lambda t, q, u: (
            jax.lax.while_loop(lambda c: c[0] < t - 2.0, lambda c: (c[0] + 1.0, 1.0 + c[1]), (0.0, 0.0))[1]
            * u.x_rate
        ),
    ),
}
FOLLOWS = {
    "the rail again": (True, lambda t, q, u: 3.0 * u.y_rate - 0.3 * u.x_rate),
    "the rail, times a branch": (True, lambda t, q, u: (1.0 + ramp(t - 2.0)) * (u.y_rate - 0.1 * u.x_rate)),
    "the rail, times what is flat here": (
        True,
        lambda t, q, u: jnp.exp(-jnp.maximum(q.x, 1.5)) * (u.y_rate - 0.1 * u.x_rate),
    ),
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
    with pytest.raises(
        jj.NotLowered,
        match="constraints `late` are redundant at all probed states, but not provably everywhere",
    ):
        jj.lower(scene)
    refused(
        (
            r"of `Slider` (may become independent during a motion|are nonlinear in the speeds).*use"
            r" jj.Formulation\('full'\)"
        ),
        jj.simulate,
        scene,
        {},
        t1=1.0,
        formulation=jj.Formulation("minimal"),
    )


@pytest.mark.parametrize("name", FOLLOWS)
def test_a_row_that_follows_by_an_identity_is_left_out(name, monkeypatch):
    scene = slider(FOLLOWS[name], monkeypatch)
    assert jj.structure_of(scene).may_set_in == ()
    assert jj.lower(scene).left_out == ("late",)


@pytest.mark.parametrize("use", ["simulate", "jit", "rollout"])
def test_a_motion_meets_a_row_that_has_set_in(use, monkeypatch):
    """The mass would be stopped along x when the row sets in: no motion without an impact, so it ends there
    with a result code, however it is simulated.
    """
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
