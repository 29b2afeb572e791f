"""Studies that keep to a stated amount of memory."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from refusals import refused
from test_study_faults import run, study

import jourdain_jax as jj
from jourdain_jax.studies import memory

pytestmark = pytest.mark.usefixtures("small_blocks")
TIMES = {"ts": np.linspace(0.0, 1.0, 11), "keep_every": 1}


@pytest.mark.parametrize(
    ("text", "count"),
    [
        ("2GB", 2_000_000_000),
        ("1.5 gb", 1_500_000_000),
        ("512 MiB", 2**29),
        (800e6, 800_000_000),
        (10**9, 10**9),
    ],
)
def test_an_amount_is_read(text, count):
    assert jj.build(jj.models.TiltingDisc(), memory=text).memory == count


@pytest.mark.parametrize(
    "wrong", ["much", "2 XB", "-1GB", True, "nan GB", float("inf"), float("nan"), "0.GBs"]
)
def test_what_is_no_amount_is_refused(wrong):
    refused(
        r"`memory` is .*, expected a number of bytes, or a text such as '2GB'",
        jj.build,
        jj.models.TiltingDisc(),
        memory=wrong,
    )


def bounded(monkeypatch, room):
    """A bound that leaves so many bytes for blocks and chunks, whatever this process holds."""
    monkeypatch.setattr(memory, "resident", lambda: 300e6)
    monkeypatch.setattr(memory, "COMPILED", 0.0)
    return int(300e6 + room)


def test_blocks_and_chunks_fit_into_the_bound_and_lanes_are_the_same(tmp_path, monkeypatch):
    free = run(tmp_path / "free.zarr", **TIMES)
    assert (free.store.study["block"], free.store.chunk) == (32, 32)
    of_lane = study().task(t1=1.0, **TIMES).bytes_of_lane
    tight = run(
        tmp_path / "tight.zarr", memory=bounded(monkeypatch, 2 * memory.BLOCKS * 8 * of_lane), **TIMES
    )
    assert (tight.store.study["block"], tight.store.chunk) == (8, 8)
    one, other = free.to_xarray().load(), tight.to_xarray().load()
    for name in one.variables:
        assert_allclose(one[name].values, other[name].values, rtol=1e-12, atol=1e-14, err_msg=name)
    assert_allclose(free.statistics.mean, tight.statistics.mean, rtol=1e-12, atol=1e-14)


def test_a_study_goes_on_with_the_blocks_with_which_it_began(tmp_path, monkeypatch):
    of_lane = study().task(t1=1.0, **TIMES).bytes_of_lane
    bound = bounded(monkeypatch, 2 * memory.BLOCKS * 16 * of_lane)
    whole = run(tmp_path / "whole.zarr", memory=bound, **TIMES)
    path = tmp_path / "begun.zarr"
    run(path, memory=bound, shard=(1, 2), **TIMES)
    begun = run(path, **TIMES)  # of the scene, without a bound
    assert begun.complete
    assert begun.store.study["block"] == 16
    assert_array_equal(begun.statistics.mean, whole.statistics.mean)
    refused(
        "blocks of 16 samples and chunks of 16 take up to",
        run,
        path,
        memory=bounded(monkeypatch, 1000),
        **TIMES,
    )


def test_a_rollout_runs_fewer_lanes_at_once_where_its_model_has_little_memory(capsys):
    model, starts = (
        jj.build(jj.models.TiltingDisc(), memory=4 * 3 * 8 * 201 * 12),
        {"lean": np.linspace(0.1, 0.3, 5)},
    )  # room for three lanes
    some = jj.rollout(model, starts)
    assert "5/5" in capsys.readouterr().err  # a bar, for several chunks
    assert_array_equal(some.lanes.q, jj.rollout(model.scene, starts).lanes.q)


def test_too_little_is_refused_before_anything_is_written(tmp_path):
    refused(
        "`memory` allows 100 MB for each computing process, but this process uses",
        run,
        tmp_path / "discs.zarr",
        memory="100MB",
    )
    refused(
        "a new process uses 240 MB before the study begins",
        run,
        tmp_path / "discs.zarr",
        memory="1GB",
        processes=4,
    )
    assert not (tmp_path / "discs.zarr").exists()


def test_a_process_that_is_seen_beyond_the_bound_stops_and_keeps_what_is_done(tmp_path, monkeypatch):
    bound = bounded(monkeypatch, 1e9)
    seen = iter([300e6, 400e6, 400e6, 2e9])  # before the first block; after it, and after each of the next
    monkeypatch.setattr(memory, "resident", lambda: next(seen))
    with pytest.raises(
        MemoryError,
        match="a process holds 2000 MB, and `memory` allows 1300 MB for each; all finished chunks are kept",
    ):
        run(tmp_path / "discs.zarr", memory=bound)
    monkeypatch.undo()
    assert run(tmp_path / "discs.zarr").complete


def test_systems_that_do_not_say_refuse(tmp_path, monkeypatch):
    monkeypatch.setattr(memory.ctypes, "CDLL", lambda name: object())
    refused("limited only on Linux with glibc", run, tmp_path / "discs.zarr", memory="4GB")
