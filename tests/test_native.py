"""Machine code of our own against the same by XLA: rates, motions, derivatives, and when it is not taken."""

from pathlib import Path

import diffrax
import jax
import jax.numpy as jnp
import machine_code
import numpy as np
import pytest
import result_codes as results
from numpy.testing import assert_allclose, assert_array_equal

import jourdain_jax as jj
from jourdain_jax.integrate.loop import loop_function as kernels
from jourdain_jax.kernels import ffi, host
from jourdain_jax.motion.simulate import set_up

pytestmark = machine_code.needed


DISC = jj.models.TiltingDisc()
LEAN = np.linspace(0.0, 1.5, 100)
LEAN[[3, 40, 77]] = 1.7, np.nan, np.inf  # some fall, one begins beyond the event


def ended(lean):
    """What a disc is seen to do."""
    start = {"lean": lean, "yaw_rate": 0.5 + lean, "lean_rate": 0.2, "spin_rate": -3 + 2 * lean}
    motion = jj.simulate(DISC, start, ts=jnp.linspace(0.0, 1.0, 5), rtol=1e-6, atol=1e-6, max_steps=1000)
    return motion.q, motion.u_end, motion.t_end, motion.result


def test_a_lane_does_not_depend_on_its_company():
    alone, many = jax.jit(ended), jax.jit(jax.vmap(ended))
    expected = [np.asarray(x) for x in many(LEAN)]
    assert {results.SUCCESS, results.EVENT, results.BAD_START} <= set(expected[-1].tolist())
    for count in (1, 9):
        order = np.random.default_rng(count).permutation(100)[:count]
        for found, of_all in zip(many(LEAN[order]), expected, strict=True):
            assert_array_equal(found, of_all[order])
    for lane in (0, 3, 40, 77, 99):  # in narrow registers
        for found, of_all in zip(alone(LEAN[lane]), expected, strict=True):
            assert_array_equal(found, of_all[lane])
    assert [x.shape for x in many(LEAN[:0])] == [(0, *x.shape[1:]) for x in expected]
    for found, of_all in zip(jax.vmap(many)(LEAN[:6].reshape(2, 3)), expected, strict=True):
        assert_array_equal(np.reshape(found, (6, *of_all.shape[1:])), of_all[:6])


def test_no_bit_depends_on_the_effort_spent_on_machine_code_or_the_number_of_threads(monkeypatch):
    """Of effort, what `conftest.py` takes for granted: tests run code made with little, users run code made
    with more.
    """
    leans, lanes = jnp.tile(LEAN, 13), jax.jit(jax.vmap(ended))
    expected = lanes(leans)
    for effort, threads in ((0, 1), (2, 5)):
        monkeypatch.setattr(host, "EFFORT", effort)
        monkeypatch.setattr(host, "threads", lambda threads=threads: threads)
        kernels.kernel.cache_clear()
        jax.clear_caches()
        for found, usual in zip(lanes(leans), expected, strict=True):
            assert_array_equal(found, usual)
        assert kernels.kernel.cache_info().currsize > 0


def test_lanes_of_a_rollout_are_those_of_xla_step_by_step():
    starts = {
        "lean": jnp.asarray([0.1, 0.3, jnp.nan, 1.2, 0.2, 0.7, 0.0, 0.5, -0.4]),
        "spin_rate": jnp.linspace(-4.0, 0.0, 9),
    }
    by_both = [
        jj.rollout(DISC, starts, ts=[0.5, 1.0], backend=backend).lanes for backend in ("native", "xla")
    ]
    for name in ("result", "accepted", "rejected"):
        assert_array_equal(*(getattr(lanes, name) for lanes in by_both))
    assert_allclose(*(lanes.q_end for lanes in by_both), rtol=1e-10, atol=1e-10)
    for name in ("q", "u", "u_end", "t_end", "smallest_pivot"):
        good = (getattr(lanes, name)[lanes.result == results.SUCCESS] for lanes in by_both)
        assert_allclose(*good, rtol=1e-10, atol=1e-10)


def test_it_is_said_why_machine_code_is_not_taken(monkeypatch):
    said = lambda scene=DISC, **options: set_up(scene, **options).reason_against_machine_code
    assert said() == ""
    assert said(backend="xla") == "another backend was requested"
    assert "diffrax" in said(solver=diffrax.Heun())
    assert "scalar program" in said(formulation=jj.Formulation(reduction="kkt"))
    board = jj.models.Snakeboard()
    assert said(board, inputs={"steer_torque": lambda t: jnp.sin(t)}) == ""
    assert "without scalar form" in said(board, inputs={"steer_torque": lambda t: jax.nn.softplus(t)})
    monkeypatch.setattr(host, "reason_against", lambda: "llvmlite is not installed")
    assert said() == "llvmlite is not installed"
    monkeypatch.setattr(host, "reason_against", lambda: "")
    ffi.version.cache_clear()
    monkeypatch.setattr(jax.ffi, "include_dir", lambda: "/nowhere")
    with pytest.warns(UserWarning, match="this jaxlib has an unknown foreign function interface"):
        assert "interface" in said()
    ffi.version.cache_clear()


def test_an_interface_with_another_layout_is_not_known(tmp_path, monkeypatch):
    header = Path(jax.ffi.include_dir(), "xla/ffi/api/c_api.h").read_text()
    assert ffi._stated_version() is not None
    changed = tmp_path / "xla/ffi/api/c_api.h"
    changed.parent.mkdir(parents=True)
    monkeypatch.setattr(jax.ffi, "include_dir", lambda: str(tmp_path))
    for old, new in {
        "API_MAJOR 0": "API_MAJOR 1",
        "API_MINOR": "API_LESSER",
        "void** args;": "void** args; int more;",
        "int64_t* dims;": "int64_t* sizes;",
        "(XLA_FFI_Stream_Get)": "(XLA_FFI_Lost)",
        "(XLA_FFI_DeviceMemory_Free)": "(XLA_FFI_Lost)",
    }.items():
        assert old in header
        changed.write_text(header.replace(old, new))
        assert ffi._stated_version() is None, old


def test_a_scene_is_integrated_without_llvmlite(monkeypatch):
    class Sleigh(jj.models.ChaplyginSleigh):
        """One that nothing was compiled for."""

    scene = Sleigh()
    expected = jj.simulate(jj.models.ChaplyginSleigh(), ts=[1.3, 1.4]).q[0]
    monkeypatch.setattr(host, "reason_against", lambda: "llvmlite is not installed")
    assert_allclose(jj.simulate(scene, ts=[1.3, 1.4]).q[0], expected, rtol=1e-7)
