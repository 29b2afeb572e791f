"""Kernels of GPUs without a GPU: the same LLVM IR compiled for the CPU, called once for each thread; and a driver that runs it."""

import ctypes
import functools
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import partial
from unittest import mock

import jax
import numpy as np
from jax.interpreters import mlir

from jourdain_jax.motion.native import values
from jourdain_jax.native import ffi, gpu, host, nvidia

THREADS = 4
_ENDS = """
declare i32 @pthread_setspecific(i32, ptr)
declare ptr @pthread_getspecific(i32)
define i1 @twin_together(i32 %mask, i1 %x) {
  ret i1 %x
}
define i32 @twin_number() {
  %x = call ptr @pthread_getspecific(i32 KEY)
  %n = ptrtoint ptr %x to i32
  ret i32 %n
}
define i32 @twin_zero() {
  ret i32 0
}
define i32 @twin_one() {
  ret i32 1
}
define i32 @twin_count() {
  ret i32 COUNT
}
define void @run(ptr %words, i32 %number) {
  %n = zext i32 %number to i64
  %x = inttoptr i64 %n to ptr
  call i32 @pthread_setspecific(i32 KEY, ptr %x)
  call void @kernel(ptr byval([64 x i64]) align 8 %words)
  ret void
}
"""
_NAMES = {"vote.any.sync": "together", "ctaid.x": "number", "tid.x": "zero", "nctaid.x": "count", "ntid.x": "one"}


@functools.cache
def _key() -> int:
    """Of what is a thread's own: its number."""
    key = ctypes.c_uint()
    assert ctypes.CDLL(None).pthread_key_create(ctypes.byref(key), None) == 0
    return key.value


def twin_text(text: str) -> str:
    """The kernel as a module for the CPU."""
    text = text.replace("ptx_kernel ", "")
    for name, ours in _NAMES.items():
        for prefix in ("llvm.nvvm.", "llvm.nvvm.read.ptx.sreg."):
            for result, arguments in (("i1", "i32, i1"), ("i32", "")):
                text = text.replace(f"declare {result} @{prefix}{name}({arguments})\n", "")
            text = text.replace(f"@{prefix}{name}(", f"@twin_{ours}(")
    return text + _ENDS.replace("COUNT", str(THREADS)).replace("KEY", str(_key())).replace("[64", f"[{ffi.WORDS * ffi.MOST_BUFFERS}")


class Twin:
    """The kernel's twin, as a function of arrays: from arguments and shapes of results to results."""

    def __init__(self, text: str, scratch: tuple[int, int]) -> None:
        self.scratch = scratch
        self.run = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_int)(host.address(host.object_code(twin_text(text), 2), "run"))

    def __call__(self, arguments, shapes, order: str, slots: int) -> list[np.ndarray]:
        """`slots`: of memory for the adjoint."""
        needed, most = self.scratch
        scratch = np.zeros(ffi.FIRST_OF_SCRATCH + THREADS * needed * min(slots, most))
        arrays = [*(np.ascontiguousarray(x, float) for x in arguments), *(np.full(shape, np.nan) for shape in shapes), scratch]
        words = np.zeros(ffi.WORDS * ffi.MOST_BUFFERS, np.int64)
        for k, x in enumerate(arrays):
            words[ffi.WORDS * k :][: ffi.WORDS] = x.ctypes.data, x.shape[-1], np.prod(x.shape[:-1]), np.prod(x.shape[:-3])
        threads = range(THREADS)
        if order == "at once":
            with ThreadPoolExecutor(THREADS) as pool:
                list(pool.map(lambda number: self.run(words.ctypes.data, number), threads))
        else:
            for number in threads if order == "in order" else reversed(threads):
                self.run(words.ctypes.data, number)
        return arrays[len(arguments) : -1]


@contextmanager
def by_twins(order: str = "in order", slots: int = 64):
    """Inside, machine code that JAX calls on the CPU is that of the twins; it is given a list of the text of each kernel."""
    texts: list[str] = []

    @functools.cache
    def made(kernel) -> Twin:
        def registered(text, scratch):
            texts.append(text)
            return gpu.Kernel(0, nvidia.Loaded(0, 0, 0), scratch)

        kernel.cache_clear()
        with mock.patch.object(gpu, "registered", registered):
            scratch = kernel().scratch
        kernel.cache_clear()
        return Twin(texts[-1], scratch)

    def lowered(ctx, *values, kernel, **_):
        shapes = [x.shape for x in ctx.avals_out]

        def run(*arguments):
            found = made(kernel)(arguments, shapes, order, slots)
            return [np.asarray(x, aval.dtype) for x, aval in zip(found, ctx.avals_out, strict=True)]

        results = [jax.ShapeDtypeStruct(x.shape, x.dtype) for x in ctx.avals_out]
        return mlir.lower_fun(lambda *values: jax.pure_callback(run, results, *values))(ctx, *values)

    register = partial(mlir.register_lowering, values._call_p, platform="cpu")
    jax.clear_caches()
    register(lowered)
    try:
        yield texts
    finally:
        register(values.on_cpu)
        jax.clear_caches()


_DRIVER = """
define i32 @cuMemsetD32Async(i64 %to, i32 %value, i64 %count, ptr %stream) {
  %at = inttoptr i64 %to to ptr
  store i64 0, ptr %at
  ret i32 FAILS
}
define i32 @cuGetErrorString(i32 %code, ptr %to) {
  store ptr @text, ptr %to
  ret i32 0
}
@text = constant [14 x i8] c"out of memory\\00"
define i32 @cuLaunchKernel(ptr %f, i32 %gx, i32 %gy, i32 %gz, i32 %bx, i32 %by, i32 %bz, i32 %shared, ptr %stream, ptr %parameters, ptr %extra) {
  %words = load ptr, ptr %parameters
  call void %f(ptr %words, i32 0)
  ret i32 0
}
"""


def stub_driver(fails: int = 0) -> dict[str, int]:
    """Addresses of functions of a driver that runs twins; `fails`: what clearing memory returns."""
    code = host.object_code(_DRIVER.replace("FAILS", str(fails)), 2)
    return {name: host.address(code, name) for name in ("cuMemsetD32Async", "cuLaunchKernel", "cuGetErrorString")}
