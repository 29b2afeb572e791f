"""Kernels of GPUs, checked without one: their twins give the bits of machine code, and their handler serves frames as XLA makes them."""

import ctypes
import re

import gpu_twin
import jax
import numpy as np
import pytest
from ends_of_models import end_of_model

import jourdain_jax as jj
from jourdain_jax.motion.native.layout import MachineWriter
from jourdain_jax.native import ffi, gpu, host, nvidia
from jourdain_jax.native.ffi import write_rows
from jourdain_jax.scene.parameters import parameters_of

# Kernels of GPUs, checked without one: their twins on the CPU give the bits of machine code in wide registers, and their text is one for NVIDIA's


pytestmark = pytest.mark.skipif(bool(ffi.reason_against() or nvidia.reason_against_text()), reason="no machine code is made here")
ARCHITECTURES = ("sm_75", "sm_80", "sm_90", "sm_100")
KINDS = {"values": lambda f: f, "tangents": jax.jacfwd, "gradients": jax.grad, "second": jax.hessian}


def _numbers(name: str, kinds, **options) -> dict[str, np.ndarray]:
    """Numbers made of five motions of a model, and their derivatives with respect to a parameter and two directions of the start."""
    scene = jj.models.MODELS[name]()
    scalars = [p for p, value, _ in parameters_of(scene) if np.ndim(value) == 0][:1]
    end, x = end_of_model(name, None, scalars, ts=[0.1, 0.2], **options)
    lanes = x + 1e-3 * np.arange(5.0)[:, None]
    return {kind: np.asarray(jax.jit(jax.vmap(KINDS[kind](end)))(lanes)) for kind in kinds}


def _check(name: str, kinds, orders, **options) -> list[str]:
    expected, texts = _numbers(name, kinds, **options), []
    for order, slots in orders:
        with gpu_twin.by_twins(order, slots) as made:
            for kind, found in _numbers(name, kinds, **options).items():
                np.testing.assert_array_equal(found, expected[kind], err_msg=f"{name}, {kind}, threads {order}")
        texts += made
    return texts


def _check_text(texts, architectures) -> None:
    for text in texts:
        for architecture in architectures:
            ptx = nvidia.text_for(text, architecture)
            assert f".target {architecture}" in ptx
            assert not re.findall(r"^\.extern.*", ptx, re.M)


def test_threads_of_a_gpu_give_the_bits_of_wide_registers():
    texts = _check("chaplygin-sleigh", ["values", "gradients"], [("reversed", 5)])
    assert len(texts) > 2
    _check_text(texts[:1], ARCHITECTURES)


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(jj.models.MODELS))
def test_threads_of_a_gpu_give_the_bits_of_wide_registers_for_every_model(name):
    texts = _check(name, ["values", "tangents", "gradients"], [("in order", 64), ("reversed", 5), ("at once", 9)])
    _check_text(texts, ARCHITECTURES)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["tilting-disc", "chaplygin-sleigh", "double-pendulum-rods"])
def test_second_derivatives_and_series_too(name):
    _check(name, ["values", "second"], [("at once", 9)])
    _check(name, ["values", "tangents"], [("reversed", 9)], solver=jj.Taylor())


# The handler that puts kernels of GPUs into XLA's stream: a frame made by hand, and a driver that runs their twins.


NUMBER = 77


def _write_doubled(w: MachineWriter) -> None:
    with w.function("row", "void", {"state": "ptr", "found": "ptr"}) as (state, found):
        for k in range(2):
            w.store(w.load(state, k) * 2.0, found, k)
        w.give()
    write_rows(w, 2, 2)


def _words(*values) -> ctypes.Array:
    return (ctypes.c_uint64 * len(values))(*values)


class Frame:
    """A call as XLA makes it, for a kernel of one argument and one result."""

    def __init__(self, rows: np.ndarray) -> None:
        self.results = np.full(rows.shape, np.nan), np.zeros(ffi.FIRST_OF_SCRATCH)
        self.messages: list[tuple[bytes, int]] = []
        buffers = []
        for x in (rows, *self.results):
            sizes = _words(*x.shape)
            buffers.append(_words(0, 0, 12, x.ctypes.data, x.ndim, ctypes.addressof(sizes)))
            buffers[-1].sizes = sizes
        lists = [_words(*map(ctypes.addressof, part)) for part in (buffers[:1], buffers[1:])]
        numbers = [_words(1), _words(NUMBER)]  # blocks, kernel
        scalars = [_words(9, ctypes.addressof(x)) for x in numbers]
        attributes = _words(*map(ctypes.addressof, scalars))

        @ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.POINTER(ctypes.c_uint64))
        def stream_get(asked):
            assert (asked[0], asked[2]) == (32, 55)
            asked[3] = 99
            return None

        @ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.POINTER(ctypes.c_uint64))
        def error_create(given):
            self.messages.append((ctypes.string_at(given[2]), given[3] & 0xFFFFFFFF))
            return 1234

        functions = [ctypes.cast(f, ctypes.c_void_p).value for f in (error_create, stream_get)]
        api = _words(0, 0, 0, 0, 0, 0, functions[0], 0, 0, 0, functions[1])
        list_of = [0, 0, 1, 0, ctypes.addressof(lists[0]), 0, 0, 2, 0, ctypes.addressof(lists[1])]
        self.frame = _words(0, 0, ctypes.addressof(api), 55, 3, *list_of, 0, 0, 2, 0, 0, ctypes.addressof(attributes), 0)
        self.kept = buffers, lists, numbers, scalars, attributes, stream_get, error_create, api


def _handler(fails: int, kernel: int):
    table = _words(5, 1, NUMBER, kernel)
    for name, address in gpu_twin.stub_driver(fails).items():
        host.llvm.add_symbol(name, address)
    host.llvm.add_symbol("jourdain_jax_kernels", ctypes.addressof(table))
    text = gpu.handler_text()
    run = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.c_void_p)(host.address(host.object_code(text, 2), ffi.HANDLER))
    run.table = table
    return run


def _twin() -> int:
    w = MachineWriter(1, True, device=True)
    _write_doubled(w)
    return host.address(host.object_code(gpu_twin.twin_text(w.text), 2), "run")


def test_a_call_returns_what_the_kernel_gives():
    frame = Frame(np.arange(10.0).reshape(5, 2))
    run = _handler(0, _twin())
    assert run(ctypes.addressof(frame.frame)) is None
    np.testing.assert_array_equal(frame.results[0], 2 * np.arange(10.0).reshape(5, 2))


def test_what_the_driver_refuses_is_an_error_of_xla_with_the_drivers_text():
    frame = Frame(np.zeros((5, 2)))
    assert _handler(2, _twin())(ctypes.addressof(frame.frame)) == 1234
    assert frame.messages == [(b"out of memory", 8)]
    frame = Frame(np.zeros((5, 2)))
    assert _handler(700, _twin())(ctypes.addressof(frame.frame)) == 1234
    assert frame.messages == [(b"out of memory", 13)]


def test_the_version_of_the_interface_is_told():
    metadata = (ctypes.c_uint32 * 10)()
    extension = _words(0, 1, 0, ctypes.addressof(metadata))
    frame = _words(0, ctypes.addressof(extension), *[0] * 20)
    assert _handler(0, 0)(ctypes.addressof(frame)) is None
    assert tuple(metadata[6:8]) == ffi.version()
