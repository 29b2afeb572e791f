"""What happens to studies that are killed, interrupted, damaged, out of room, or run where they should not
be.
"""

import errno
import json
import math
import os
import shutil
import signal
import subprocess
import sys
import time
import warnings
from collections import Counter, deque
from dataclasses import replace
from fractions import Fraction
from itertools import combinations
from pathlib import Path
from types import ModuleType, SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import psutil
import pytest
from jax.flatten_util import ravel_pytree
from refusals import refused
from scipy.interpolate import CubicSpline
from test_inputs import OnBelt
from test_studies import assert_same

import jourdain_jax as jj
from jourdain_jax.calculus.files import write_whole
from jourdain_jax.scene.digests import digest
from jourdain_jax.studies import End, InUseError, Uniform, merge_studies, records, store, workers
from jourdain_jax.studies.run import Runner, opened
from jourdain_jax.studies.store import Store

COUNT = 90  # lanes, in three chunks
pytestmark = pytest.mark.usefixtures("small_blocks")


def study(seed=3, memory=None, **more):
    scene = jj.models.TiltingDisc()
    lean = Uniform(-0.5, 0.5)
    scene = scene if memory is None else jj.build(scene, memory=memory)
    return jj.Study(
        scene, start={"lean": lean, "spin_rate": Uniform(-4.0, 0.0)}, samples=COUNT, seed=seed, **more
    )


def run(path, seed=3, memory=None, **options):
    return study(seed, memory).run(path, t1=1.0, rtol=1e-6, atol=1e-6, progress=False, **options)


@pytest.fixture(scope="module")
def whole(tmp_path_factory, small_blocks):
    return run(tmp_path_factory.mktemp("whole") / "discs.zarr")


@pytest.fixture
def path(whole, tmp_path):
    """A folder of the whole study, to be harmed."""
    return shutil.copytree(whole.store.path, tmp_path / "discs.zarr")


@pytest.fixture
def computed(monkeypatch):
    """Numbers of the blocks that are computed, in order."""
    numbers, before = [], Runner.run_block
    monkeypatch.setattr(
        Runner, "run_block", lambda self, number: numbers.append(number) or before(self, number)
    )
    return numbers


class Killed(BaseException):
    """As if the process ended here."""


def _after(monkeypatch, count, error):
    """The files of a store are written until so many have been; then `error` is raised, in the middle of the
    next.
    """
    left = [count]

    def write(path, content, **how):
        left[0] -= 1
        if left[0] < 0:
            path.with_name(f".{path.name}.half").write_bytes(content[: len(content) // 2])
            raise error
        write_whole(path, content, **how)

    for module in (store, records):
        monkeypatch.setattr(module, "write_whole", write)


def test_a_run_killed_at_any_file_goes_on_to_the_same_bits(whole, tmp_path, monkeypatch, computed):
    each = len(whole.store.columns) + 1  # per chunk its arrays and its receipt
    for number in (3, 3 + 3 * each):  # 4 for study, grid, the manifest of each
        path = tmp_path / f"killed{number}"
        with monkeypatch.context() as patch:
            _after(patch, number, Killed())
            with pytest.raises(Killed):
                run(path)
        computed.clear()
        assert_same(run(path), whole)
        begun = max(0, number - 4) // each  # whole chunks
        assert set(computed) == {0, *range(begun, 3)}  # the first block is the yardstick of every process
    assert not [entry for entry in tmp_path.iterdir() if entry.name.startswith(".")]


def test_a_second_run_computes_nothing_whatever_clocks_say(whole, tmp_path, computed):
    for file in whole.store.path.rglob("*"):
        os.utime(file, (4e9, 4e9))  # in a hundred years
    assert_same(run(whole.store.path), whole)
    assert computed == []
    assert whole.complete


@pytest.mark.parametrize("harm", ["one bit", "gone", "receipt cut short", "of another chunk"])
def test_a_damaged_chunk_is_found_and_computed_again(harm, whole, path, computed):
    held = path / "lean at the end" / "c" / "1"
    content = held.read_bytes()
    if harm == "one bit":
        held.write_bytes(content[:100] + bytes([content[100] ^ 4]) + content[101:])
    elif harm == "gone":
        held.unlink()
    elif harm == "of another chunk":
        held.write_bytes((path / "lean at the end" / "c" / "0").read_bytes())
    else:
        receipt = path / "run" / "chunks" / "1"
        receipt.write_bytes(receipt.read_bytes()[:-1])
    if harm == "one bit":
        refused(
            r"`lean at the end` is damaged in samples .*run the study again",
            lambda: jj.load_study(path).to_xarray(),
        )
    with pytest.warns(UserWarning, match="1 chunks of .* are damaged and are computed again: 1"):
        found = run(path)
    assert sorted(computed) == [0, 1]
    assert_same(found, whole)


def test_a_study_of_which_no_receipt_is_left_has_no_numbers(path):
    for receipt in (path / "run" / "chunks").iterdir():
        receipt.write_bytes(b"torn")
    refused(f"no chunk of `{path}` is finished", lambda: jj.load_study(path).statistics)


def test_a_damaged_grid_of_a_whole_study_is_found_again(whole, path, computed):
    for harm in (Path.unlink, lambda file: file.write_text("{"), lambda file: file.write_text("{}")):
        harm(path / "run" / "grid.json")
        refused(
            r"`run/grid.json` is damaged; run the study again",
            lambda: jj.load_study(path).mean("lean at the end"),
        )
        computed.clear()
        assert_same(run(path), whole)
        assert computed == [0]


def test_a_share_without_a_chunk_takes_those_of_others(whole, tmp_path):
    paths = [tmp_path / f"{k}.zarr" for k in range(4)]
    for k, path in enumerate(paths):
        run(path, shard=(k + 1, 4))
    shares = [jj.load_study(path) for path in paths]
    assert not any(share.complete for share in shares)
    assert "run it again" in str(shares[0])
    assert shares[3].counts == {}
    refused("not a share", merge_studies, paths[0], [run(tmp_path / "other.zarr", seed=4).store.path])
    assert_same(merge_studies(paths[3], paths[:3]), whole)


def test_a_full_disk_is_named_and_the_study_goes_on_when_there_is_room(whole, tmp_path, monkeypatch):
    path = tmp_path / "discs.zarr"
    with monkeypatch.context() as patch:
        _after(
            patch, 4 + (len(whole.store.columns) + 1) + 3, OSError(errno.ENOSPC, "No space left on device")
        )
        with pytest.raises(OSError, match="No space left on device; 1 of 3 chunks are kept") as caught:
            run(path)
    assert caught.value.errno == errno.ENOSPC
    assert str(path) in str(caught.value)
    assert_same(run(path), whole)


@pytest.mark.parametrize(
    ("samples", "options"), [(10**12, {}), (3 * 10**9, {"keep_every": 1}), (10**13, {"keep_every": 1000})]
)
def test_a_study_that_its_disk_cannot_hold_is_refused_before_it_begins(samples, options, tmp_path):
    many = jj.Study(jj.models.TiltingDisc(), start={"lean": Uniform(-0.5, 0.5)}, samples=samples)
    refused(
        r"the results take [\d,.]+ GB, and the disk of `.*discs.zarr` has [\d,.]+ GB",
        many.run,
        tmp_path / "new" / "discs.zarr",
        t1=1.0,
        ts=np.linspace(0.0, 1.0, 200),
        progress=False,
        **options,
    )
    assert not os.listdir(tmp_path)


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
        with pytest.raises(KeyboardInterrupt, match=r"1 of 3 chunks are kept in .*; the same call continues"):
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
    assert named in refused("contains another study", change, whole.store.path)
    assert content() == before


def test_an_option_is_not_named_for_the_place_of_a_function_in_memory(tmp_path):
    def study(**options):
        inputs = {"speed": lambda t: 1.0 + t, "push": 0.5}
        return jj.Study(OnBelt(), start={"y": [0.1]}).run(
            tmp_path / "belt.zarr", t1=0.1, inputs=inputs, progress=False, **options
        )

    study()
    refused(r"with different options \(`rtol`\); give", study, rtol=1e-6)


def test_a_folder_of_something_else_is_refused_and_left_alone(tmp_path):
    folder = tmp_path / "letters"
    folder.mkdir()
    (folder / "one.txt").write_text("Dear")
    refused("is not a study", run, folder)
    refused("is a file", run, folder / "one.txt")
    assert [file.name for file in folder.iterdir()] == ["one.txt"]
    refused("does not exist", jj.load_study, tmp_path / "nothing")


def test_other_chunks_than_the_study_began_with_are_refused(whole):
    refused("begun with chunks of 32 samples", run, whole.store.path, chunk=64)


@pytest.mark.skipif(records.fcntl is None, reason="no locks on this system")
def test_a_second_run_into_one_folder_is_refused_while_the_first_lives(whole):
    with whole.store.lock(), pytest.raises(InUseError, match=f"in use by process {os.getpid()} on "):
        run(whole.store.path)
    (whole.store.path / "run" / "lock").write_text(
        json.dumps({"pid": 1, "host": "elsewhere"})
    )  # what a dead run leaves
    assert run(whole.store.path).complete


def _changed(path, name, **entries):
    """The JSON of a file with other entries, and a manifest that knows them: as a hostile hand, or another
    version, would write it.
    """
    file, listed = path / "run" / name, path / "run" / "manifest.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | entries))
    digests = json.loads(listed.read_text())["digests"] | {f"run/{name}": records.digest(file.read_bytes())}
    records.write_manifest(path, digests)


def test_another_format_is_refused(path):
    _changed(path, "study.json", format=3)
    for read in (run, jj.load_study):
        refused(
            "has format 3, this version of jourdain-jax reads 2; use the version that wrote it", read, path
        )
    (path / "run" / "manifest.json").unlink()  # as the first format, which had none
    (path / "run" / "study.json").write_text(json.dumps({"format": 1}))
    refused("has format 1, this version of jourdain-jax reads 2", jj.load_study, path)


def test_numbers_of_a_study_are_within_their_ranges(whole, path):
    for entry in ("samples", "chunk", "block"):
        for value in (10**18, 10**30, 1e18, 0, -1, 90.0, True, "90", None, [90]):
            _changed(path, "study.json", **{entry: value})
            said = rf"study.json` is damaged \(`{entry}` is .*, expected a whole number from 1 to"
            refused(said, jj.load_study, path)
        _changed(path, "study.json", **{entry: whole.store.study[entry]})
    _changed(path, "study.json", samples=2**52)
    refused("samples are more than 16777216 chunks of 32", jj.load_study, path)


def test_numbers_of_a_grid_are_within_their_ranges(whole, path):
    right, n = whole.store.read_grid(), len(whole.outputs)
    changes = [("centre", [x] * n) for x in (math.nan, math.inf, [0.0])]
    for name, values in (*changes, ("high", [-1e9] * n), ("low", [])):
        _changed(path, "grid.json", **right | {name: values})
        _with_receipts_of(path)
        refused(
            r"grid of the statistics is .*, expected finite numbers in order",
            lambda: jj.load_study(path).mean(whole.outputs[0]),
        )


def _with_receipts_of(path):
    """Receipts that belong to the grid that is there, as a hostile hand would write them."""
    opened = Store(path)
    for number in opened.receipts():
        file = path / "run" / "chunks" / str(number)
        found = store.Receipt.unpacked(file.read_bytes(), len(opened.outputs))
        file.write_bytes(replace(found, of=(opened.identity, opened._digests["run/grid.json"])).packed())


def test_chunks_of_another_grid_do_not_count(whole, path, computed):
    """As where two machines whose numbers differ found the grid at the same time: sums about another centre
    would give another mean.
    """
    _changed(path, "grid.json", centre=whole.store.read_grid()["high"])
    with pytest.warns(UserWarning, match=r"samples 0 to 31, 32 to 63, 64 to 89 of .* are omitted"):
        found = jj.load_study(path)
    assert (found.complete, found.counts) == (False, {})
    with (
        pytest.warns(UserWarning, match="3 chunks of .* are damaged and are computed again"),
        pytest.warns(UserWarning, match="have other bits here"),
    ):
        assert run(path).complete
    assert sorted(set(computed)) == [0, 1, 2]


def test_other_versions_are_said(whole, path):
    _changed(path, "study.json", versions=whole.store.study["versions"] | {"jax": "0.1.2"})
    with pytest.warns(UserWarning, match=r"other versions: jax 0.1.2 \(now "):
        run(path)


def test_a_folder_that_is_moved_while_a_study_runs_is_named(tmp_path, monkeypatch, whole):
    path, before = tmp_path / "discs.zarr", Store.write

    def write(self, number, *what):
        if number == 1:
            path.rename(tmp_path / "moved.zarr")
        before(self, number, *what)

    for options in ({}, {"keep_every": 1}):
        with monkeypatch.context() as patch:
            patch.setattr(Store, "write", write)
            with pytest.raises(
                OSError, match=r"the folder is gone: it was moved or removed while the study ran.*discs.zarr"
            ):
                run(path, **options)
        assert not path.exists()
        assert run(tmp_path / "moved.zarr", **options).complete
        shutil.rmtree(tmp_path / "moved.zarr")
    with monkeypatch.context() as patch:
        patch.setattr(
            Store, "write_grid", lambda self, grid: path.rename(tmp_path / "moved.zarr") and Store(path)
        )
        refused("does not exist", run, path)


# Every file of a folder, changed in every way that is tried: the right answer, or a named error or warning. -


def _harms(content, generator, count):
    """Changed contents of a file: `count` bits, twice as many digits; cut short, made longer, emptied."""
    places = generator.integers(len(content), size=count).tolist() if content else []
    put = lambda place, byte: content[:place] + bytes([byte]) + content[place + 1 :]
    for place in places:
        yield f"a bit of byte {place}", put(place, content[place] ^ 1 << int(generator.integers(8)))
    digits = [place for place, byte in enumerate(content) if 48 <= byte <= 57]
    for place in generator.permutation(digits)[: 2 * count].astype(int).tolist():
        digit = (content[place] - 48 + int(generator.integers(1, 10))) % 10
        yield f"the digit at {place}", put(place, 48 + digit)
    yield "the end", content[: int(generator.integers(len(content) or 1))]
    yield "nothing left", b""
    yield "more", content + content[-7:] + b" "


def _answers(path):
    """All that a folder says, read without its scene."""
    found = jj.load_study(path)
    numbers = [(found.mean(name), found.deviation(name), found.quantile(name, 0.5)) for name in found.outputs]
    arrays = {name: array.values.tobytes() for name, array in found.to_xarray().load().variables.items()}
    return found.complete, found.counts, found.failed.tolist(), repr(numbers), arrays


def _is_right_or_said(path, right):
    """Whether the answers are right (True), or an error or a warning names the folder (False); an
    AssertionError otherwise.
    """
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        try:
            found = _answers(path)
        except ValueError as error:
            words = str(error)
        else:
            if found == right:
                return True
            words = " ".join(str(warning.message) for warning in said)
    assert path.name in words, words or found
    return False


@pytest.mark.parametrize(
    ("options", "count"),
    [({}, 2), ({"save": "statistics"}, 6), ({"keep_every": 2, "ts": np.linspace(0.0, 1.0, 3)}, 6)],
)
def test_whatever_happens_to_a_file_of_a_study_no_other_number_comes_out(tmp_path, options, count):
    generator = np.random.default_rng(1)
    path = tmp_path / "discs.zarr"
    run(path, outputs={"last lean": End("lean")}, **options)
    right = _answers(path)
    seen = []
    for file in sorted(file for file in path.rglob("*") if file.is_file()):
        content = file.read_bytes()
        for what, harmed in _harms(content, generator, count):
            if harmed == content:
                continue
            file.write_bytes(harmed)
            try:
                seen.append(_is_right_or_said(path, right))
            except AssertionError as error:
                raise AssertionError(f"{what} of {file.relative_to(path)} changed: {error}") from error
        file.unlink()
        if file.parent.name == "chunks":  # as if the chunk had not been computed yet
            assert not _answers(path)[0]
        else:
            _is_right_or_said(path, right)
        file.write_bytes(content)
    assert len(seen) > 50
    assert np.mean(seen) < 0.1  # the lock holds no number; most else is noticed
    assert _answers(path) == right


def test_whatever_files_of_a_study_are_exchanged_no_other_number_comes_out(tmp_path):
    path, other = tmp_path / "discs.zarr", tmp_path / "other.zarr"
    for folder, seed in ((path, 3), (other, 4)):
        run(folder, seed=seed, outputs={"lean": End("lean")})
    right = _answers(path)
    names = [
        file.relative_to(path) for file in sorted(path.rglob("*")) if file.is_file() and file.name != "lock"
    ]
    contents = {name: (path / name).read_bytes() for name in names}
    alike = [
        (a, b)
        for a, b in combinations(names, 2)
        if len(contents[a]) == len(contents[b]) and contents[a] != contents[b]
    ]  # chunks, columns, receipts
    assert len(alike) > 60
    for first, second in np.random.default_rng(0).permutation(alike)[:60]:
        (path / first).write_bytes(contents[second])
        (path / second).write_bytes(contents[first])
        _is_right_or_said(path, right)
        for name in (first, second):
            (path / name).write_bytes(contents[name])
    for name in names:  # from another study of the same kind
        (path / name).write_bytes((other / name).read_bytes())
        _is_right_or_said(path, right)
        (path / name).write_bytes(contents[name])
    assert _answers(path) == right


# Processes that die. ----------------------------------------------------------------------------------------


def _with_deaths(path, deadly, first_block=False):
    """The study, as processes compute it that die on the chunks `deadly`, whose numbers are asked for; with
    the number of deaths.
    """
    owned = study().task(t1=1.0, rtol=1e-6, atol=1e-6)
    opened_store, deaths, runners = opened(owned, path, None, ""), Counter(), []

    def compute(numbers, alone):
        for number in numbers:
            if number in deadly or (first_block and not runners):
                deaths[number] += 1
                return [number]
            runners.append(runners[0] if runners else Runner(owned, opened_store))
            yield runners[0].run(number)
        return []

    list(
        workers.whatever_dies(
            opened_store, range(opened_store.chunks), lambda: False, compute, workers.MOST_DEATHS - 1
        )
    )
    return deaths


def test_chunks_on_which_processes_died_three_times_are_named_and_the_study_goes_on(whole, tmp_path):
    path = tmp_path / "discs.zarr"
    with pytest.warns(
        UserWarning,
        match=r"died 3 times on samples 32 to 63, 64 to 89 of .*omitted; all others are stored.*memory=",
    ) as said:
        assert _with_deaths(path, (1, 2)) == {1: 3, 2: 3}
    assert len(said) == 1
    found = jj.load_study(path)
    assert not found.complete
    assert sum(found.counts.values()) == 32
    assert_same(run(path), whole)  # the same call tries again


def test_a_first_block_on_which_processes_die_ends_the_study(tmp_path):
    """Every process begins with it: all others would die, too."""
    with pytest.raises(
        RuntimeError,
        match=r"processes died 3 times on samples 0 to 31 of .*; every process computes these first",
    ):
        _with_deaths(tmp_path / "discs.zarr", (), first_block=True)


def test_what_is_not_installed_is_named_with_its_extra(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "zarr", None)
    with pytest.raises(ImportError, match=r"needs the package `zarr`, .*jourdain-jax\[studies\]"):
        run(tmp_path / "discs.zarr")


def test_a_function_counts_by_what_it_does():
    def made(factor, text="x"):
        return lambda motion: factor * motion.q_end[0] if text in {"a", "b", "x"} else 0.0

    assert digest(made(2.0)) == digest(made(2.0))
    others = (made(2.0), made(3.0), made(2.0, "y"), lambda motion: motion.q_end[0])
    assert len(set(map(digest, others))) == 4
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
    counted = lambda x: digest(lambda motion: x(motion))
    assert counted(made(2)) == counted(made(2)) != counted(made(3))


PENDULUM = """<robot name="arm"><link name="base"/><link name="arm">
<inertial><origin xyz="0 0 -0.5"/><mass value="1"/>
<inertia ixx="0.1" iyy="0.1" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="pivot" type="continuous"><parent link="base"/><child link="arm"/><axis xyz="{}"/>
</joint></robot>"""


def test_scenes_of_other_tools_count_by_what_they_were_made_from(tmp_path):
    """Their classes bear a name of this package, and hold the axis of a joint, or SymPy's expressions."""

    def of_urdf(axis):
        (tmp_path / "arm.urdf").write_text(PENDULUM.format(axis))
        return jj.from_urdf(tmp_path / "arm.urdf")()

    def counted(scene):
        return digest((type(scene), scene))

    assert counted(of_urdf("0 1 0")) == counted(of_urdf("0 1 0")) != counted(of_urdf("1 0 0"))
    import sympy_systems as systems

    rolling, slipping = (
        lambda make=make: jj.from_sympy(*make())() for make in (systems.rolling_disc, systems.slipping_disc)
    )
    assert counted(rolling()) == counted(rolling()) != counted(slipping())
    assert counted(slipping()) == counted(slipping())


def test_what_a_function_does_not_read_does_not_count(monkeypatch):
    """A global with the name of an attribute, as a loop leaves one behind."""
    monkeypatch.setitem(globals(), "q_end", 1)

    def output(motion):
        return motion.q_end[0]

    before = digest(output)
    globals()["q_end"] = 2
    assert digest(output) == before


def test_what_a_function_reads_of_a_module_of_the_user_counts(monkeypatch):
    module, inner = ModuleType("users_module"), ModuleType("users_module.inner")
    module.inner, module.factor, module.unread, inner.helper = inner, 2.0, 1.0, lambda x: 2.0 * x
    monkeypatch.setitem(globals(), "users_module", module)
    exec(
        "def output(motion): return users_module.inner.helper(users_module.factor * motion.q_end[0])",
        globals(),
        found := {},
    )
    before = digest(found["output"])
    module.unread = 3.0
    assert digest(found["output"]) == before
    module.factor = 3.0
    changed = digest(found["output"])
    inner.helper = lambda x: 3.0 * x
    assert len({before, changed, digest(found["output"])}) == 3


def test_a_study_that_cannot_be_sent_to_other_processes_says_so(tmp_path):
    refused(
        "at the top level of a module",
        run,
        tmp_path / "discs.zarr",
        outputs={"lean": lambda motion: motion.q_end[3]},
        processes=2,
    )
    refused("`processes` is 0", run, tmp_path / "discs.zarr", processes=0)


# Other processes. -------------------------------------------------------------------------------------------

SCRIPT = """
import sys
import jourdain_jax as jj
from jourdain_jax.studies import outputs


def spread(motion, allowed=frozenset({"lean", "yaw", "spin", "x"})):
    return motion.q_end[3] - motion.q_end[2] if "lean" in allowed and "q" not in {"a", "b", "c"} else 0.0


if __name__ == "__main__":
    study = jj.Study(
        jj.models.TiltingDisc(),
        start={"lean": jj.studies.Uniform(-0.5, 0.5), "spin_rate": jj.studies.Uniform(-4.0, 0.0)},
        samples=400_000,
        seed=3,
    )
    outputs = {"lean": jj.studies.End("lean"), "spread": spread}
    study.run(
        sys.argv[1], t1=1.0, rtol=1e-6, atol=1e-6, progress=False, outputs=outputs, processes=int(sys.argv[2])
    )
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
    return [
        other for other in psutil.Process(process.pid).children() if "spawn_main" in " ".join(other.cmdline())
    ]


def test_workers_end_with_a_run_that_is_killed_while_they_start(tmp_path):
    process = _started(tmp_path, "discs.zarr", 2)
    workers = []
    while process.poll() is None and not any(
        worker.cpu_times().user > 0.5 for worker in workers
    ):  # until one has begun to import
        time.sleep(1e-2)
        workers = _workers(process)
    process.kill()
    process.wait()
    _, alive = psutil.wait_procs(workers, timeout=60.0)
    assert not alive
    assert _chunks(tmp_path / "discs.zarr") == 0


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
    assert all(
        (path / "run" / "chunks" / name).stat().st_mtime_ns == time for name, time in before.items()
    )  # none is done twice
    assert _started(tmp_path, "whole.zarr").wait() == 0
    assert_same(jj.load_study(path), jj.load_study(tmp_path / "whole.zarr"))
