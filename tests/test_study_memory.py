"""Studies that keep to a stated amount of memory."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from test_study_faults import run, study

import jourdain_jax as jj
from jourdain_jax.ensembles import memory, task

TIMES = {"ts": np.linspace(0.0, 1.0, 11), "save": "trajectories"}


@pytest.fixture(autouse=True)
def _blocks_are_small(monkeypatch):
    monkeypatch.setattr(task, "LARGEST_BLOCK", 32)


@pytest.mark.parametrize(("text", "count"), [("2GB", 2_000_000_000), ("1.5 gb", 1_500_000_000), ("512 MiB", 2**29), (800e6, 800_000_000), (10**9, 10**9)])
def test_an_amount_is_read(text, count):
    assert jj.build(jj.models.TiltingDisc(), memory=text).memory == count


@pytest.mark.parametrize("wrong", ["much", "2 XB", "-1GB", True, "nan GB", float("inf"), float("nan"), "0.GBs"])
def test_what_is_no_amount_is_refused(wrong):
    with pytest.raises(ValueError, match=r"`memory` is .*, expected a number of bytes, or a text such as '2GB'"):
        jj.build(jj.models.TiltingDisc(), memory=wrong)


def within(bound, path, **options):
    """The study, of a model whose processes may hold so many bytes."""
    model = jj.build(jj.models.TiltingDisc(), memory=bound)
    return replace(study(), scene=model).run(path, t1=1.0, rtol=1e-6, atol=1e-6, progress=False, **options)


def bounded(monkeypatch, room):
    """A bound that leaves so many bytes for blocks and chunks, whatever this process holds."""
    monkeypatch.setattr(memory, "resident", lambda: 300e6)
    monkeypatch.setattr(memory, "COMPILED", 0.0)
    return int(300e6 + room)


def test_blocks_and_chunks_fit_into_the_bound_and_lanes_are_the_same(tmp_path, monkeypatch):
    free = run(tmp_path / "free.zarr", **TIMES)
    assert (free.store.study["block"], free.store.chunk) == (32, 32)
    of_lane = study().task(t1=1.0, **TIMES).bytes_of_lane
    tight = within(bounded(monkeypatch, 2 * memory.BLOCKS * 8 * of_lane), tmp_path / "tight.zarr", **TIMES)
    assert (tight.store.study["block"], tight.store.chunk) == (8, 8)
    one, other = free.to_xarray().load(), tight.to_xarray().load()
    for name in one.variables:
        assert_allclose(one[name].values, other[name].values, rtol=1e-12, atol=1e-14, err_msg=name)
    assert_allclose(free.statistics.mean, tight.statistics.mean, rtol=1e-12, atol=1e-14)


def test_a_study_goes_on_with_the_blocks_with_which_it_began(tmp_path, monkeypatch):
    of_lane = study().task(t1=1.0, **TIMES).bytes_of_lane
    bound = bounded(monkeypatch, 2 * memory.BLOCKS * 16 * of_lane)
    whole = within(bound, tmp_path / "whole.zarr", **TIMES)
    path = tmp_path / "begun.zarr"
    within(bound, path, shard=(1, 2), **TIMES)
    begun = run(path, **TIMES)  # of the scene, without a bound
    assert begun.complete
    assert begun.store.study["block"] == 16
    assert_array_equal(begun.statistics.mean, whole.statistics.mean)
    with pytest.raises(ValueError, match="blocks of 16 lanes and chunks of 16 take up to"):
        within(bounded(monkeypatch, 1000), path, **TIMES)


def test_a_rollout_runs_fewer_lanes_at_once_where_its_model_has_little_memory(capsys):
    model, starts = jj.build(jj.models.TiltingDisc(), memory=4 * 3 * 8 * 201 * 12), {"lean": np.linspace(0.1, 0.3, 5)}  # room for three lanes
    whole = jj.rollout(model.scene, starts, t1=0.1)
    assert "lane" not in capsys.readouterr().err  # no bar, for one chunk
    assert_array_equal(jj.rollout(model, starts, t1=0.1).lanes.q, whole.lanes.q)
    assert "5/5" in capsys.readouterr().err


def test_too_little_is_refused_before_anything_is_written(tmp_path):
    with pytest.raises(ValueError, match="`memory` allows 100 MB for each process that computes; this process holds"):
        within("100MB", tmp_path / "discs.zarr")
    with pytest.raises(ValueError, match="a new process holds 240 MB before it begins"):
        within("1GB", tmp_path / "discs.zarr", processes=4)
    assert not (tmp_path / "discs.zarr").exists()


def test_a_process_that_is_seen_beyond_the_bound_stops_and_keeps_what_is_done(tmp_path, monkeypatch):
    bound = bounded(monkeypatch, 1e9)
    seen = iter([300e6, 400e6, 400e6, 2e9])  # before the first block; after it, and after each of the next
    monkeypatch.setattr(memory, "resident", lambda: next(seen))
    with pytest.raises(MemoryError, match="a process holds 2000 MB, and `memory` allows 1300 MB for each; all finished chunks are kept"):
        within(bound, tmp_path / "discs.zarr")
    monkeypatch.undo()
    monkeypatch.setattr(task, "LARGEST_BLOCK", 32)
    assert run(tmp_path / "discs.zarr").complete


def test_systems_that_do_not_say_refuse(tmp_path, monkeypatch):
    monkeypatch.setattr(memory.ctypes, "CDLL", lambda name: object())
    with pytest.raises(ValueError, match="held on Linux with glibc only"):
        within("4GB", tmp_path / "discs.zarr")
