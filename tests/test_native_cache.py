"""Machine code that is kept on disk."""

import multiprocessing
from types import SimpleNamespace

import pytest

from jourdain_jax.native import disk, ffi, host


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setenv("JOURDAIN_JAX_CACHE", str(tmp_path / "kept"))
    return tmp_path / "kept"


def _never():
    raise AssertionError("made again")


def test_code_is_made_once_and_again_where_its_file_is_torn(folder):
    assert disk.kept("a", lambda: b"code") == b"code"
    assert disk.kept("a", _never) == b"code"
    file = folder / "a.o"
    whole = file.read_bytes()
    for torn in (whole[:-1], b"", whole[:10], whole[:-1] + b"?"):
        file.write_bytes(torn)
        assert disk.kept("a", lambda: b"code") == b"code"
        assert file.read_bytes() == whole
    assert [f.name for f in folder.iterdir()] == ["a.o"]


def test_a_folder_that_cannot_be_used_or_is_switched_off_is_no_error(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("JOURDAIN_JAX_CACHE", str(tmp_path / "file"))
    assert disk.kept("a", lambda: b"code") == b"code"
    monkeypatch.setenv("JOURDAIN_JAX_CACHE", "0")
    assert disk.folder() is None
    assert disk.kept("a", lambda: b"code") == b"code"


def test_the_oldest_go_where_there_is_no_room(folder, monkeypatch):
    monkeypatch.setattr(disk, "MOST_BYTES", 100)
    for name in "abc":
        disk.kept(name, lambda: b"x" * 40)
    assert not (folder / "a.o").exists()
    assert (folder / "c.o").exists()


@pytest.mark.skipif(bool(host.reason_against()), reason=host.reason_against())
def test_code_for_another_program_effort_machine_or_compiler_has_another_name(monkeypatch):
    class Asked(Exception):
        """With the name of a file."""

    def asked(name, make):
        raise Asked(name)

    def name(text="a program", effort=2) -> str:
        with pytest.raises(Asked) as found:
            ffi.registered.__wrapped__(text, effort)
        return str(found.value)

    monkeypatch.setattr(disk, "kept", asked)
    usual = name()
    assert name() == usual
    names = [usual, name("another"), name(effort=1)]
    flat = SimpleNamespace(flatten=lambda: "-avx")
    for what, value in (("get_host_cpu_name", lambda: "another"), ("llvm_version_info", (1, 2, 3)), ("get_host_cpu_features", lambda: flat)):
        with monkeypatch.context() as patch:
            patch.setattr(host.llvm, what, value)
            names.append(name())
    assert len(set(names)) == 6


def _write(name):
    return disk.kept(name, lambda: b"y" * 1_000_000)


def test_many_processes_may_write_the_same_code(folder):
    with multiprocessing.get_context("spawn").Pool(4) as pool:
        assert set(pool.map(_write, ["same"] * 12)) == {b"y" * 1_000_000}
    assert [f.name for f in folder.iterdir()] == ["same.o"]
