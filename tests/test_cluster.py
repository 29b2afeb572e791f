"""Studies whose chunks are computed by the workers of a Dask cluster."""

import os
import sys
from contextlib import ExitStack

import jax
import numpy as np
import pytest
from refusals import refused
from test_studies import assert_same

import jourdain_jax as jj
from jourdain_jax.studies import Uniform

distributed = pytest.importorskip("distributed")
COUNT = 150  # lanes, in five chunks
pytestmark = pytest.mark.usefixtures("small_blocks")


def run(path, outputs=None, **options):
    start = {"lean": Uniform(-0.5, 0.5), "spin_rate": Uniform(-4.0, 0.0)}
    study = jj.Study(jj.models.TiltingDisc(), start=start, samples=COUNT, seed=3)
    return study.run(path, t1=1.0, rtol=1e-6, atol=1e-6, progress=False, outputs=outputs, **options)


@pytest.fixture
def client():
    """Two workers, threads of this process."""
    with (
        distributed.LocalCluster(
            n_workers=2, threads_per_worker=1, processes=False, dashboard_address=None
        ) as cluster,
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


def test_what_is_no_cluster_is_refused(client, tmp_path, monkeypatch):
    refused(
        r"`client` is the text 'tcp://10.0.0.1', expected a `dask.distributed.Client`",
        run,
        tmp_path / "discs.zarr",
        client="tcp://10.0.0.1",
    )
    refused(
        "`client` and `processes` are both given", run, tmp_path / "discs.zarr", client=client, processes=2
    )
    refused(
        "at the top level of a module",
        run,
        tmp_path / "discs.zarr",
        {"lean": lambda motion: motion.q_end[3]},
        client=client,
    )
    assert not (tmp_path / "discs.zarr").exists()
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(ImportError, match=r"jourdain-jax\[cluster\]"):
        run(tmp_path / "discs.zarr", client=client)


LANES, DEADLY, NUMBER = 10_240, 7_000, 0.5123  # lanes, in five chunks; one whose radius ends its process


def deadly(motion):
    """The lean at the end, by a function outside of JAX that no process survives where the radius is one
    number.
    """

    def lean(radius, angle):
        if radius == NUMBER:
            os._exit(1)
        return angle

    last = motion.q_end[3]
    return jax.pure_callback(
        lean, jax.ShapeDtypeStruct((), last.dtype), motion.scene.radius, last, vmap_method="sequential"
    )


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
@pytest.mark.parametrize("workers", ["processes of a cluster", "processes of the study"])
def test_a_chunk_on_which_workers_die_is_named_and_left_out(workers, tmp_path):
    radius = np.where(np.arange(LANES) == DEADLY, NUMBER, 0.5)
    study = jj.Study(jj.models.TiltingDisc(), vary={"radius": radius}, start={"lean": 0.3, "spin_rate": -3.0})
    options = {
        "t1": 1.0,
        "rtol": 1e-6,
        "atol": 1e-6,
        "progress": False,
        "outputs": {"lean": deadly},
        "chunk": 2048,
    }
    with ExitStack() as stack:
        if workers == "processes of a cluster":
            cluster = stack.enter_context(
                distributed.LocalCluster(
                    n_workers=2, threads_per_worker=1, dashboard_address=None, silence_logs=50
                )
            )
            options["client"] = stack.enter_context(distributed.Client(cluster))
        else:
            options["processes"] = 2
        with pytest.warns(UserWarning, match="processes died 3 times on samples 6144 to 8191 of"):
            found = study.run(tmp_path / "discs.zarr", **options)
    first, last = found.store.span(3)
    assert not found.complete
    assert found.counts == {"success": LANES - (last - first)}
    lean = found.to_xarray()["lean"].values
    assert np.isnan(lean[first:last]).all()
    assert np.isfinite(np.delete(lean, np.s_[first:last])).all()
