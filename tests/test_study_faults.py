"""What happens to studies that are killed, interrupted, damaged, out of room, or run where they should not be."""

import errno
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections import deque
from fractions import Fraction
from pathlib import Path
from types import ModuleType, SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import psutil
import pytest
from jax.flatten_util import ravel_pytree
from scipy.interpolate import CubicSpline
from test_inputs import OnBelt
from test_studies import assert_same

import jourdain_jax as jj
from jourdain_jax.ensembles import files, store, task
from jourdain_jax.ensembles.files import write_whole
from jourdain_jax.ensembles.identity import digest
from jourdain_jax.ensembles.store import Store

COUNT = 90  # lanes, in three chunks


@pytest.fixture(autouse=True)
def _blocks_are_small(monkeypatch):
    monkeypatch.setattr(task, "LARGEST_BLOCK", 32)


def study(seed=3, **more):
    lean = jj.Uniform(-0.5, 0.5)
    return jj.Study(jj.models.TiltingDisc(), start={"lean": lean, "spin_rate": jj.Uniform(-4.0, 0.0)}, samples=COUNT, seed=seed, **more)


def run(path, seed=3, **options):
    return study(seed).run(path, t1=1.0, rtol=1e-6, atol=1e-6, progress=False, **options)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(task, "LARGEST_BLOCK", 32)
        return run(tmp_path_factory.mktemp("whole") / "discs.zarr")


@pytest.fixture
def computed(monkeypatch):
    """Numbers of the blocks that are computed, in order."""
    numbers, before = [], task.Task.run_block
    monkeypatch.setattr(task.Task, "run_block", lambda self, number, skipped=(): numbers.append(number) or before(self, number, skipped))
    return numbers


class Killed(BaseException):
    """As if the process ended here."""


def _after(monkeypatch, count, error):
    """The files of a store are written until so many have been; then `error` is raised, in the middle of the next."""
    left = [count]

    def write(path: Path, content, **how):
        left[0] -= 1
        if left[0] < 0:
            path.with_name(f".{path.name}.half").write_bytes(content[: len(content) // 2])
            raise error
        write_whole(path, content, **how)

    monkeypatch.setattr(store, "write_whole", write)


def _files_written(monkeypatch, path):
    written = []
    with monkeypatch.context() as patch:
        patch.setattr(store, "write_whole", lambda path, content, **how: written.append(path) or write_whole(path, content, **how))
        run(path)
    return len(written)


def test_a_run_killed_at_any_file_goes_on_to_the_same_bits(whole, tmp_path, monkeypatch, computed):
    count = _files_written(monkeypatch, tmp_path / "all")
    assert count == 2 + 3 * (len(whole.store.columns) + 1)  # study, grid; per chunk its arrays and its receipt
    for number in (0, 1, 2, 3, count // 2, count - 1):
        path = tmp_path / f"killed{number}"
        with monkeypatch.context() as patch:
            _after(patch, number, Killed())
            with pytest.raises(Killed):
                run(path)
        computed.clear()
        assert_same(run(path), whole)
        begun = max(0, number - 2) // (len(whole.store.columns) + 1)  # whole chunks
        assert sorted(set(computed)) == sorted({0, *range(begun, 3)})  # the first block is the yardstick of every process
    assert not [entry for entry in tmp_path.iterdir() if entry.name.startswith(".")]


def test_a_second_run_computes_nothing(whole, tmp_path, computed):
    run(whole.store.path)
    assert computed == []
    assert whole.complete


@pytest.mark.parametrize("harm", ["cut short", "one bit", "gone", "receipt cut short", "of another chunk"])
def test_a_damaged_chunk_is_found_and_computed_again(harm, whole, tmp_path, computed):
    path = tmp_path / "discs.zarr"
    run(path)
    held = path / "lean at the end" / "c" / "1"
    content = held.read_bytes()
    if harm == "cut short":
        held.write_bytes(content[:-9])
    elif harm == "one bit":
        held.write_bytes(content[:100] + bytes([content[100] ^ 4]) + content[101:])
    elif harm == "gone":
        held.unlink()
    elif harm == "of another chunk":
        held.write_bytes((path / "lean at the end" / "c" / "0").read_bytes())
    else:
        receipt = path / "run" / "chunks" / "1"
        receipt.write_bytes(receipt.read_bytes()[:-1])
    if harm == "one bit":
        with pytest.raises(ValueError, match="checksum"):  # Zarr sees it too
            jj.load_study(path).to_xarray()["lean at the end"].load()
    computed.clear()
    with pytest.warns(UserWarning, match="1 chunks of .* are damaged and are computed again: 1"):
        found = run(path)
    assert sorted(computed) == [0, 1]
    assert_same(found, whole)


@pytest.mark.parametrize("harm", [Path.unlink, lambda file: file.write_text("{"), lambda file: file.write_text("{}")])
def test_a_damaged_grid_of_a_whole_study_is_found_again(harm, whole, tmp_path, computed):
    shutil.copytree(whole.store.path, tmp_path / "discs.zarr")
    harm(tmp_path / "discs.zarr" / "run" / "grid.json")
    with pytest.raises(ValueError, match=r"`run/grid.json` is damaged; run the study first"):
        jj.load_study(tmp_path / "discs.zarr").mean("lean at the end")
    assert_same(run(tmp_path / "discs.zarr"), whole)
    assert computed == [0]


def test_a_share_without_a_chunk_takes_those_of_others(whole, tmp_path):
    paths = [tmp_path / f"{k}.zarr" for k in range(4)]
    for k, path in enumerate(paths):
        run(path, shard=(k + 1, 4))
    assert jj.load_study(paths[3]).counts == {}
    Store(paths[1]).skip(40)  # noted, so that what is still missing is not computed with it
    assert_same(jj.merge_studies(paths[3], paths[:3]), whole)
    assert Store(paths[3]).skipped() == (40,)


def test_a_full_disk_is_named_and_the_study_goes_on_when_there_is_room(whole, tmp_path, monkeypatch):
    path = tmp_path / "discs.zarr"
    with monkeypatch.context() as patch:
        _after(patch, 2 + (len(whole.store.columns) + 1) + 3, OSError(errno.ENOSPC, "No space left on device"))
        with pytest.raises(OSError, match="No space left on device; 1 of 3 chunks are kept") as caught:
            run(path)
    assert caught.value.errno == errno.ENOSPC
    assert str(path) in str(caught.value)
    assert_same(run(path), whole)


def test_a_target_that_cannot_be_written_is_named(tmp_path, monkeypatch):
    def refuse(*_, **__):
        raise OSError(errno.EROFS, "Read-only file system")

    monkeypatch.setattr(Path, "mkdir", refuse)
    with pytest.raises(OSError, match=r"Read-only file system\).*discs.zarr"):
        run(tmp_path / "discs.zarr")


def test_ctrl_c_ends_the_chunk_keeps_it_and_says_how_to_go_on(whole, tmp_path, monkeypatch, computed):
    path, before, handler = tmp_path / "discs.zarr", Store.write, signal.getsignal(signal.SIGINT)

    def write(self, number, *what):
        os.kill(os.getpid(), signal.SIGINT)  # in the middle of the second chunk
        before(self, number, *what)

    with monkeypatch.context() as patch:
        patch.setattr(Store, "write", write)
        with pytest.raises(KeyboardInterrupt, match=r"1 of 3 chunks are kept in .*; the same call goes on"):
            run(path)
    assert signal.getsignal(signal.SIGINT) is handler
    assert sum(jj.load_study(path).counts.values()) == 32
    computed.clear()
    assert_same(run(path), whole)
    assert sorted(computed) == [0, 1, 2]


@pytest.mark.parametrize(
    ("change", "named"),
    [
        (lambda path: run(path, seed=4), "design"),
        (lambda path: run(path, max_steps=50), "options (`max_steps`)"),
        (lambda path: run(path, outputs={"lean at the end": lambda motion: motion.q_end[2]}), "outputs"),
        (
            lambda path: jj.Study(jj.models.TiltingDisc(mass=2.0), start={"lean": [0.1]}).run(path),
            "scene (`mass`), design, options (`atol`, `rtol`, `t1`, `ts`)",
        ),
        (lambda path: run(path, save="statistics"), "save"),
    ],
)
def test_a_folder_that_holds_another_study_is_refused_and_left_alone(change, named, whole):
    def content():
        return {file: file.read_bytes() for file in sorted(whole.store.path.rglob("*")) if file.is_file()}

    before = content()
    with pytest.raises(ValueError, match="holds another study") as caught:
        change(whole.store.path)
    assert named in str(caught.value)
    assert content() == before


def test_an_option_is_not_named_for_the_place_of_a_function_in_memory(tmp_path):
    def study(**options):
        inputs = {"speed": lambda t: 1.0 + t, "push": 0.5}
        return jj.Study(OnBelt(), start={"y": [0.1]}).run(tmp_path / "belt.zarr", t1=0.1, inputs=inputs, progress=False, **options)

    study()
    with pytest.raises(ValueError, match=r"what differs: options \(`rtol`\); give"):
        study(rtol=1e-6)


def test_a_folder_of_something_else_is_refused_and_left_alone(tmp_path):
    (tmp_path / "letters").mkdir()
    (tmp_path / "letters" / "one.txt").write_text("Dear")
    with pytest.raises(ValueError, match="is not a study"):
        run(tmp_path / "letters")
    with pytest.raises(ValueError, match="is a file"):
        run(tmp_path / "letters" / "one.txt")
    assert [file.name for file in (tmp_path / "letters").iterdir()] == ["one.txt"]
    with pytest.raises(ValueError, match="does not exist"):
        jj.load_study(tmp_path / "nothing")


def test_other_chunks_than_the_study_began_with_are_refused(whole):
    with pytest.raises(ValueError, match="begun with chunks of 32 lanes"):
        run(whole.store.path, chunk=64)


@pytest.mark.skipif(files.fcntl is None, reason="no locks on this system")
def test_a_second_run_into_one_folder_is_refused_while_the_first_lives(whole):
    with whole.store.lock(), pytest.raises(jj.InUseError, match=f"in use by process {os.getpid()} on "):
        run(whole.store.path)
    (whole.store.path / "run" / "lock").write_text(json.dumps({"pid": 1, "host": "elsewhere"}))  # what a dead run leaves
    assert run(whole.store.path).complete


def test_a_newer_format_is_refused(whole, tmp_path):
    path = tmp_path / "discs.zarr"
    run(path)
    about = json.loads((path / "run" / "study.json").read_text())
    (path / "run" / "study.json").write_text(json.dumps(about | {"format": 2}))
    with pytest.raises(ValueError, match="has format 2, this version of jourdain-jax reads 1"):
        run(path)
    (path / "run" / "study.json").write_text("{")
    with pytest.raises(ValueError, match="is damaged"):
        run(path)


def test_other_versions_are_said(whole, tmp_path):
    path = tmp_path / "discs.zarr"
    run(path)
    about = json.loads((path / "run" / "study.json").read_text())
    about["versions"]["jax"] = "0.1.2"
    (path / "run" / "study.json").write_text(json.dumps(about))
    with pytest.warns(UserWarning, match=r"other versions: jax 0.1.2 \(now "):
        run(path)


def test_clocks_do_not_matter(whole, tmp_path, monkeypatch):
    run(tmp_path / "discs.zarr")
    for file in (tmp_path / "discs.zarr").rglob("*"):
        os.utime(file, (4e9, 4e9))  # in a hundred years
    assert_same(run(tmp_path / "discs.zarr"), whole)


def test_what_is_not_installed_is_named_with_its_extra(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "zarr", None)
    with pytest.raises(ImportError, match=r"needs the package `zarr`, .*jourdain-jax\[ensembles\]"):
        run(tmp_path / "discs.zarr")


def test_a_function_counts_by_what_it_does():
    def made(factor, text="x"):
        return lambda motion: factor * motion.q_end[0] if text in {"a", "b", "x"} else 0.0

    assert digest(made(2.0)) == digest(made(2.0))
    assert len({digest(made(2.0)), digest(made(3.0)), digest(made(2.0, "y")), digest(lambda motion: motion.q_end[0])}) == 4
    assert digest(jj.models.TiltingDisc()) != digest(jj.models.TiltingDisc(mass=2.0))
    assert digest(np.arange(3.0)) != digest(np.arange(3))


class _Slots:
    __slots__ = ("factor",)

    def __init__(self, factor):
        self.factor = factor


OBJECTS = {
    "a namespace": lambda x: SimpleNamespace(factor=x),
    "a fraction": Fraction,
    "a range": range,
    "a deque": lambda x: deque([x]),
    "slots": _Slots,
    "a polynomial": lambda x: np.polynomial.Polynomial([0.0, x]),
    "a spline": lambda x: CubicSpline(np.arange(4.0), x * np.arange(4.0) ** 2),
    "a ufunc": lambda x: (np.sin, np.cos)[x - 2],
    "objects in an array": lambda x: np.array([x, "text"], object),
    "a key": jax.random.key,
    "a gradient": lambda x: jax.grad(lambda q: x * q),
    "lanes of lanes": lambda x: jax.vmap(jax.vmap(lambda q: x * q)),
    "what ravel_pytree makes": lambda x: ravel_pytree({str(x): jnp.ones(2)})[1],
    "lists in lists": lambda x: [[[[[[[[[[[[x]]]]]]]]]]]],
}


@pytest.mark.parametrize("made", OBJECTS.values(), ids=OBJECTS)
def test_an_object_that_a_function_reads_counts_by_its_content(made):
    """With the old numbers it would be taken for the study whose results are there."""

    def output(x):
        return lambda motion: x(motion)

    assert digest(output(made(2))) == digest(output(made(2)))
    assert digest(output(made(2))) != digest(output(made(3)))


@pytest.mark.parametrize("pair", [lambda x: [x, x], lambda x: deque([x, x]), lambda x: SimpleNamespace(a=x, b=x)])
def test_an_object_that_is_met_in_very_many_places_is_looked_at_once(pair):
    def nested(number):
        for _ in range(16):
            number = pair(number)
        return number

    assert digest(nested(1)) == digest(nested(1)) != digest(nested(2))


PENDULUM = """<robot name="arm"><link name="base"/><link name="arm"><inertial><origin xyz="0 0 -0.5"/><mass value="1"/>
<inertia ixx="0.1" iyy="0.1" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial></link><joint name="pivot" type="continuous">
<parent link="base"/><child link="arm"/><axis xyz="{}"/></joint></robot>"""


def test_scenes_of_other_tools_count_by_what_they_were_made_from(tmp_path):
    """Their classes bear a name of this package, and hold the axis of a joint, or SymPy's expressions."""

    def of_urdf(axis):
        (tmp_path / "arm.urdf").write_text(PENDULUM.format(axis))
        return jj.from_urdf(tmp_path / "arm.urdf")()

    def counted(scene):
        return digest((type(scene), scene))

    assert counted(of_urdf("0 1 0")) == counted(of_urdf("0 1 0")) != counted(of_urdf("1 0 0"))
    systems = pytest.importorskip("sympy_systems")
    rolling, slipping = (lambda make=make: jj.from_sympy(*make())() for make in (systems.rolling_disc, systems.slipping_disc))
    assert counted(rolling()) == counted(rolling()) != counted(slipping())
    assert counted(slipping()) == counted(slipping())


def test_what_a_function_does_not_read_does_not_count(monkeypatch):
    """A global with the name of an attribute, as a loop leaves one behind, and a list that counts calls."""
    calls = []
    monkeypatch.setitem(globals(), "q_end", 1)

    def output(motion):
        calls.append(1)
        return motion.q_end[0]

    before = digest(output)
    globals()["q_end"] = 2
    calls.append(1)
    assert digest(output) == before


def test_what_a_function_reads_of_a_module_of_the_user_counts(monkeypatch):
    module, inner = ModuleType("users_module"), ModuleType("users_module.inner")
    module.inner, module.factor, module.unread, inner.helper = inner, 2.0, 1.0, lambda x: 2.0 * x
    monkeypatch.setitem(globals(), "users_module", module)
    exec("def output(motion): return users_module.inner.helper(users_module.factor * motion.q_end[0])", globals(), found := {})
    before = digest(found["output"])
    module.unread = 3.0
    assert digest(found["output"]) == before
    module.factor = 3.0
    changed = digest(found["output"])
    inner.helper = lambda x: 3.0 * x
    assert len({before, changed, digest(found["output"])}) == 3


def test_a_study_that_cannot_be_sent_to_other_processes_says_so(tmp_path):
    with pytest.raises(ValueError, match="at the top level of a module"):
        run(tmp_path / "discs.zarr", outputs={"lean": lambda motion: motion.q_end[3]}, processes=2)
    with pytest.raises(ValueError, match="`processes` is 0"):
        run(tmp_path / "discs.zarr", processes=0)


# Other processes. ------------------------------------------------------------------------------------------------

SCRIPT = """
import sys
import jourdain_jax as jj
from jourdain_jax.ensembles import task

def spread(motion, allowed=frozenset({"lean", "yaw", "spin", "x"})):
    return motion.q_end[3] - motion.q_end[2] if "lean" in allowed and "q" not in {"a", "b", "c"} else 0.0

if __name__ == "__main__":
    study = jj.Study(jj.models.TiltingDisc(), start={"lean": jj.Uniform(-0.5, 0.5), "spin_rate": jj.Uniform(-4.0, 0.0)}, samples=400_000, seed=3)
    outputs = {"lean": jj.End("lean"), "spread": spread}
    study.run(sys.argv[1], t1=1.0, rtol=1e-6, atol=1e-6, progress=False, outputs=outputs, processes=int(sys.argv[2]))
"""


def _started(folder, name, processes=1):
    (folder / "script.py").write_text(SCRIPT)
    return subprocess.Popen([sys.executable, "script.py", name, str(processes)], cwd=folder)


def _chunks(path):
    return len(list(path.glob("run/chunks/[0-9]*")))


def _wait_for(process, path, count):
    while process.poll() is None and _chunks(path) < count:
        time.sleep(1e-3)


def _workers(process):
    return [other for other in psutil.Process(process.pid).children() if "spawn_main" in " ".join(other.cmdline())]


@pytest.mark.slow
def test_workers_end_with_a_run_that_is_killed_while_they_start(tmp_path):
    process = _started(tmp_path, "discs.zarr", 2)
    workers = []
    while process.poll() is None and not any(worker.cpu_times().user > 0.5 for worker in workers):  # until one has begun to import
        time.sleep(1e-2)
        workers = _workers(process)
    process.kill()
    process.wait()
    _, alive = psutil.wait_procs(workers, timeout=60.0)
    assert not alive
    assert _chunks(tmp_path / "discs.zarr") == 0


@pytest.mark.slow
def test_runs_and_workers_that_are_killed_lose_and_repeat_nothing(tmp_path):
    """Twenty times, at random moments: every other time the run itself, otherwise one of its workers."""
    generator, path = np.random.default_rng(0), tmp_path / "discs.zarr"
    for kill in range(20):
        process = _started(tmp_path, "discs.zarr", 1 + kill % 2)
        _wait_for(process, path, _chunks(path) + int(generator.integers(1, 6)))
        time.sleep(generator.uniform(0.0, 0.05))
        assert process.poll() is None
        if kill % 2:
            workers = _workers(process)
            workers[int(generator.integers(len(workers)))].kill()
            _wait_for(process, path, _chunks(path) + 4)
        process.kill()
        process.wait()
    before = {file.name: file.stat().st_mtime_ns for file in path.glob("run/chunks/[0-9]*")}
    assert _started(tmp_path, "discs.zarr").wait() == 0
    assert all((path / "run" / "chunks" / name).stat().st_mtime_ns == time for name, time in before.items())  # none is done twice
    assert _started(tmp_path, "whole.zarr").wait() == 0
    assert_same(jj.load_study(path), jj.load_study(tmp_path / "whole.zarr"))
