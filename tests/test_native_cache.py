"""Machine code that is kept on disk, and what is said while it is made."""

import io
import os
import re
import stat
import subprocess
import sys
import warnings
from itertools import permutations
from types import SimpleNamespace

import machine_code
import pytest

import jourdain_jax as jj
from jourdain_jax.calculus import progress
from jourdain_jax.kernels import ffi, host

root = pytest.mark.skipif(os.geteuid() != 0, reason="only root can hand files to another user")
OTHER = 12345  # the number of another user


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setenv("JOURDAIN_JAX_CACHE", str(tmp_path / "kept"))
    host._warn.cache_clear()
    return tmp_path / "kept"


def _never():
    raise AssertionError("made again")


def _all_kept(*names):
    """The code of each name, made of it where it is not kept."""
    return [host.kept(name, "llvm 20", lambda name=name: f"code of {name}".encode()) for name in names]


def test_code_is_made_once_and_again_where_its_file_is_torn(folder):
    (code,) = _all_kept("a")
    assert host.kept("a", "llvm 20", _never) == code
    file = folder / "a.o"
    whole = file.read_bytes()
    for torn in (whole[:-1], b"", whole[:10]):
        file.write_bytes(torn)
        assert _all_kept("a") == [code]
        assert file.read_bytes() == whole
    assert [f.name for f in folder.iterdir()] == ["a.o"]


def test_a_file_in_place_of_the_folder_is_left_alone_with_one_warning(folder):
    folder.write_text("mine")
    with pytest.warns(
        UserWarning, match=f"not cached in the folder `{folder}`.*a file.*JOURDAIN_JAX_CACHE"
    ) as said:
        assert _all_kept("a", "a") == [b"code of a"] * 2
    assert len(said) == 1
    assert folder.read_text() == "mine"


def test_a_folder_that_is_switched_off_is_no_error(monkeypatch):
    monkeypatch.setenv("JOURDAIN_JAX_CACHE", "0")
    assert host.folder() is None
    assert host.kept("a", "llvm 20", lambda: b"code") == b"code"


def test_files_that_are_exchanged_are_made_again(folder):
    """Also those of another kind, or what another version made: the digest at the beginning is that of name,
    maker and code.
    """
    right, files = _all_kept(*"abc"), [folder / f"{name}.o" for name in "abc"]
    for order in permutations([file.read_bytes() for file in files]):
        for file, content in zip(files, order, strict=True):
            file.write_bytes(content)
        assert _all_kept(*"abc") == right
    assert host.kept("a", "llvm 21", lambda: b"newer") == b"newer"
    assert host.kept("a", "llvm 20", lambda: b"older") == b"older"


def test_only_the_user_may_read_and_write_what_is_kept(folder, monkeypatch):
    before = os.umask(0)
    try:
        _all_kept("a", "b")
    finally:
        os.umask(before)
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700
    assert {stat.S_IMODE(file.stat().st_mode) for file in folder.iterdir()} == {0o600}


def _unused(folder, words):
    """Code is made each time, nothing of the folder is read or written, and one warning says why."""
    before = {file.name: file.read_bytes() for file in folder.iterdir()}
    with pytest.warns(UserWarning, match=f"{folder}.*{words}") as said:
        assert [host.kept(name, "llvm 20", lambda: b"new") for name in "az"] == [b"new", b"new"]
    assert len(said) == 1
    assert {file.name: file.read_bytes() for file in folder.iterdir()} == before


@pytest.mark.parametrize("mode", [0o777, 0o770, 0o720, 0o702, 0o1777])
def test_a_folder_that_others_may_write_is_not_used(folder, mode):
    right = _all_kept("a")
    folder.chmod(mode)
    _unused(folder, "others may write to it.*chmod go-w.*JOURDAIN_JAX_CACHE")
    folder.chmod(0o755)
    assert host.kept("a", "llvm 20", _never) == right[0]


@root
def test_a_file_that_another_user_put_there_is_made_again(folder):
    right = _all_kept("a")
    file = folder / "a.o"
    os.chown(file, OTHER, OTHER)
    assert _all_kept("a") == right
    assert file.stat().st_uid == os.geteuid()
    file.chmod(0o666)
    assert host.kept("a", "llvm 20", lambda: b"made again") == b"made again"


def test_a_link_or_a_pipe_in_place_of_a_file_is_not_read(folder, tmp_path):
    right = _all_kept("a")
    file = folder / "a.o"
    file.rename(tmp_path / "moved")
    file.symlink_to(tmp_path / "moved")
    assert host.kept("a", "llvm 20", lambda: b"other") == b"other"
    file.unlink()
    os.mkfifo(file)
    assert _all_kept("a") == right


@root
@pytest.mark.parametrize("place", ["JOURDAIN_JAX_CACHE", "JAX_COMPILATION_CACHE_DIR", "XDG_CACHE_HOME"])
def test_the_owner_is_asked_of_every_folder(tmp_path, monkeypatch, place):
    """Of JAX's shared cache and of the user's too."""
    monkeypatch.setenv(
        "JOURDAIN_JAX_CACHE", str(tmp_path / "jourdain_jax") if place == "JOURDAIN_JAX_CACHE" else ""
    )
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    config = SimpleNamespace(
        jax_compilation_cache_dir=str(tmp_path) if place == "JAX_COMPILATION_CACHE_DIR" else None
    )
    monkeypatch.setattr(host, "jax", SimpleNamespace(config=config))
    host._warn.cache_clear()
    (code,) = _all_kept("a")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert host.kept("a", "llvm 20", _never) == code
    os.chown(tmp_path / "jourdain_jax", OTHER, -1)
    _unused(tmp_path / "jourdain_jax", f"belongs to user {OTHER}")


PROGRAM = """
import sys
import jax
import jax.numpy as jnp
import jourdain_jax as jj
from jourdain_jax.kernels import host
host.EFFORT = 0
for name in sys.argv[1:]:
    scene = jj.models.MODELS[name]()
    jax.jit(jax.grad(lambda scene: jnp.sum(jj.simulate(scene, scene.example, t1=0.2).q_end))).lower(scene)
"""


def _kept_by_a_process(folder, seed, names):
    environment = os.environ | {"PYTHONHASHSEED": str(seed), "JOURDAIN_JAX_CACHE": str(folder)}
    subprocess.run([sys.executable, "-W", "ignore", "-c", PROGRAM, *names], env=environment, check=True)
    return {file.name for file in folder.iterdir()}


@machine_code.needed
@pytest.mark.parametrize(
    "names", [("skate",), ("whipple-bicycle", "snakeboard", "trailer-chain", "rattleback")]
)
def test_every_process_writes_the_same_programs(tmp_path, names):
    """Files are named by their programs' text: an order of sets of texts, which differs from process to
    process, would give others.
    """
    first = _kept_by_a_process(tmp_path / "kept", 1, names)
    assert len(first) >= 3 * len(names)
    assert all(name.startswith("jourdain_jax_") for name in first)
    assert _kept_by_a_process(tmp_path / "kept", 2, names) == first


def test_the_oldest_go_where_there_is_no_room(folder, monkeypatch):
    monkeypatch.setattr(host, "MOST_BYTES", 100)
    for name in "abc":
        host.kept(name, "llvm 20", lambda: b"x" * 40)
        os.utime(folder / f"{name}.o", (ord(name), ord(name)))
    host._make_room.cache_clear()  # as in another process
    host.kept("d", "llvm 20", lambda: b"x" * 40)
    assert not (folder / "a.o").exists()
    assert (folder / "c.o").exists()
    assert (folder / "d.o").exists()


@machine_code.needed
def test_code_for_another_program_effort_machine_or_compiler_has_another_name(monkeypatch):
    class Asked(Exception):
        """With the name of a file."""

    def asked(name, made_by, make):
        raise Asked(f"{name} {made_by}")

    def name(text="a program", effort=2):
        with pytest.raises(Asked) as found:
            ffi.registered(text, effort)
        return str(found.value)

    monkeypatch.setattr(host, "kept", asked)
    usual = name()
    assert name() == usual
    names = [usual, name("another"), name(effort=1)]
    flat = SimpleNamespace(flatten=lambda: "-avx")
    others = {"get_host_cpu_name": lambda: "another", "llvm_version_info": (1, 2, 3)}
    for what, value in (others | {"get_host_cpu_features": lambda: flat}).items():
        with monkeypatch.context() as patch:
            patch.setattr(host.llvm, what, value)
            names.append(name())
    assert len(set(names)) == 6


class AtOnce:
    """A timer whose time is over when it starts."""

    def __init__(self, after, call, args, named):
        self.start = lambda: call(*args, **named)

    def cancel(self):
        pass


@pytest.mark.parametrize("seen", [True, False])
def test_long_work_is_announced_in_a_terminal_alone(seen, monkeypatch):
    class Terminal(io.StringIO):
        def isatty(self):
            return seen

    class Disc(jj.models.TiltingDisc):
        def events(self, motion):
            return {"far": 12.34 + seen + 0.5678 * motion.q.x}  # machine code that no other test needs

    monkeypatch.setattr(progress.threading, "Timer", AtOnce)
    monkeypatch.setattr(host, "folder", lambda: None)  # no machine code of a run before
    monkeypatch.setattr(sys, "stderr", Terminal())
    assert jj.simulate(Disc(), {"lean": 0.3}, t1=0.1).result == 0
    said = sys.stderr.getvalue().splitlines()
    if not seen:
        assert not said
        return
    assert "jourdain-jax: deriving the equations of `Disc`" in said
    machine_code = re.compile(r"jourdain-jax: compiling [\d,]+ instructions to machine code")
    assert any(map(machine_code.fullmatch, said))
    assert "jourdain-jax: compiling `one_motion` by XLA" in said
