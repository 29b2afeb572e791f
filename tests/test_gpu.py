"""Kernels of GPUs, checked without one: programs are lowered as for a GPU, and a driver runs the kernels'
text on the CPU; their bits are machine code's.
"""

import os
import re
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from unittest import mock

import gpu_twin
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from ends_of_models import end_of_model
from numpy.testing import assert_array_equal
from test_modes import NUMBERS, seen

import jourdain_jax as jj
from jourdain_jax.kernels import ffi, gpu, nvidia
from jourdain_jax.scene.coordinates import parameters_of
from jourdain_jax.studies import Design, LogNormal, LogUniform, Normal, Uniform

pytestmark = pytest.mark.skipif(
    bool(ffi.reason_against() or nvidia.reason_against_text()), reason="no machine code is made here"
)
ARCHITECTURES = ("sm_75", "sm_80", "sm_90", "sm_100")
KINDS = {"values": lambda f: f, "tangents": jax.jacfwd, "gradients": jax.grad, "second": jax.hessian}


def _numbers(name, kinds, **options):
    """Numbers made of five motions of a model, and their derivatives with respect to a parameter and two
    directions of the start.
    """
    scene = jj.models.MODELS[name]()
    scalars = [p for p, value, _ in parameters_of(scene) if np.ndim(value) == 0][:1]
    end, x = end_of_model(name, None, scalars, ts=[0.1, 0.2], **options)
    lanes = x + 1e-3 * np.arange(5.0)[:, None]
    return {kind: np.asarray(jax.jit(jax.vmap(KINDS[kind](end)))(lanes)) for kind in kinds}


FEW = (
    2**19  # bytes of a device, an eighth of which is for the steps of all its motions
)


def _check(name, kinds, orders, **options):
    expected, texts = _numbers(name, kinds, **options), set[str]()
    for order, memory in orders:
        with gpu_twin.in_place_of_a_gpu(order, memory) as made:
            for kind, found in _numbers(name, kinds, **options).items():
                assert_array_equal(found, expected[kind], err_msg=f"{name}, {kind}, threads {order}")
        texts.update(made)
    return texts


def _check_text(texts, architectures):
    for text in texts:
        for architecture in architectures:
            ptx = nvidia.text_for(text, architecture)
            assert f".target {architecture}" in ptx
            assert not re.findall(r"^\.extern.*", ptx, re.M)
            if architecture == "sm_90":
                gpu_twin.said_by_assembler(ptx)  # refuses what is wrong


@pytest.mark.parametrize(
    ("name", "kind"),
    [("chaplygin-sleigh", "gradients"), ("tilting-disc", "values"), ("double-pendulum-rods", "values")],
)
def test_threads_of_a_gpu_give_the_bits_of_wide_registers(name, kind):
    texts = _check(name, [kind], [("reversed", FEW)])
    assert len(texts) > 2
    _check_text([max(texts, key=len)], ["sm_75"])


@pytest.mark.parametrize("name", sorted(jj.models.MODELS))
def test_threads_of_a_gpu_give_the_bits_of_wide_registers_for_every_model(name):
    texts = _check(
        name, ["values", "tangents", "gradients"], [("in order", 2**40), ("reversed", FEW), ("at once", FEW)]
    )
    _check_text(texts, ARCHITECTURES)


@pytest.mark.parametrize("name", sorted(jj.models.MODELS))
def test_second_derivatives_too(name):
    _check(name, ["second"], [("at once", FEW)])


@pytest.mark.parametrize("name", ["tilting-disc", "chaplygin-sleigh", "double-pendulum-rods"])
def test_series_too(name):
    _check(name, ["values", "tangents"], [("reversed", FEW)], solver=jj.Taylor())


@pytest.mark.parametrize("kind", KINDS)
def test_events_after_which_a_motion_goes_on(kind):
    def made():
        of = KINDS[kind](lambda numbers: jnp.sum(jnp.nan_to_num(seen(numbers))))
        return np.asarray(jax.jit(jax.vmap(of))(NUMBERS * jnp.linspace(0.9, 1.1, 5)[:, None]))

    expected = made()
    for order, memory in (("in order", 2**40), ("at once", FEW)):
        with gpu_twin.in_place_of_a_gpu(order, memory):
            assert_array_equal(made(), expected)


# What happens where the driver refuses.


SLEIGH = jj.models.ChaplyginSleigh()


def _end(speed, model=SLEIGH):
    return jj.simulate(model, {"x_rate": speed, "heading_rate": 0.3}, ts=[0.1]).q_end


def test_lanes_come_last_and_what_they_share_is_given_once():
    with gpu_twin.in_place_of_a_gpu():
        text = (
            jax.jit(jax.vmap(jax.grad(lambda speed: _end(speed)[0])))
            .lower(np.linspace(0.4, 0.6, 7))
            .as_text()
        )
    calls = [*re.findall(r"operand_layouts = (.*), result_layouts = (.*)} : \((.*)\) -> \((.*)\)\n", text)]
    forth, back = (next(call for call in calls if call[2].count(",") == count) for count in (2, 5))
    # starts of 7 lanes, what they share, times; states of 2 times and ends
    assert re.fullmatch(r"tensor<7x\d+xf64>, tensor<\d\d+xf64>, tensor<2xf64>", forth[2])
    assert forth[:2] == (
        "[dense<[0, 1]> : tensor<2xindex>, dense<0> : tensor<1xindex>, dense<0> : tensor<1xindex>]",
        "[dense<[0, 2, 1]> : tensor<3xindex>, dense<[0, 1]> : tensor<2xindex>, dense<0> : tensor<1xindex>]",
    )
    # projection of the start, its derivative, and energies of three states: only a speed or a state differs
    small = {call[2] for call in calls if call not in (forth, back)}
    assert {(7, 3, 11), (7, 3, 7), (7, 3, 6, 5)} <= {
        tuple(map(int, re.findall(r"\d+(?=x)", x))) for x in small
    }
    # the same, cotangents of states and ends, times, and the largest number of trial steps
    assert re.fullmatch(
        r"tensor<7x\d+xf64>, tensor<\d\d+xf64>, tensor<7x2x\d+xf64>, tensor<7x\d+xf64>, tensor<2xf64>,"
        r" tensor<1xf64>",
        back[2],
    )


def test_no_lanes_are_no_call_that_fails():
    of = jax.value_and_grad(lambda speed: _end(speed)[0])
    with gpu_twin.in_place_of_a_gpu():
        for found in jax.jit(jax.vmap(of))(np.zeros(0)):
            assert np.asarray(found).shape == (0,)


REFUSED = [
    ("cuLaunchKernel", 2, "RESOURCE_EXHAUSTED: out of memory"),
    ("cuLaunchKernel", 1, "INTERNAL: invalid argument"),
    ("cuMemcpyDtoHAsync_v2", 1, "INTERNAL: invalid argument"),
    ("cuStreamSynchronize", 400, "INTERNAL: invalid resource handle"),
    ("DeviceMemory_Allocate", 8, "RESOURCE_EXHAUSTED: no memory for a record"),
]


def test_what_the_driver_refuses_is_an_error_of_xla_with_the_drivers_text():
    of, speeds = jax.vmap(jax.grad(lambda speed: _end(speed)[0])), np.linspace(0.4, 0.6, 3)
    expected = jax.jit(of)(speeds)
    with gpu_twin.in_place_of_a_gpu() as launched:
        run = jax.jit(of)
        for function, code, said in REFUSED:
            launched.clear()
            with (
                mock.patch.dict(gpu_twin.DRIVER.fails, {function: code}),
                pytest.raises(jax.errors.JaxRuntimeError, match=said),
            ):
                jax.block_until_ready(run(speeds))
            assert not any("@step_back(" in text for text in launched)
            assert_array_equal(run(speeds), expected)  # all goes on


def test_a_kernel_that_this_process_has_not_loaded_is_an_error():
    with (
        gpu_twin.in_place_of_a_gpu(),
        mock.patch.object(gpu.Kernel, "name", "jourdain_jax_5"),
        pytest.raises(jax.errors.JaxRuntimeError, match="jourdain_jax_5"),
    ):
        jax.jit(_end)(0.4)


def test_the_record_has_a_slot_for_each_step_and_keeps_to_the_memory_of_the_model():
    speeds = np.geomspace(0.4, 4_000.0, 100)
    found = jax.vmap(lambda speed: jj.simulate(SLEIGH, {"x_rate": speed, "heading_rate": 0.3}, ts=[0.1]))(
        speeds
    )
    tries = int(np.max(found.accepted + found.rejected))
    assert tries > int(np.min(found.accepted + found.rejected))
    with gpu_twin.in_place_of_a_gpu():
        for memory, all_fit in ((10**9, True), (10**6, False)):
            model, gpu_twin.DRIVER.largest = jj.build(SLEIGH, memory=memory), 0
            run = jax.jit(jax.vmap(jax.grad(lambda speed, model=model: _end(speed, model)[0])))
            said = [
                *re.findall(r"most_slots = (\d+) : i64, slot = ([1-9]\d*) : i64", run.lower(speeds).as_text())
            ]
            ((most, slot),) = {(int(most), int(slot)) for most, slot in said}
            jax.block_until_ready(run(speeds))
            assert gpu_twin.DRIVER.largest == slot * min(tries, most)
            assert (tries <= most) == all_fit
            assert 0.9 * memory < slot * most <= memory


def _reason(monkeypatch, uses=(0,), **library):
    devices = [SimpleNamespace(local_hardware_id=number) for number in uses]
    monkeypatch.setattr(jax, "local_devices", lambda backend: devices)
    monkeypatch.setattr(nvidia, "driver", lambda: gpu_twin.driver_of_devices(**library))
    return nvidia.reason_against.__wrapped__()


def test_without_a_gpu_that_serves_it_is_said_why(monkeypatch):
    assert not _reason(monkeypatch, (0, 1), capabilities=[(9, 0), (7, 5)])
    assert nvidia.architecture() == "sm_75"
    assert "compute capability 7.5" in _reason(monkeypatch, (0, 1), capabilities=[(9, 0), (7, 0)])
    assert "no CUDA-capable device" in _reason(monkeypatch, capabilities=[], fails=100)
    assert "older than CUDA 12" in _reason(monkeypatch, capabilities=[], missing="cuLibraryLoadData")
    monkeypatch.setattr(nvidia, "driver", mock.Mock(side_effect=OSError("libcuda.so.1: no such file")))
    assert "libcuda.so.1" in nvidia.reason_against.__wrapped__()


def test_gpus_that_jax_does_not_use_are_left_alone(monkeypatch):
    """Nothing follows from them, and the driver sets nothing up there."""
    assert not _reason(monkeypatch, (1,), capabilities=[(7, 0), (9, 0)])
    assert nvidia.architecture() == "sm_90"
    asked = []

    def says(name):
        return lambda *given: asked.append((name, given)) or 0

    names = [name for name in nvidia._CALLED if name not in nvidia.CALLED_BY_HANDLER]
    monkeypatch.setattr(nvidia, "driver", lambda: SimpleNamespace(**{name: says(name) for name in names}))
    nvidia.loaded(b"", "kernel")
    devices = {name: given[-1] for name, given in asked if "Retain" in name or "Attribute" in name}
    assert devices == {"cuDevicePrimaryCtxRetain": 1, "cuKernelGetAttribute": 1}


def test_a_model_says_on_which_devices_it_is_integrated():
    told = {"": "machine code: CPU; NVIDIA GPU (sm_90 on the CPU)", "no driver": "XLA: no driver"}
    with gpu_twin.in_place_of_a_gpu():
        for reason, said in told.items():
            with mock.patch.object(nvidia, "reason_against", lambda reason=reason: reason):
                assert said in str(jj.build(jj.models.ChaplyginSleigh()))


@pytest.mark.parametrize("sampler", ["random", "latin-hypercube", "sobol", "saltelli"])
def test_samples_drawn_on_a_device_have_the_bits_of_the_host(sampler):
    kinds = {
        "a": Normal(2.0, 0.7),
        "b": Uniform(-1.0, 3.3),
        "c": LogNormal(2.0, 0.4),
        "d": LogUniform(0.01, 30.0),
    }
    correlation = None if sampler == "saltelli" else {("a", "b"): 0.6, ("b", "c"): -0.3, ("a", "d"): 0.5}
    # XLA for CPUs, as these tests ask for it, refuses loops over many numbers, by which the hypercube is
    # walked
    count = 402 if sampler == "latin-hypercube" else 40_002
    design = Design(kinds, sampler=sampler, samples=count, seed=2**62 + 11, correlation=correlation)
    found = design._at(np.arange(7, count), on_device=True)
    for name, column in design.values(7, count).items():
        assert isinstance(found[name], jax.Array)
        assert_array_equal(found[name], column)


def test_many_lanes_run_at_once_on_a_gpu():
    scene = jj.models.ChaplyginSleigh()
    with gpu_twin.in_place_of_a_gpu() as launched:
        jj.rollout(scene, {"x_rate": np.ones(1000)}, ts=[0.1])
        assert min(launched.values()) == 1
        assert (
            jj.Study(scene, start={"x_rate": Uniform(0.4, 0.6)}, samples=20_000).task(t1=0.1).block == 2**15
        )


OF_TWO_DEVICES = """
import gpu_twin, jax, numpy as np, jourdain_jax as jj

scene, lanes = jj.models.ChaplyginSleigh(), jax.sharding.PartitionSpec("lanes")
end = lambda speed: jj.simulate(scene, {"x_rate": speed}, ts=[0.1]).q_end[0]
one, speeds = jax.vmap(jax.value_and_grad(end)), np.linspace(0.4, 0.6, 6)
expected = jax.jit(one)(speeds)
mesh = jax.sharding.Mesh(np.array(jax.devices()), ("lanes",))
with gpu_twin.in_place_of_a_gpu() as launched:
    mass = jax.device_put(1.3, jax.devices()[1])
    chunks = jj.rollout(scene.replace(mass=mass), {"x_rate": speeds}, ts=[0.1], chunk=4).lanes
    assert chunks.q.devices() == {jax.devices()[1]}
    shared = jax.jit(jax.shard_map(one, mesh=mesh, in_specs=lanes, out_specs=lanes, check_vma=False))
    found = jax.block_until_ready(shared(speeds))
    second = jax.block_until_ready(jax.jit(one)(jax.device_put(speeds, jax.devices()[1])))
    assert (
        len(found[0].devices()) == 2 and second[0].devices() == {jax.devices()[1]} and 3 in launched.values()
    )
assert_array_equal(found, expected)
assert_array_equal(second, expected)
"""


def test_several_gpus_share_lanes():
    environment = os.environ | {
        "XLA_FLAGS": "--xla_force_host_platform_device_count=2",
        "PYTHONPATH": os.pathsep.join(sys.path),
    }
    subprocess.run(
        [sys.executable, "-c", OF_TWO_DEVICES], env=environment, cwd=Path(__file__).parent, check=True
    )
