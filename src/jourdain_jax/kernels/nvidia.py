"""NVIDIA GPUs: driver calls, PTX from LLVM, and loaded kernels. Only `libcuda` is needed, called by ctypes.

A kernel is loaded for all devices at once (`cuLibraryLoadData`, CUDA 12). The driver compiles it for each
device on first use and caches the code between processes.
"""

import ctypes
import functools
from typing import NamedTuple

import jax

from jourdain_jax.kernels import host

TRIPLE = "nvptx64-nvidia-cuda"
WARP = 32  # code
CALLED_BY_HANDLER = (
    "cuGetErrorString",
    "cuLaunchKernel",
    "cuMemcpyDtoHAsync_v2",
    "cuMemsetD32Async",
    "cuStreamSynchronize",
)
_CALLED = (
    *CALLED_BY_HANDLER,
    "cuCtxPopCurrent_v2",
    "cuCtxPushCurrent_v2",
    "cuDeviceGetAttribute",
    "cuDevicePrimaryCtxRetain",
    "cuDeviceTotalMem_v2",
    "cuInit",
    "cuKernelGetAttribute",
    "cuLibraryGetKernel",
    "cuLibraryLoadData",
)


class Loaded(NamedTuple):
    """Loaded kernel and the resources of its threads."""

    function: int
    local: int  # bytes of local memory
    registers: int


def driver() -> ctypes.CDLL:
    """Return the driver library."""
    return ctypes.CDLL("libcuda.so.1")


@functools.cache
def reason_against() -> str:
    """Return why machine code for GPUs is not available; empty if it is."""
    if reason := host.reason_against() or reason_against_text():
        return reason
    try:
        library = driver()
    except OSError as error:
        return f"NVIDIA's driver was not found ({error})"
    if missing := [name for name in _CALLED if not hasattr(library, name)]:
        return f"NVIDIA's driver is older than CUDA 12 (it lacks {missing[0]})"
    try:
        _checked(library.cuInit(0))
        return "" if _capabilities() else "it requires an NVIDIA GPU of compute capability 7.5 or newer"
    except RuntimeError as error:
        return str(error)


def reason_against_text() -> str:
    """Return why LLVM cannot write PTX; empty if it can."""
    try:
        host.llvm.initialize_all_targets()
        host.llvm.initialize_all_asmprinters()
        host.llvm.Target.from_triple(TRIPLE)
    except Exception as error:
        return f"llvmlite's LLVM cannot compile for NVIDIA GPUs ({str(error).splitlines()[0]})"
    return ""


def _checked(code: int) -> None:
    """Raise the driver's error, if any."""
    if code:
        text = ctypes.c_char_p()
        driver().cuGetErrorString(code, ctypes.byref(text))
        raise RuntimeError(f"NVIDIA's driver reports: {(text.value or b'error %d' % code).decode()}")


def _said(function: str, *what, found=ctypes.c_int) -> int:
    """Return the number that a driver function stores through its first argument, a pointer."""
    number = found()
    _checked(getattr(driver(), function)(ctypes.byref(number), *what))
    return number.value


def _devices() -> list[int]:
    """Return the driver's numbers of the GPUs that JAX uses in this process."""
    return [device.local_hardware_id for device in jax.local_devices(backend="cuda")]


def _of_device(attribute: int) -> int:
    """Return the smallest value of an attribute over all devices of JAX."""
    return min(_said("cuDeviceGetAttribute", attribute, device) for device in _devices())


def _capabilities() -> list[int]:
    """Return the compute capabilities, times ten, that all devices support."""
    major, minor = 75, 76  # attributes of a device
    own = [
        10 * _said("cuDeviceGetAttribute", major, device) + _said("cuDeviceGetAttribute", minor, device)
        for device in _devices()
    ]
    return [known for known in (75, 80, 86, 89, 90, 100, 120) if known <= min(own)]


def memory() -> int:
    """Return the bytes of memory of the smallest device."""
    return min(_said("cuDeviceTotalMem_v2", device, found=ctypes.c_size_t) for device in _devices())


def architecture() -> str:
    """Return the target architecture, such as `sm_90`."""
    return f"sm_{max(_capabilities())}"


def text_for(module: str, architecture: str) -> str:
    """Return the PTX of a module of LLVM IR."""
    llvm = host.llvm
    machine = llvm.Target.from_triple(TRIPLE).create_target_machine(cpu=architecture, opt=3)
    parsed = llvm.parse_assembly(module)
    parsed.triple, parsed.data_layout = TRIPLE, str(machine.target_data)
    for _ in range(2):  # after the first pass has unrolled loops, the second keeps their values in registers
        options = llvm.create_pipeline_tuning_options(speed_level=3)
        options.loop_vectorization = options.slp_vectorization = False
        builder = llvm.create_pass_builder(machine, options)
        builder.getModulePassManager().run(parsed, builder)
    return machine.emit_assembly(parsed)


def loaded(text: bytes, name: str) -> Loaded:
    """Return the kernel called `name` in PTX, loaded in the CUDA context of JAX's first device."""
    library, device, pointer = driver(), _devices()[0], ctypes.c_void_p
    context = pointer(_said("cuDevicePrimaryCtxRetain", device, found=pointer))
    _checked(library.cuCtxPushCurrent_v2(context))
    try:
        given = ctypes.c_char_p(text + b"\0"), None, None, 0, None, None, 0
        module = pointer(_said("cuLibraryLoadData", *given, found=pointer))
        kernel = pointer(_said("cuLibraryGetKernel", module, name.encode(), found=pointer))
        # numbers of a kernel's attributes: bytes of local memory (3), registers (4)
        sizes = [_said("cuKernelGetAttribute", attribute, kernel, device) for attribute in (3, 4)]
        return Loaded(kernel.value or 0, *sizes)
    finally:
        _checked(library.cuCtxPopCurrent_v2(ctypes.byref(context)))


def blocks(lanes: int, kernel: Loaded) -> int:
    """Return the number of warps for these `lanes`, limited by the registers and by the local memory that
    fits in the first-level cache. The cache allows at least four per multiprocessor.
    """
    # numbers of a device's attributes: multiprocessors (16), and for each of these registers (82), cache
    # usable as shared memory (81), maximum number of blocks (106)
    by_registers = _of_device(82) // (WARP * max(8, kernel.registers + -kernel.registers % 8))
    by_cache = _of_device(81) // max(1, WARP * kernel.local)
    # one for each of the four parts of a multiprocessor
    return min(-(lanes // -WARP), _of_device(16) * min(by_registers, _of_device(106), max(by_cache, 4)))
