"""Machine code of our own against the same by XLA: rates, motions, derivatives, and when it is not taken."""

import functools
from pathlib import Path

import diffrax
import evaluated_natively
import jax
import jax.numpy as jnp
import machine_code
import numpy as np
import pytest
import result_codes as results
from numpy.testing import assert_allclose, assert_array_equal

import jourdain_jax as jj
from jourdain_jax import structure_of
from jourdain_jax.lowering.dense_rates import dense_rates
from jourdain_jax.motion.integrators.tableaus import TSIT5
from jourdain_jax.motion.native import kernel as kernels
from jourdain_jax.motion.native.functions import Form
from jourdain_jax.motion.simulate import set_up
from jourdain_jax.native import ffi, host
from jourdain_jax.program import emit

pytestmark = machine_code.needed


@pytest.mark.parametrize("name", sorted(jj.models.MODELS))
def test_rates_are_those_of_xla_and_of_dense_matrices_at_random_states(name):
    scene = jj.models.MODELS[name]()
    program = set_up(scene, formulation=jj.Formulation("full") if name == "tilting-disc-quaternion" else None).field.lowered
    t, q, u = jj.sample_states(scene, 1000)
    inputs = np.random.default_rng(0).normal(size=(1000, len(scene.inputs)))
    fixed = [jnp.full((1000, 1), x) for x in program.fixed_values(scene)]
    given = jnp.concatenate([*fixed, t[:, None], q, u[:, np.array(program.independent, int)], inputs], axis=1)
    outputs = [*program.qdot, *program.ydot]
    found = np.asarray(evaluated_natively.function(program.graph, outputs, program.variables)(given))
    # by XLA one operation after the other: nothing takes long to compile
    by_xla = emit.run(program.graph, outputs, dict(zip(program.variables, given.T, strict=True)))
    parameters = jax.tree.map(lambda x: np.broadcast_to(np.asarray(x, float), (1000, *np.shape(x))), scene)
    qdot, ydot, _ = dense_rates(scene, structure_of(scene), program.independent, parameters, *map(np.asarray, (t, q, u)), inputs)
    ways = {"XLA": np.stack([np.broadcast_to(np.asarray(x), 1000) for x in by_xla], axis=1), "dense": np.concatenate([qdot, ydot], axis=1)}
    for way, expected in ways.items():
        off = np.max(np.abs(found - expected), axis=1) / np.max(np.abs(expected), axis=1)
        assert np.mean(off < 1e-13) >= (1.0 if way == "XLA" else 0.98), way  # NaN is not
        assert np.max(off) < 1e-12, way  # dense matrices themselves are off by this much at some states


def _motions(scene, starts=None, **options):
    return [jj.simulate(scene, starts, backend=backend, **options) for backend in ("native", "xla")]


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("tilting-disc", {"t1": 3.0, "rtol": 1e-9, "atol": 1e-9}),
        ("tilting-disc", {"t1": 3.0, "rtol": 1e-5, "atol": 1e-5}),
        ("chaplygin-sleigh", {"ts": [7.0]}),
        ("whipple-bicycle", {"ts": [1.0, 2.0]}),
        ("tilting-disc-quaternion", {"t1": 2.0, "formulation": jj.Formulation("full")}),
        ("ball-on-turntable", {"ts": [2.0]}),
        ("double-pendulum-rods", {"ts": [0.0, 3.0], "t1": 3.5, "solver": diffrax.Dopri5()}),
        ("snakeboard", {"ts": [-2.0], "t1": -3.0}),
    ],
)
def test_motions_are_those_of_xla_step_by_step(name, options):
    ours, theirs = _motions(jj.models.MODELS[name](), **options)
    assert (int(ours.accepted), int(ours.rejected), int(ours.result)) == (int(theirs.accepted), int(theirs.rejected), int(theirs.result))
    for a, b in ((ours.q, theirs.q), (ours.u, theirs.u), (ours.q_end, theirs.q_end), (ours.u_end, theirs.u_end), (ours.t_end, theirs.t_end)):
        assert_allclose(a, b, rtol=1e-10, atol=1e-10)
    if ours.work is not None:
        assert_allclose(ours.work, theirs.work, rtol=1e-10, atol=1e-10)
    assert_allclose(ours.smallest_pivot, theirs.smallest_pivot, rtol=1e-9)


def test_a_disc_that_falls_stops_where_it_does_by_xla():
    disc = jj.models.TiltingDisc()
    ours, theirs = _motions(disc, {"lean": 0.6, "spin_rate": -0.1}, t1=5.0)
    assert int(ours.result) == int(theirs.result) == results.EVENT
    assert int(ours.event) == int(theirs.event) == 0
    assert (int(ours.accepted), int(ours.rejected)) == (int(theirs.accepted), int(theirs.rejected))
    assert_allclose(ours.t_end, theirs.t_end, rtol=1e-13)
    assert_allclose(ours.q_end, theirs.q_end, rtol=1e-10, atol=1e-12)
    assert_array_equal(np.isnan(ours.q), np.isnan(theirs.q))


@pytest.mark.parametrize("options", [{"max_steps": 7}, {"rtol": 1e-300, "atol": 1e-300}])
def test_motions_that_end_early_say_so_as_by_xla(options):
    ours, theirs = _motions(jj.models.TiltingDisc(), t1=3.0, **options)
    assert int(ours.result) == int(theirs.result) != 0
    assert (int(ours.accepted), int(ours.rejected)) == (int(theirs.accepted), int(theirs.rejected))


@pytest.fixture(scope="module", params=[None, 8], ids=["Tsit5", "Taylor"])
def disc_kernel(request):
    """A kernel of the disc, and rows of a hundred lanes: some fall, one begins beyond the event, one is NaN, one infinite."""
    scene = jj.models.TiltingDisc()
    setup = set_up(scene, t1=1.0)
    form = Form(setup.field.lowered, False, False, True, True, False)
    lean = np.linspace(0.0, 1.5, 100)
    lean[[3, 40, 77]] = 1.7, np.nan, np.inf
    kernel = kernels.kernel(form, TSIT5, request.param)
    layout, fixed = kernel.layout, setup.field.lowered.fixed_values(scene)
    starts = np.zeros((100, layout.given))
    starts[:, 3], starts[:, 5:8] = lean, np.stack([0.5 + lean, 0.2 + np.zeros(100), -3 + 2 * lean], axis=1)
    progress = {"h": 1e-4, "code": -1, "event": -1, "pivot": np.inf, "direction": 1, "last_goal": 1.0, "rtol": 1e-6, "atol": 1e-6}
    for name, value in (progress | {"shortest": 1e-14, "longest": 0.1, "max_steps": 1000}).items():
        starts[:, layout.rows[name].start] = value
    starts[:, layout.rows["known"].start : layout.rows["known"].stop] = fixed
    return kernel, request.param, jnp.asarray(starts), jnp.broadcast_to(jnp.linspace(0.0, 1.0, 5), (100, 5))


def test_a_lane_does_not_depend_on_its_company(disc_kernel):
    kernel, _, starts, goals = disc_kernel
    many = jax.jit(jax.vmap(kernel.run))
    states, ends = (np.asarray(x) for x in many(starts, goals))
    assert set(ends[:, kernel.layout.rows["code"].start]) >= {-1.0, 1.0}
    for count in (1, 7, 9, 64):
        order = np.random.default_rng(count).permutation(100)[:count]
        for found, expected in zip(many(starts[order], goals[order]), (states, ends), strict=True):
            assert_array_equal(found, expected[order])
    for lane in (0, 3, 40, 77, 99):  # alone, in narrow registers
        for found, expected in zip(jax.jit(kernel.run)(starts[lane], goals[lane]), (states, ends), strict=True):
            assert_array_equal(found, expected[lane])


@pytest.mark.parametrize("threads", [1, 2, 5])
def test_a_lane_does_not_depend_on_the_number_of_threads(disc_kernel, threads, monkeypatch):
    usual, order, starts, goals = disc_kernel
    starts, goals = jnp.tile(starts, (13, 1)), jnp.tile(goals, (13, 1))
    kernels.kernel.cache_clear()
    monkeypatch.setattr(host, "threads", lambda: threads)
    other = kernels.kernel(usual.form, TSIT5, order)
    assert other is not usual
    for found, expected in zip(jax.vmap(other.run)(starts, goals), jax.vmap(usual.run)(starts, goals), strict=True):
        assert_array_equal(found, expected)


def test_no_bit_depends_on_the_effort_spent_on_machine_code(disc_kernel, monkeypatch):
    """What `conftest.py` takes for granted: tests run code made with little effort, users run code made with more."""
    usual, order, starts, goals = disc_kernel
    expected = jax.vmap(usual.run)(starts, goals)
    names, much = {}, functools.cache(ffi.registered.__wrapped__)
    monkeypatch.setattr(host, "EFFORT", 2)
    monkeypatch.setattr(ffi, "registered", lambda *asked: names.setdefault(asked, much(*asked)))
    kernels.kernel.cache_clear()
    for found, by_little in zip(jax.vmap(kernels.kernel(usual.form, TSIT5, order).run)(starts, goals), expected, strict=True):
        assert_array_equal(found, by_little)
    monkeypatch.undo()
    assert names
    assert all(ffi.registered(*asked) != name for asked, name in names.items())


def test_no_lanes_and_axes_of_lanes(disc_kernel):
    kernel, _, starts, goals = disc_kernel
    states, ends = jax.vmap(kernel.run)(starts[:0], goals[:0])
    assert states.shape == (0, 5, kernel.layout.y)
    assert len(ends) == 0
    twice = jax.vmap(jax.vmap(kernel.run), in_axes=(0, None))(starts[:6].reshape(2, 3, -1), goals[:3])
    once = jax.vmap(kernel.run)(starts[:6], goals[:6])
    for a, b in zip(twice, once, strict=True):
        assert_array_equal(a.reshape(b.shape), b)


def test_lanes_of_a_rollout_are_those_of_xla():
    disc = jj.models.TiltingDisc()
    starts = {"lean": jnp.asarray([0.1, 0.3, jnp.nan, 1.2, 0.2, 0.7, 0.0, 0.5, -0.4]), "spin_rate": jnp.linspace(-4.0, 0.0, 9)}
    ours, theirs = (jj.rollout(disc, starts, ts=[0.5, 1.0], backend=backend) for backend in ("native", "xla"))
    assert_array_equal(ours.result, theirs.result)
    assert_array_equal(ours.lanes.accepted, theirs.lanes.accepted)
    assert_array_equal(ours.lanes.rejected, theirs.lanes.rejected)
    assert_allclose(ours.lanes.q_end, theirs.lanes.q_end, rtol=1e-10, atol=1e-10)


def test_it_is_said_why_machine_code_is_not_taken(monkeypatch):
    disc, board = jj.models.TiltingDisc(), jj.models.Snakeboard()
    assert set_up(disc).reason_against_machine_code == ""
    assert set_up(disc, backend="xla").reason_against_machine_code == "another backend was asked for"
    assert "diffrax" in set_up(disc, solver=diffrax.Heun()).reason_against_machine_code
    assert "scalar program" in set_up(disc, formulation=jj.Formulation(reduction="kkt")).reason_against_machine_code
    assert set_up(board, inputs={"steer_torque": lambda t: jnp.sin(t)}).reason_against_machine_code == ""
    with_its_own_rule = set_up(board, inputs={"steer_torque": lambda t: jax.nn.softplus(t)})
    assert "without scalar form" in with_its_own_rule.reason_against_machine_code
    monkeypatch.setattr(host, "reason_against", lambda: "llvmlite is not installed")
    assert set_up(disc).reason_against_machine_code == "llvmlite is not installed"
    monkeypatch.setattr(host, "reason_against", lambda: "")
    ffi.version.cache_clear()
    monkeypatch.setattr(jax.ffi, "include_dir", lambda: "/nowhere")
    with pytest.warns(UserWarning, match="interface of this jaxlib is not known"):
        assert "interface" in set_up(disc).reason_against_machine_code
    ffi.version.cache_clear()


@pytest.mark.parametrize(
    ("old", "new"),
    [("API_MAJOR 0", "API_MAJOR 1"), ("API_MINOR", "API_LESSER"), ("void** args;", "void** args; int more;"), ("int64_t* dims;", "int64_t* sizes;")],
)
def test_an_interface_with_another_layout_is_not_known(old, new, tmp_path, monkeypatch):
    header = Path(jax.ffi.include_dir(), "xla/ffi/api/c_api.h").read_text()
    assert ffi._stated_version() is not None
    assert old in header
    changed = tmp_path / "xla/ffi/api/c_api.h"
    changed.parent.mkdir(parents=True)
    changed.write_text(header.replace(old, new))
    monkeypatch.setattr(jax.ffi, "include_dir", lambda: str(tmp_path))
    assert ffi._stated_version() is None


def test_a_scene_is_integrated_without_llvmlite(monkeypatch):
    class Sleigh(jj.models.ChaplyginSleigh):
        """One that nothing was compiled for."""

    scene = Sleigh()
    expected = jj.simulate(jj.models.ChaplyginSleigh(), ts=[1.3, 1.4]).q[0]
    monkeypatch.setattr(host, "reason_against", lambda: "llvmlite is not installed")
    assert_allclose(jj.simulate(scene, ts=[1.3, 1.4]).q[0], expected, rtol=1e-7)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"backend": "native", "solver": diffrax.Heun()}, "'native' cannot integrate `TiltingDisc`: the solver is"),
        ({"backend": "native", "formulation": jj.Formulation(reduction="kkt")}, "'native' cannot integrate `TiltingDisc`: a reduction"),
        ({"backend": "xla", "formulation": jj.Formulation(reduction="kkt")}, "'xla' cannot integrate `TiltingDisc`: a reduction"),
        ({"backend": "nativ"}, "unknown backend `nativ`.*native"),
    ],
)
def test_a_backend_that_cannot_serve_is_refused_with_the_reason(options, said):
    with pytest.raises(ValueError, match=said):
        jj.simulate(jj.models.TiltingDisc(), t1=0.1, **options)
    with pytest.raises(ValueError, match=said):
        jj.rollout(jj.models.TiltingDisc(), {"lean": np.array([0.1, 0.2])}, t1=0.1, **options)


class Stiff(jj.Scene):
    coordinates = jj.coordinates("x", "y")

    def bodies(self, t, q):
        return {"particle": jj.Particle(1.0, jnp.stack([q.x, q.y, 0.0 * q.x]))}

    def loads(self, motion):
        q, u = motion.q, motion.u
        return (jj.generalized_force(motion, x_rate=-1e6 * (q.x - jnp.sin(q.y)) - 1e6 * u.x_rate, y_rate=-1.0),)


def test_a_stiff_motion_stays_with_the_backend_that_was_asked_for():
    native, default = (jj.simulate(Stiff(), {"y": 1.0, "x": 0.8}, ts=[1.0], max_steps=1000, backend=backend, retry=True) for backend in ("native", "auto"))
    assert (native.result, native.fallback) == (results.MAX_STEPS, results.AS_ASKED)
    assert (default.result, default.fallback) == (results.SUCCESS, results.IMPLICIT)
