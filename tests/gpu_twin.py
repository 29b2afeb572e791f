"""A GPU that is not there: what JAX calls on one is called on the CPU, by the same lowering and handler; a
driver made here runs the kernels' LLVM IR, compiled for the CPU, once for each thread."""

import ctypes
import functools
import re
import shutil
import subprocess
import sys
from collections import Counter
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from types import MappingProxyType, SimpleNamespace
from unittest import mock

import jax
from jax.interpreters import mlir

from jourdain_jax.integrate.loop import value_kernels
from jourdain_jax.kernels import ffi, gpu, host, nvidia

_ENDS = """
declare i32 @pthread_setspecific(i32, ptr)
declare ptr @pthread_getspecific(i32)
define i1 @twin.vote.any.sync(i32 %mask, i1 %x) {
  ret i1 %x
}
define i32 @twin.ctaid.x() {
  %x = call ptr @pthread_getspecific(i32 KEY)
  %both = ptrtoint ptr %x to i64
  %n = trunc i64 %both to i32
  ret i32 %n
}
define i32 @twin.nctaid.x() {
  %x = call ptr @pthread_getspecific(i32 KEY)
  %both = ptrtoint ptr %x to i64
  %high = lshr i64 %both, 32
  %n = trunc i64 %high to i32
  ret i32 %n
}
define i32 @twin.tid.x() {
  ret i32 0
}
define i32 @twin.ntid.x() {
  ret i32 1
}
define void @run(ptr %words, ptr %number_and_count) {
  call i32 @pthread_setspecific(i32 KEY, ptr %number_and_count)
  call void @kernel(ptr byval([WORDS x i64]) align 8 %words)
  ret void
}
"""


@functools.cache
def _key():
    """Of what is a thread's own: its number, and how many there are."""
    key = ctypes.c_uint()
    assert ctypes.CDLL(None).pthread_key_create(ctypes.byref(key), None) == 0
    return key.value


def twin_text(text):
    """The kernel as a module for the CPU."""
    text = re.sub(r"declare .*llvm\.nvvm.*\n", "", text.replace("ptx_kernel ", ""))
    text = re.sub(r"@llvm\.nvvm\.(read\.ptx\.sreg\.)?", "@twin.", text)
    return text + _ENDS.replace("KEY", str(_key())).replace("WORDS", str(ffi.WORDS * ffi.MOST_BUFFERS))


_SAID = {
    1: b"invalid argument",
    2: b"out of memory",
    400: b"invalid resource handle",
}  # of values of `CUresult`
_C = ctypes.CFUNCTYPE
_int, _long, _pointer = ctypes.c_uint32, ctypes.c_uint64, ctypes.c_void_p


class Driver:
    """Those functions of `libcuda` that the handler calls, as they are declared in NVIDIA's `cuda.h`, and
    XLA's memory; `order`: of threads, `fails`: what one of them returns, by its name.
    """

    order: str = "in order"
    fails: Mapping[str, int] = MappingProxyType({})

    def __init__(self):
        self.loaded: list[str] = []
        self.launched = Counter[str]()
        self.twins: dict[int, int] = {}
        memset = _C(ctypes.c_int, _long, _int, ctypes.c_size_t, _pointer)
        launch = _C(ctypes.c_int, _pointer, *[_int] * 7, _pointer, ctypes.POINTER(_pointer), _pointer)
        error = _C(ctypes.c_int, ctypes.c_int, ctypes.POINTER(ctypes.c_char_p))
        copy = _C(ctypes.c_int, _pointer, _long, ctypes.c_size_t, _pointer)
        self.library = SimpleNamespace(
            cuMemsetD32Async=memset(self._memset),
            cuMemcpyDtoHAsync_v2=copy(self._copy),
            cuStreamSynchronize=_C(ctypes.c_int, _pointer)(
                lambda stream: self.fails.get("cuStreamSynchronize", int(stream != 99))
            ),
            cuLaunchKernel=launch(self._launch),
            cuGetErrorString=error(self._error),
        )
        # of XLA's interface: memory, of which it is told the size, and where it is put
        self.records: dict[int, ctypes.Array] = {}
        self.largest = 0
        words = ctypes.POINTER(_long)
        self.allocate, self.free = (_C(_pointer, words)(f) for f in (self._allocate, self._free))
        self.interface = (_pointer * 1)()  # XLA's own

    def _allocate(self, asked):
        size, alignment = asked[3:5]
        if "DeviceMemory_Allocate" in self.fails:
            text = ctypes.c_char_p(b"no memory for a record")
            given = (_long * 4)(28, 0, ctypes.cast(text, _pointer).value, self.fails["DeviceMemory_Allocate"])
            functions = ctypes.cast(self.interface[0], ctypes.POINTER(_pointer))
            return _C(_pointer, _pointer)(functions[6])(ctypes.addressof(given))
        if (asked[0], asked[1], alignment) != (48, 0, 16):
            return 1
        record = (ctypes.c_char * size)(*b"\xff" * size)  # what is not written is no number
        self.records[ctypes.addressof(record)], self.largest = record, max(size, self.largest)
        asked[5] = ctypes.addressof(record)
        return None

    def _free(self, asked):
        return None if len(self.records.pop(asked[4])) == asked[3] and asked[0] == 40 else 1

    def _copy(self, to, place, count, stream):
        ctypes.memmove(to, place, count)
        return self.fails.get("cuMemcpyDtoHAsync_v2", int(stream != 99))

    def _memset(self, place, value, count, stream):
        ctypes.memmove(place, (_int * count)(*[value] * count), 4 * count)
        return 0

    def _launch(
        self, function, across, y, z, threads, threads_y, threads_z, shared, stream, parameters, extra
    ):
        if (y, z, threads, threads_y, threads_z, shared, stream, extra) != (
            1,
            1,
            nvidia.WARP,
            1,
            1,
            0,
            99,
            None,
        ) or not across:
            return 1  # of a grid without blocks, too
        if not function or "cuLaunchKernel" in self.fails:
            return self.fails.get("cuLaunchKernel", 400)
        self.launched[self.loaded[function - 1]] += 1
        run, count = _C(None, _pointer, _pointer)(self._twin(function)), across * threads
        each = range(count) if self.order == "in order" else reversed(range(count))
        call = lambda number: run(parameters[0], number | count << 32)
        if self.order == "at once":
            with ThreadPoolExecutor(4) as pool:
                list(pool.map(call, each))
        else:
            for number in each:
                call(number)
        return 0

    def load(self, text, name):
        """A kernel, which is made when it is launched."""
        self.loaded.append(text.decode())
        return nvidia.Loaded(len(self.loaded), 1000, 255)

    def _twin(self, number):
        if number not in self.twins:
            self.twins[number] = host.address(host.object_code(twin_text(self.loaded[number - 1]), 1), "run")
        return self.twins[number]

    def _error(self, code, place):
        place[0] = _SAID[code]
        return 0


DRIVER = Driver()

# `handler`, which gives the stream 99 and memory where XLA, on a CPU, has none
_STREAM = """
define ptr @stream(ptr %asked) {
  %at = getelementptr i64, ptr %asked, i64 3
  store i64 99, ptr %at
  ret ptr null
}
define ptr @handler(ptr %frame) {
  %words = alloca i64, i64 21
  %api = alloca i64, i64 17
  call void @llvm.memcpy.p0.p0.i64(ptr %words, ptr %frame, i64 168, i1 0)
  %extension_at = getelementptr ptr, ptr %frame, i64 1
  %extension = load ptr, ptr %extension_at
  %asked = icmp ne ptr %extension, null
  br i1 %asked, label %on, label %with
with:
  %api_at = getelementptr ptr, ptr %frame, i64 2
  %own = load ptr, ptr %api_at
  store ptr %own, ptr inttoptr (i64 INTERFACE to ptr)
  call void @llvm.memcpy.p0.p0.i64(ptr %api, ptr %own, i64 136, i1 0)
  %stream_at = getelementptr ptr, ptr %api, i64 10
  store ptr @stream, ptr %stream_at
  %allocate_at = getelementptr ptr, ptr %api, i64 15
  store i64 ALLOCATE, ptr %allocate_at
  %free_at = getelementptr ptr, ptr %api, i64 16
  store i64 FREE, ptr %free_at
  %place = getelementptr ptr, ptr %words, i64 2
  store ptr %api, ptr %place
  br label %on
on:
  %found = call ptr @served(ptr %words)
  ret ptr %found
}
declare void @llvm.memcpy.p0.p0.i64(ptr, ptr, i64, i1)
"""


@contextmanager
def in_place_of_a_gpu(order="in order", memory=2**40, **fails):
    """Inside, machine code that JAX calls on the CPU is that of a GPU of so many bytes; it is given the texts
    of all kernels, each with how often it ran.
    """
    stream = _STREAM
    for name, there in (
        ("ALLOCATE", DRIVER.allocate),
        ("FREE", DRIVER.free),
        ("INTERFACE", DRIVER.interface),
    ):
        stream = stream.replace(name, str(ctypes.cast(there, _pointer).value))
    register, launched, text_of = ffi.register, Counter[str](), gpu.handler_text
    text = lambda name: text_of(name).replace("@handler(", "@served(") + stream
    jax.clear_caches()
    with (
        mock.patch.multiple(jax, default_backend=lambda: "gpu"),
        mock.patch.multiple(gpu, handler_text=text),
        mock.patch.multiple(
            ffi, register=lambda name, text, platform, effort: register(name, text, "cpu", effort)
        ),
        mock.patch.multiple(
            nvidia,
            reason_against=str,
            driver=lambda: DRIVER.library,
            architecture=lambda: "sm_90 on the CPU",
            text_for=lambda text, architecture: text,
            loaded=DRIVER.load,
            memory=lambda: memory,
            # registers, cache, multiprocessors, blocks
            _of_device={82: 65536, 81: 65536, 16: 1, 106: 32}.__getitem__,
        ),
        mock.patch.multiple(DRIVER, order=order, fails=fails, launched=launched, largest=0),
    ):
        mlir.register_lowering(value_kernels._call_p, value_kernels._on_nvidia, platform="cpu")
        try:
            yield launched
        finally:
            mlir.register_lowering(value_kernels._call_p, value_kernels.on_cpu, platform="cpu")
            jax.clear_caches()
            assert not DRIVER.records, "memory of XLA's that was not given back"


def driver_of_devices(capabilities, fails=0, missing=""):
    """Functions by which a driver describes its devices; `fails`: what its start returns, `missing`: a
    function that it has not.
    """

    def says(what):
        return lambda *given: (
            setattr(next(x for x in given if hasattr(x, "_obj"))._obj, "value", what(*given)) or 0
        )

    own = {
        "cuInit": lambda _: fails,
        "cuDeviceGetAttribute": says(lambda _, which, device: capabilities[device][which - 75]),
        "cuGetErrorString": says(lambda *_: b"no CUDA-capable device is detected"),
    }
    return SimpleNamespace(**dict.fromkeys(set(nvidia._CALLED) - {missing}) | own)


def assembler():
    """NVIDIA's assembler, of the wheel `nvidia-cuda-nvcc` or of a toolkit."""
    found = [str(file) for folder in sys.path for file in Path(folder).glob("nvidia/*/bin/ptxas")]
    return found[0] if found else shutil.which("ptxas")


def said_by_assembler(ptx):
    """What it says of text for compute capability 9.0; empty where there is none."""
    if not (found := assembler()):
        return ""
    done = subprocess.run(
        [found, "-arch=sm_90", "-v", "-o", "/dev/null", "-"], input=ptx, capture_output=True, text=True
    )
    assert not done.returncode, done.stderr
    return done.stderr
