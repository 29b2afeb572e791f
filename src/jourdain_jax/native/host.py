"""The machine that runs this process: whether machine code can be made for it, how many lanes it takes at once; and how code is made."""

import ctypes
import ctypes.util
import functools
import os
import threading
from typing import Any

from jourdain_jax.native.libm import PREFIX
from jourdain_jax.native.math_functions import LIBM

try:
    from llvmlite import binding
except ImportError:  # an optional dependency
    binding = None
llvm: Any = binding

_LANES = (("avx512f", 8), ("avx", 4))  # doubles of a register; else 2, as every 64-bit machine has
# How much LLVM does, at most; no number depends on it: nothing here allows LLVM to round differently.
# 2: all that it can, for what runs often.
# 1: few passes; speeds of a bicycle put onto its rows take 0.51 s to compile in place of 0.84, and 2.4 us per lane in place of 1.6.
# 0: registers are assigned without a search; 12,000 operations in a row take 0.07 s to compile in place of 0.72 (1) and 1.33 (2), and run at half the speed.
EFFORT = 2
_lock = threading.Lock()
_engines: list = []  # what machine code lives in: as long as the process, which may call it


@functools.cache
def reason_against() -> str:
    """Why no machine code is made here; empty where it is."""
    if llvm is None:
        return "llvmlite is not installed"
    try:
        llvm.initialize_native_target()
        llvm.initialize_native_asmprinter()
        _machine(0)
        libm = ctypes.CDLL(ctypes.util.find_library("m"))
        for name in LIBM.values():
            llvm.add_symbol(PREFIX + name, ctypes.cast(getattr(libm, name), ctypes.c_void_p).value)
    except (OSError, RuntimeError, AttributeError) as error:
        return f"LLVM does not know this machine ({str(error).splitlines()[0]})"
    return ""


@functools.cache
def features() -> dict[str, bool]:
    """What the processor can do."""
    return dict(llvm.get_host_cpu_features())


def lanes() -> int:
    """How many doubles a vector register holds."""
    return next((count for name, count in _LANES if features().get(name)), 2)


@functools.cache
def registers() -> int:
    """How many values may be kept in vector registers; four of these are left to the working of instructions."""
    return 28 if features().get("avx512f") or features().get("neon") else 12


@functools.cache
def threads() -> int:
    """How many threads share a batch: one for every core that this process may use, or as many as `JOURDAIN_JAX_THREADS` says."""
    if not hasattr(ctypes.CDLL(None), "pthread_create"):
        return 1
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(1, int(os.environ.get("JOURDAIN_JAX_THREADS", cores)))


def fuses() -> bool:
    """Whether products and sums are rounded once, in one instruction."""
    return bool(features().get("fma") or features().get("neon"))


@functools.cache
def _machine(effort: int):
    target = llvm.Target.from_default_triple()
    return target.create_target_machine(cpu=llvm.get_host_cpu_name(), features=llvm.get_host_cpu_features().flatten(), opt=effort, jit=True)


def description() -> str:
    """What machine code depends on besides the program."""
    return f"{EFFORT} {llvm.llvm_version_info} {llvm.get_host_cpu_name()} {llvm.get_host_cpu_features().flatten()}"


def object_code(text: str, effort: int) -> bytes:
    """Machine code of a module of LLVM IR; `effort`: 0, 1, or 2, as of `EFFORT`."""
    effort = min(effort, EFFORT)
    with _lock:
        machine, few_passes = _machine(effort), effort < 2
        module = llvm.parse_assembly(text)
        module.triple = llvm.get_process_triple()
        options = llvm.create_pipeline_tuning_options(speed_level=0 if few_passes else effort)
        options.loop_vectorization = options.slp_vectorization = False
        builder = llvm.create_pass_builder(machine, options)
        passes = llvm.create_new_module_pass_manager() if few_passes else builder.getModulePassManager()
        for add in ("add_sroa_pass", "add_simplify_cfg_pass") if few_passes else ():
            getattr(passes, add, lambda: None)()  # older versions of llvmlite have not all of them
        passes.run(module, builder)
        return machine.emit_object(module)


def address(code: bytes, name: str) -> int:
    """Where a function of some machine code is, once it is in memory."""
    with _lock:
        # an engine takes its target machine with it
        machine = llvm.Target.from_default_triple().create_target_machine(jit=True)
        engine = llvm.create_mcjit_compiler(llvm.parse_assembly(""), machine)
        engine.add_object_file(llvm.ObjectFileRef.from_data(code))
        engine.finalize_object()
        _engines.append(engine)
        return engine.get_function_address(name)
