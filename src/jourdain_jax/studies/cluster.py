"""Workers of a Dask cluster that compute the chunks of one study. All workers and the calling process must
reach the study's folder.

Dask restarts a chunk whose worker died. If workers die repeatedly on a chunk, it is tried once more alone,
and then omitted with a warning.
"""

import os
from collections.abc import Callable, Iterator

from jourdain_jax.calculus.lazy_imports import needed
from jourdain_jax.calculus.reals import check_kind
from jourdain_jax.studies.store import Store
from jourdain_jax.studies.task import Task
from jourdain_jax.studies.workers import chunk, computed, keep_to_share, sent_to_others, whatever_dies


def on_cluster(task: Task, client) -> Callable[..., Iterator[tuple[int, int]]]:
    """Return the `workers` argument of `run.run` for a cluster. Raises ValueError if `client` is no Dask
    client, or if the task cannot be sent to another process.
    """
    distributed = needed("distributed", "a cluster", "cluster")
    check_kind(client, distributed.Client, "`client`", "a `dask.distributed.Client`")
    sent = sent_to_others(task)

    def workers(
        store: Store, numbers: list[int], interrupted: Callable[[], bool]
    ) -> Iterator[tuple[int, int]]:
        # a task instead of scattered data: the scheduler can recreate it if a worker dies
        study = client.submit(bytes, sent, pure=False)
        asked = study, str(store.path.resolve()), os.getpid(), _places(distributed, client)
        # two chunks per worker thread: one running, one queued
        most = 2 * max(1, sum(client.nthreads().values()))
        pool = client.get_executor(pure=False)

        def compute(numbers: list[int], alone: bool):
            killed, submit = distributed.KilledWorker, lambda number: pool.submit(_chunk, number, *asked)
            return computed(submit, killed, store, numbers, interrupted, 1 if alone else most)

        return whatever_dies(store, numbers, interrupted, compute, 1)

    return workers


def _places(distributed, client) -> dict[object, int] | None:
    """Return the index of each worker by name if the workers are separate processes of this machine with one
    thread each; otherwise None.
    """
    cluster = client.cluster
    threads = client.nthreads().values()
    if type(cluster) is not distributed.LocalCluster or not cluster.processes or set(threads) != {1}:
        return None
    return {name: place for place, name in enumerate(sorted(cluster.workers))}


def _chunk(number: int, sent: bytes, path: str, asking: int, places: dict | None) -> tuple[int, int]:
    """Compute and store a chunk in this worker. `asking`: id of the process that requests the chunk;
    `places`: the result of `_places`.
    """
    # a worker in a separate process uses only its share of the cores
    if os.getpid() != asking and "JOURDAIN_JAX_THREADS" not in os.environ:
        from distributed import get_worker

        worker = get_worker()
        os.environ["JOURDAIN_JAX_THREADS"] = str(worker.state.nthreads)
        if places and worker.name in places:
            keep_to_share(places[worker.name], len(places))
    return chunk(number, sent, path)
