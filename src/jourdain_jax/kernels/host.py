"""The host processor: support of machine code, number of lanes, compilation, and the cache on disk.

Code is cached between processes in the folder of JAX's compilation cache if one is set, otherwise in the
user's cache folder. A file is named after the source of its code. It begins with a digest of its name, the
tools and the code, so that incomplete, modified or exchanged files are compiled again.

Cached code runs in this process, so folders and files that another user owns or may write are not used. The
digest does not protect against someone who can write as the user; such a person could equally modify imported
Python files.
"""

import contextlib
import ctypes
import functools
import hashlib
import os
import stat
import threading
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax

from jourdain_jax.calculus.configuration import MOST_THREADS
from jourdain_jax.calculus.files import whole_number, write_whole
from jourdain_jax.calculus.progress import announced

llvm: Any = None
_NOT_IMPORTED = "llvmlite is not installed"
try:
    from llvmlite import binding

    llvm = binding
except ModuleNotFoundError:  # an optional dependency
    pass
except (ImportError, OSError) as error:
    _NOT_IMPORTED = f"llvmlite cannot be imported ({error})"

_LANES = (("avx512f", 8), ("avx", 4))  # doubles per register; otherwise 2, as on every 64-bit machine
# Maximum optimisation level. It does not affect results, because LLVM must not round differently.
# 2: full optimisation, for code that runs often. 1: few passes; projection of the speeds of a bicycle
# compiles in 0.51 s instead of 0.84 and takes 2.4 us per lane instead of 1.6. 0: fast register allocation;
# 12,000 sequential operations compile in 0.07 s instead of 0.72 (1) and 1.33 (2), and run at half the speed.
EFFORT = 2  # tuning
_lock = threading.Lock()
_engines: list = []  # own the machine code, and live as long as the process, which may call it


# C functions that machine code calls. LLVM ends the process if one of them is missing.
_CALLED = (
    "aligned_alloc",
    "free",
    "memcpy",
    "memset",
    "pthread_attr_init",
    "pthread_attr_setstacksize",
    "pthread_create",
    "pthread_join",
)
# Module with the syntax that llvmlite must understand; LLVM 15 and older do not.
_TRIAL = (
    "define <2 x double> @trial(ptr %at) {\n  %x = load <2 x double>, ptr %at\n  %y = fadd <2 x double> %x,"
    " splat (double 1.0)\n  ret <2 x double> %y\n}\n"
)


@functools.cache
def reason_against() -> str:
    """Return why machine code is not available here; empty if it is."""
    if os.name != "posix":
        return "it requires Linux or macOS"
    if llvm is None:
        return _NOT_IMPORTED
    try:
        llvm.initialize_native_target()
        llvm.initialize_native_asmprinter()
        process = ctypes.CDLL(None)
        for name in _CALLED:
            getattr(process, name)
        address(object_code(_TRIAL, 0), "trial")
    except Exception as error:  # whatever the system lacks, motions are then integrated by XLA
        version, said = ".".join(map(str, llvm.llvm_version_info)), str(error).split("\n")[0]
        return f"llvmlite's LLVM {version} does not work here ({said})"
    return ""


@functools.cache
def features() -> dict[str, bool]:
    """Return the features of the processor. LLVM reports none for Apple's processors; like every 64-bit ARM
    processor they have vector registers and fused multiply-add.
    """
    found = dict(llvm.get_host_cpu_features())
    return found | {"neon": True} if llvm.get_process_triple().startswith(("aarch64", "arm64")) else found


def lanes() -> int:
    """Return the number of doubles in a vector register."""
    return next((count for name, count in _LANES if features().get(name)), 2)


def registers() -> int:
    """Return the number of values that fit in vector registers; four registers stay free for instructions."""
    return 28 if features().get("avx512f") or features().get("neon") else 12


def threads() -> int:
    """Return the number of threads that share a batch: one per usable core, or `JOURDAIN_JAX_THREADS`."""
    variable = "JOURDAIN_JAX_THREADS"
    if variable in os.environ:
        return whole_number(os.environ[variable], f"the environment variable {variable}", MOST_THREADS)
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return min(cores, MOST_THREADS)


def fuses() -> bool:
    """Return whether the processor has fused multiply-add."""
    return bool(features().get("fma") or features().get("neon"))


@functools.cache
def _machine(effort: int):
    target = llvm.Target.from_default_triple()
    return target.create_target_machine(
        cpu=llvm.get_host_cpu_name(), features=llvm.get_host_cpu_features().flatten(), opt=effort, jit=True
    )


def description() -> str:
    """Return what machine code depends on besides the program: processor, compiler and effort."""
    machine = (
        f"{llvm.get_process_triple()} {llvm.get_host_cpu_name()} {llvm.get_host_cpu_features().flatten()}"
    )
    return f"{EFFORT} {llvm.llvm_version_info} {machine}"


def object_code(text: str, effort: int) -> bytes:
    """Return the machine code of a module of LLVM IR; `effort`: 0, 1, or 2, as for `EFFORT`."""
    effort = min(effort, EFFORT)
    with announced(f"compiling {text.count(chr(10)):,} instructions to machine code"), _lock:
        machine, few_passes = _machine(effort), effort < 2
        module = llvm.parse_assembly(text)
        module.triple = llvm.get_process_triple()
        options = llvm.create_pipeline_tuning_options(speed_level=0 if few_passes else effort)
        options.loop_vectorization = options.slp_vectorization = False
        builder = llvm.create_pass_builder(machine, options)
        passes = llvm.create_new_module_pass_manager() if few_passes else builder.getModulePassManager()
        for add in ("add_sroa_pass", "add_simplify_cfg_pass") if few_passes else ():
            getattr(passes, add, lambda: None)()  # older versions of llvmlite lack some of them
        passes.run(module, builder)
        return machine.emit_object(module)


def address(code: bytes, name: str) -> int:
    """Return the address of a compiled function in memory."""
    with _lock:
        # an engine takes ownership of its target machine
        machine = llvm.Target.from_default_triple().create_target_machine(jit=True)
        engine = llvm.create_mcjit_compiler(llvm.parse_assembly(""), machine)
        engine.add_object_file(llvm.ObjectFileRef.from_data(code))
        engine.finalize_object()
        _engines.append(engine)
        return engine.get_function_address(name)


MOST_BYTES = 200e6  # tuning: of all files; beyond, the oldest are deleted
_DIGEST = 32  # code: bytes


def folder() -> Path | None:
    """Return the cache folder; None if `JOURDAIN_JAX_CACHE` is 0 or the user has no home folder."""
    stated = os.environ.get("JOURDAIN_JAX_CACHE", "")
    if stated == "0":
        return None
    if stated:
        return Path(stated)
    if jax.config.jax_compilation_cache_dir:
        return Path(jax.config.jax_compilation_cache_dir) / "jourdain_jax"
    try:
        return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "jourdain_jax"
    except RuntimeError:  # a user without a home
        return None


def kept(name: str, made_by: str, make: Callable[[], bytes]) -> bytes:
    """Return the content of the cache file `name`. If it is missing or damaged, return `make()`, and store
    it. Disk errors are ignored.

    `made_by`: versions of the tools, as text; content of other versions counts as damaged.
    """
    place = folder()
    if place is None or not _is_ours(place):
        return make()
    file = place / f"{name}.o"

    def digest(code: bytes) -> bytes:
        return hashlib.sha256(f"machine code\0{name}\0{made_by}\0".encode() + code).digest()

    text = _read(file)
    if digest(text[_DIGEST:]) == text[:_DIGEST]:
        return text[_DIGEST:]
    code = make()
    with contextlib.suppress(OSError):
        _make_room(place)
        write_whole(file, digest(code) + code, mode=0o600)
    return code


def _is_ours(place: Path) -> bool:
    """Return whether the folder, created if missing, can be used; otherwise warn with the reason."""
    try:
        place.mkdir(mode=0o700, parents=True, exist_ok=True)
        against = _against(os.stat(place))
    except (FileExistsError, NotADirectoryError):
        against = "it is a file, or lies in one"
    except OSError:
        return False
    if against:
        _warn(place, against)
    return not against


def _against(found: os.stat_result) -> str:
    """Return why a folder or file cannot be trusted; empty if it can."""
    if found.st_uid != os.geteuid():
        return f"it belongs to user {found.st_uid}, but its files would run as {os.geteuid()}"
    if found.st_mode & (stat.S_IWGRP | stat.S_IWOTH):
        return "others may write to it, but its files run in your process (use chmod go-w)"
    return ""


@functools.cache
def _warn(place: Path, against: str) -> None:
    warnings.warn(
        f"machine code is not cached in the folder `{place}`, so every process compiles it again: {against}; "
        "set JOURDAIN_JAX_CACHE to a folder of your own, or to 0 for no cache",
        stacklevel=2,
    )


def _read(file: Path) -> bytes:
    """Return the content of a cache file; empty if missing or not trusted."""
    try:
        with open(os.open(file, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK), "rb") as opened:
            return b"" if _against(os.fstat(opened.fileno())) else opened.read()
    except OSError:
        return b""


@functools.cache
def _make_room(place: Path) -> None:
    """Remove the oldest files if all files together exceed `MOST_BYTES`; once in a process, because looking
    through 5,000 files takes 50 ms.
    """
    found = sorted((file.stat().st_mtime, file.stat().st_size, file) for file in place.glob("*.o"))
    excess = sum(size for _, size, _ in found) - MOST_BYTES
    for _, size, file in found:
        if excess <= 0:
            break
        file.unlink(missing_ok=True)
        excess -= size
