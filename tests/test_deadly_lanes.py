"""Lanes on which processes die: they are found, named, skipped, and harm no other lane. Processes of their own: `tests/test_cluster.py`, slow tests."""

import numpy as np
import pytest
from test_study_faults import COUNT, study

import jourdain_jax as jj
from jourdain_jax.ensembles import task
from jourdain_jax.ensembles.deadly_lanes import without_deadly_lanes
from jourdain_jax.ensembles.run import Runner, opened

OPTIONS = {"t1": 1.0, "ts": np.linspace(0.0, 1.0, 3), "rtol": 1e-6, "atol": 1e-6, "save": "trajectories", "every": 2}


@pytest.fixture(autouse=True)
def _blocks_are_small(monkeypatch):
    monkeypatch.setattr(task, "LARGEST_BLOCK", 32)


def computed(path, deadly, asked=None, again=()):
    """The study, as processes compute it that die on the lanes `deadly`; on chunks `again` they die whatever is skipped. `asked` gets the ranges tried."""
    asked = [] if asked is None else asked
    owned = study().task(**OPTIONS)
    store = opened(owned, path, None, "")
    runners = []

    def dies(first, last):
        return any(first <= lane < last and lane not in store.skipped() for lane in deadly)

    def compute(numbers, alone):
        for number in numbers:
            first_block = not runners and dies(0, owned.block)
            if first_block or dies(*store.span(number)) or number in again:
                return [number]
            runners.append(runners[0] if runners else Runner(owned, store))
            yield runners[0].run(number)
        return []

    def survives(first, last):
        asked.append((first, last))
        return not dies(first, last)

    list(without_deadly_lanes(store, range(store.chunks), lambda: False, compute, survives, 2))
    return jj.load_study(path)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(task, "LARGEST_BLOCK", 32)
        return study().run(tmp_path_factory.mktemp("whole") / "discs.zarr", progress=False, **OPTIONS)


@pytest.mark.parametrize("deadly", [(40,), (0,), (3, 5, 66, COUNT - 1), (33, 34, 36)])
def test_deadly_lanes_are_named_skipped_and_harm_no_other(deadly, whole, tmp_path):
    with pytest.warns(UserWarning, match="processes died again and again on the lanes " + ", ".join(map(str, deadly)) + " of"):
        found = computed(tmp_path / "discs.zarr", deadly)
    assert found.complete
    assert found.failed.tolist() == list(deadly)
    assert found.counts["process_died"] == len(deadly)
    assert sum(found.counts.values()) == COUNT
    arrays, expected = found.to_xarray().load(), whole.to_xarray().load()
    lost = {"lane": np.isin(np.arange(COUNT), deadly), "saved_lane": np.isin(expected["saved_lane"].values, deadly)}
    for name, values in expected.items():
        out = lost[values.dims[0]]
        np.testing.assert_array_equal(arrays[name].values[~out], values.values[~out], err_msg=name)
        if values.dtype.kind == "f" and not name.endswith("_at_start"):
            assert np.isnan(arrays[name].values[out]).all(), name
    np.testing.assert_array_equal(arrays["lean_at_start"], expected["lean_at_start"])


def test_a_lane_is_found_by_halves(tmp_path):
    asked = []
    with pytest.warns(UserWarning, match="lanes 70 of"):
        computed(tmp_path / "discs.zarr", (70,), asked)
    assert asked == [(64, 90), (64, 77), (64, 70), (70, 73), (70, 71), (70, 71)]  # its chunk, the halves, the lane alone


def test_a_chunk_on_which_processes_die_for_no_lane_is_left_out_and_named(tmp_path):
    with pytest.raises(RuntimeError, match=r"workers died 3 times on lanes 32 to 63 of .*no single lane is the cause.*`memory=`"):
        computed(tmp_path / "discs.zarr", (), again=(1,))
    found = jj.load_study(tmp_path / "discs.zarr")
    assert [found.store.receipt(number) is not None for number in range(3)] == [True, False, True]


def test_a_run_goes_on_without_the_lanes_that_an_earlier_one_skipped(tmp_path):
    path = tmp_path / "discs.zarr"
    with pytest.warns(UserWarning, match="lanes 40 of"):
        computed(path, (40,))
    (path / "run" / "chunks" / "1").unlink()
    found = study().run(path, progress=False, **OPTIONS)
    assert found.complete
    assert found.failed.tolist() == [40]
