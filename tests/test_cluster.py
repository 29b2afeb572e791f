"""Studies whose chunks are computed by the workers of a Dask cluster."""

import os
import sys

import jax
import numpy as np
import pytest
from test_studies import assert_same

import jourdain_jax as jj
from jourdain_jax.ensembles import task

distributed = pytest.importorskip("distributed")
COUNT = 150  # lanes, in five chunks
pytestmark = pytest.mark.usefixtures("small_blocks")


def run(path, outputs=None, **options):
    start = {"lean": jj.Uniform(-0.5, 0.5), "spin_rate": jj.Uniform(-4.0, 0.0)}
    study = jj.Study(jj.models.TiltingDisc(), start=start, samples=COUNT, seed=3)
    return study.run(path, t1=1.0, rtol=1e-6, atol=1e-6, progress=False, outputs=outputs, **options)


@pytest.fixture
def client():
    """Two workers, threads of this process."""
    with (
        distributed.LocalCluster(n_workers=2, threads_per_worker=1, processes=False, dashboard_address=None) as cluster,
        distributed.Client(cluster) as client,
    ):
        yield client


def test_a_cluster_computes_what_one_process_computes(client, tmp_path):
    threads = os.environ.get("JOURDAIN_JAX_THREADS")
    whole = run(tmp_path / "whole.zarr")
    assert_same(run(tmp_path / "discs.zarr", client=client), whole)
    assert os.environ.get("JOURDAIN_JAX_THREADS") == threads
    for number in (1, 3):
        (tmp_path / "discs.zarr" / "run" / "chunks" / str(number)).unlink()
    kept = {file: file.stat().st_mtime_ns for file in (tmp_path / "discs.zarr" / "run" / "chunks").iterdir()}
    assert_same(run(tmp_path / "discs.zarr", client=client), whole)
    assert all(file.stat().st_mtime_ns == time for file, time in kept.items())


def test_an_error_of_a_chunk_is_that_of_the_study_and_what_is_kept_stays(client, tmp_path, monkeypatch):
    before = task.Task.run_block

    def failing(self, number):
        if number == 3:
            raise OSError("no block 3")
        return before(self, number)

    monkeypatch.setattr(task.Task, "run_block", failing)
    with pytest.raises(OSError, match="no block 3"):
        run(tmp_path / "discs.zarr", client=client)
    monkeypatch.undo()
    monkeypatch.setattr(task, "LARGEST_BLOCK", 32)
    assert_same(run(tmp_path / "discs.zarr", client=client), run(tmp_path / "whole.zarr"))


def test_what_is_no_cluster_is_refused(client, tmp_path, monkeypatch):
    with pytest.raises(ValueError, match=r"`client` is the text 'tcp://10.0.0.1', expected a `dask.distributed.Client`"):
        run(tmp_path / "discs.zarr", client="tcp://10.0.0.1")
    with pytest.raises(ValueError, match="`client` and `processes` are both given"):
        run(tmp_path / "discs.zarr", client=client, processes=2)
    with pytest.raises(ValueError, match="at the top level of a module"):
        run(tmp_path / "discs.zarr", {"lean": lambda motion: motion.q_end[3]}, client=client)
    assert not (tmp_path / "discs.zarr").exists()
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(ImportError, match=r"jourdain-jax\[cluster\]"):
        run(tmp_path / "discs.zarr", client=client)


LANES, DEADLY, NUMBER = 10_240, 7_000, 0.5123  # lanes, in five chunks; one whose radius ends its process


def deadly(motion):
    """The lean at the end, by a function outside of JAX that no process survives where the radius is one number."""

    def lean(radius, angle):
        if radius == NUMBER:
            os._exit(1)
        return angle

    last = motion.q_end[3]
    return jax.pure_callback(lean, jax.ShapeDtypeStruct((), last.dtype), motion.scene.radius, last, vmap_method="sequential")


def study_with_deadly_lanes(*deadly_lanes):
    radius = np.full(LANES, 0.5)
    radius[list(deadly_lanes)] = NUMBER
    return jj.Study(jj.models.TiltingDisc(), vary={"radius": radius}, start={"lean": 0.3, "spin_rate": -3.0})


def assert_left_out(found, chunk):
    """All lanes but those of one chunk are there."""
    first, last = found.store.span(chunk)
    assert not found.complete
    assert found.counts == {"success": LANES - (last - first)}
    arrays = found.to_xarray()
    assert np.isnan(arrays["lean"].values[first:last]).all()
    assert np.isfinite(np.delete(arrays["lean"].values, np.s_[first:last])).all()


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_a_chunk_on_which_workers_of_a_cluster_die_is_named_and_left_out(tmp_path, monkeypatch):
    monkeypatch.undo()  # workers are processes of their own
    study = study_with_deadly_lanes(DEADLY)
    with (
        distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None, silence_logs=50) as cluster,
        distributed.Client(cluster) as client,
    ):
        options = {"t1": 1.0, "rtol": 1e-6, "atol": 1e-6, "progress": False, "outputs": {"lean": deadly}, "client": client}
        with pytest.warns(UserWarning, match="processes died 3 times on lanes 6144 to 8191 of"):
            found = study.run(tmp_path / "discs.zarr", **options)
    assert_left_out(found, 3)


@pytest.mark.slow
def test_a_chunk_on_which_processes_die_is_named_and_left_out(tmp_path, monkeypatch):
    monkeypatch.undo()
    study = study_with_deadly_lanes(DEADLY)
    with pytest.warns(UserWarning, match="processes died 3 times on lanes 6144 to 8191 of"):
        found = study.run(tmp_path / "discs.zarr", t1=1.0, rtol=1e-6, atol=1e-6, progress=False, outputs={"lean": deadly}, processes=2)
    assert_left_out(found, 3)
