"""What other systems and processors lack, one by one, as if it were lacking here; and machine code for ARM,
which is made here and not run.
"""

import ast
import ctypes
import os
import re
import runpy
import sys
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import machine_code
import pytest
from refusals import refused

import jourdain_jax as jj
from jourdain_jax.calculus import files as whole_files
from jourdain_jax.kernels import ffi, host
from jourdain_jax.motion.simulate import set_up
from jourdain_jax.studies import memory, records, workers
from jourdain_jax.studies.store import Store

SOURCE = Path(jj.__file__).parent
needs_machine_code = machine_code.needed


def _no_library(name, *_):
    raise TypeError("LoadLibrary() argument 1 must be str, not None")


# machine code


def test_under_windows_motions_are_integrated_by_xla(monkeypatch):
    monkeypatch.setattr(host, "os", SimpleNamespace(name="nt"))
    monkeypatch.setattr(host.ctypes, "CDLL", _no_library)
    host.reason_against.cache_clear()
    try:
        assert set_up(jj.models.TiltingDisc()).reason_against_machine_code == "it requires Linux or macOS"
        refused("it requires Linux or macOS", jj.simulate, jj.models.TiltingDisc(), t1=0.1, backend="native")
    finally:
        host.reason_against.cache_clear()


@needs_machine_code
@pytest.mark.parametrize("name", ["aligned_alloc", "pthread_attr_setstacksize"])
def test_a_system_without_a_function_that_is_called_has_no_machine_code(name, monkeypatch):
    class Library:
        """All functions but one."""

        def __init__(self, _):
            self.all = ctypes.PyDLL(_)

        def __getattr__(self, asked):
            if asked == name:
                raise AttributeError(f"undefined symbol: {asked}")
            return getattr(self.all, asked)

    monkeypatch.setattr(host.ctypes, "CDLL", Library)
    assert host.reason_against.__wrapped__().endswith(f"does not work here (undefined symbol: {name})")


@needs_machine_code
@pytest.mark.parametrize("lacking", ["parse_assembly", "create_mcjit_compiler"])
def test_an_llvmlite_that_is_too_old_or_too_new_has_no_machine_code(lacking, monkeypatch):
    def refused(*_):
        raise RuntimeError("LLVM IR parsing error\n<string>:1:8: expected type")

    monkeypatch.setattr(host.llvm, lacking, refused)
    assert re.fullmatch(
        r"llvmlite's LLVM [\d.]+ does not work here \(LLVM IR parsing error\)",
        host.reason_against.__wrapped__(),
    )


@pytest.mark.parametrize(
    ("error", "said"),
    [(OSError("no libllvmlite.so"), "cannot be imported (no libllvmlite.so)"), (None, "is not installed")],
)
def test_an_llvmlite_that_cannot_be_imported_is_as_none(error, said, monkeypatch):
    class Broken:
        """A module whose parts cannot be loaded."""

        def __getattr__(self, name):
            raise error

    monkeypatch.setitem(sys.modules, "llvmlite", error and Broken())
    assert runpy.run_path(host.__file__)["reason_against"]() == f"llvmlite {said}"


@needs_machine_code
@pytest.mark.parametrize("triple", ["arm64-apple-darwin23.0.0", "aarch64-unknown-linux-gnu"])
def test_processors_of_arm_have_vectors_and_fused_products_also_where_llvm_says_nothing(triple, monkeypatch):
    monkeypatch.setattr(host.llvm, "get_process_triple", lambda: triple)
    monkeypatch.setattr(host.llvm, "get_host_cpu_features", lambda: {})
    features = host.features.__wrapped__()
    monkeypatch.setattr(host, "features", lambda: features)
    assert (host.lanes(), host.fuses(), host.registers()) == (2, True, 28)


def test_threads_are_as_many_as_the_machine_has_cores_where_a_process_cannot_choose_them(monkeypatch):
    monkeypatch.setattr(host, "os", SimpleNamespace(environ={}, cpu_count=lambda: 10))
    assert host.threads() == 10


@needs_machine_code
@pytest.mark.parametrize(
    ("triple", "cpu"), [("arm64-apple-macosx14.0.0", "apple-m1"), ("aarch64-unknown-linux-gnu", "generic")]
)
def test_machine_code_for_arm_calls_nothing_that_is_not_there(triple, cpu, kernels):
    llvm = host.llvm
    llvm.initialize_all_targets()
    llvm.initialize_all_asmprinters()
    machine = llvm.Target.from_triple(triple).create_target_machine(cpu=cpu, opt=0, jit=True)
    there = {*host._CALLED, "memset_pattern16", "bzero"}  # the last two: of macOS
    before = "_" if "apple" in triple else ""  # every name
    all_called: set[str] = set()
    for text in kernels:
        module = llvm.parse_assembly(text)
        module.triple = triple
        assembly = machine.emit_assembly(module)
        own = re.findall(rf"^{before}(\w+):", assembly, re.M)
        all_called |= {
            a or b
            for a, b in re.findall(
                rf"\bbl?\s+{before}([a-z]\w*)$|\b{before}([a-z]\w*)@GOTPAGE\b", assembly, re.M
            )
        }.difference(own)
    assert {"aligned_alloc", "pthread_create"} <= all_called <= there


@pytest.fixture(scope="module")
def kernels():
    """Modules of motions with a stop event, by steps of Runge and Kutta forth and back and by Taylor series,
    in two lanes.
    """
    texts: list[str] = []

    class Disc(jj.models.TiltingDisc):
        """One of which no other test has kernels, since these are not registered."""

    def end(lean, **options):
        return jnp.sum(jj.simulate(Disc(), {"lean": lean}, ts=[0.2], backend="native", **options).q_end)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(host, "lanes", lambda: 2)
        patch.setattr(host, "fuses", lambda: True)
        patch.setattr(ffi, "registered", lambda text, *_: texts.append(text) or f"none_{len(texts)}")
        patch.setattr(host, "threads", lambda: 2)
        for f in (jax.grad(end), partial(end, solver=jj.Taylor())):
            jax.jit(jax.vmap(f)).lower(jnp.full(3, 0.3))
    return texts


# files


def test_what_is_kept_has_no_place_where_a_user_has_no_home(monkeypatch):
    def nowhere():
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.delenv("JOURDAIN_JAX_CACHE", raising=False)
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setattr(host, "jax", SimpleNamespace(config=SimpleNamespace(jax_compilation_cache_dir=None)))
    monkeypatch.setattr(host.Path, "home", nowhere)
    assert host.folder() is None
    assert host.kept("a", "", lambda: b"code") == b"code"


def test_a_file_that_another_process_reads_need_not_be_replaced(tmp_path, monkeypatch):
    def refused(*_):
        raise PermissionError(
            13, "The process cannot access the file because it is being used by another process"
        )

    monkeypatch.setenv("JOURDAIN_JAX_CACHE", str(tmp_path))
    monkeypatch.setattr(os, "replace", refused)
    assert host.kept("a", "", lambda: b"code") == b"code"
    assert not list(tmp_path.iterdir())


def test_files_of_studies_are_bytes_and_need_no_locks(tmp_path, monkeypatch):
    asked, usual = [], os.open
    monkeypatch.setattr(os, "O_BINARY", 0x8000, raising=False)
    monkeypatch.setitem(sys.modules, "fcntl", None)
    seen = lambda path, flags, *mode: asked.append(flags) or usual(path, flags & ~0x8000, *mode)
    monkeypatch.setattr(os, "open", seen)
    runpy.run_path(whole_files.__file__)["write_whole"](tmp_path / "a", b"1\n2")
    assert (tmp_path / "a").read_bytes() == b"1\n2"
    assert all(flags & 0x8000 for flags in asked)
    assert len(asked) == 1
    with runpy.run_path(records.__file__)["locked"](tmp_path / "lock"):
        pass


def test_a_study_takes_an_empty_folder_also_where_a_folder_cannot_take_the_place_of_another(
    tmp_path, monkeypatch
):
    def rename(old, new, rename=os.rename):
        if Path(new).exists():
            raise FileExistsError(17, "Cannot create a file when that file already exists")
        rename(old, new)

    monkeypatch.setattr(os, "rename", rename)
    (tmp_path / "empty").mkdir()
    assert Store.make(tmp_path / "empty", {"samples": 4, "chunk": 2, "block": 2}, {}, {}, {}).lanes == 4
    assert [file.name for file in tmp_path.iterdir()] == ["empty"]


def _read_as_text(tree):
    for call in ast.walk(tree):
        if isinstance(call, ast.Call):
            # `read_text` alone is that of `calculus/files.py`
            name = ast.unparse(call.func).rpartition(".")[1:]
            binary = any("b" in str(getattr(x, "value", "")) for x in call.args[:2])
            if name in ((".", "read_text"), (".", "write_text")) or (
                name[1] == "open" and ast.unparse(call.func) != "os.open" and not binary
            ):
                yield call


def test_every_text_file_has_an_encoding_that_does_not_depend_on_the_system():
    texts = {file: file.read_text(encoding="utf-8") for file in SOURCE.rglob("*.py")}
    calls = [
        (file.name, call)
        for file, text in texts.items()
        if re.search(r"(open|_text)\(", text)
        for call in _read_as_text(ast.parse(text))
    ]
    assert len(calls) > 4
    assert not [(name, call.lineno) for name, call in calls if "encoding=" not in ast.unparse(call)]


# studies


def test_workers_share_threads_also_where_a_process_cannot_choose_its_cores(monkeypatch):
    environ: dict[str, str] = {}
    monkeypatch.setattr(workers, "os", SimpleNamespace(environ=environ, cpu_count=lambda: 8))
    workers.keep_to_share(1, 3)
    assert environ == {"JOURDAIN_JAX_THREADS": "3"}
    workers.keep_to_share(0, 16)
    assert environ == {"JOURDAIN_JAX_THREADS": "1"}


@pytest.mark.parametrize("text", ["all", "0", "-1", "2.0", "1_0", "\u0662", "1025", "100000", "9" * 5000, ""])
def test_a_number_of_threads_that_is_none_is_named(monkeypatch, text):
    monkeypatch.setenv("JOURDAIN_JAX_THREADS", text)
    told = refused(r"JOURDAIN_JAX_THREADS is `.*`, expected a whole number from 1 to 1024", host.threads)
    assert len(told) < 200


def test_a_bound_on_memory_is_refused_where_there_is_no_library_of_c_to_ask(monkeypatch):
    monkeypatch.setattr(memory, "os", SimpleNamespace(name="nt"))
    monkeypatch.setattr(memory.ctypes, "CDLL", _no_library)
    refused("`memory` is limited only on Linux with glibc", memory.give_back_at_once)


def test_a_study_whose_workers_cannot_begin_says_so(tmp_path, monkeypatch):
    sent = (  # a class of the program that was started, which a worker does not have
        b"\x80\x04\x8c\x08__main__\x8c\x04Mine\x93."
    )
    store = Store.make(tmp_path / "study", {"samples": 4, "chunk": 2, "block": 2}, {}, {}, {})
    monkeypatch.setattr(workers, "sent_to_others", lambda _: sent)
    found = workers.in_processes(object.__new__(workers.Task), 1)(store, [0, 1], lambda: False)
    with pytest.raises(RuntimeError, match=r"no worker of this study could start.*__main__"):
        next(found)
