"""Several processes that compute the chunks of one study. Each is a new process, since a process in which JAX
runs must not be forked, and has its share of the cores.

If a worker dies, a new worker computes its unfinished chunks, one at a time. A chunk on which workers died
three times is omitted, with a warning that names its samples.

`on_cluster` computes the chunks by workers of a Dask cluster. All workers and the calling process must reach
the study's folder.

Dask restarts a chunk whose worker died. If workers die repeatedly on a chunk, it is tried once more alone,
and then omitted with a warning.
"""

import contextlib
import os
import pickle
import signal
import threading
from collections.abc import Callable, Generator, Iterator
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import connection, get_context, parent_process
from pathlib import Path
from typing import Any

from jourdain_jax.calculus.lazy_imports import needed
from jourdain_jax.calculus.reals import check_kind
from jourdain_jax.scene.arguments import warn
from jourdain_jax.studies.outputs import Task
from jourdain_jax.studies.run import Runner
from jourdain_jax.studies.store import Store

MOST_DEATHS = 3  # tuning: deaths of processes on one chunk before it is omitted
_NONE_BEGAN = (
    "no worker of this study could start; see its printed error. Each imports the main program: run studies "
    "in it under `if __name__ == '__main__':`, and define scenes and outputs in a module; or take processes=1"
)
_runners: dict[tuple, Runner] = {}  # the runner of this process for the latest study and folder
_one_at_a_time = threading.Lock()


def in_processes(task: Task, count: int) -> Callable[..., Iterator[tuple[int, int]]]:
    """Return the `workers` argument of `run.run` for `count` processes. Raises ValueError if the task cannot
    be sent to another process.
    """
    sent = sent_to_others(task)

    def workers(
        store: Store, numbers: list[int], interrupted: Callable[[], bool]
    ) -> Iterator[tuple[int, int]]:
        def compute(numbers: list[int], alone: bool):
            context, most = get_context("spawn"), 1 if alone else count
            begun, places = context.Event(), context.Queue()
            for place in range(most):
                places.put((place, most))
            with ProcessPoolExecutor(
                most, mp_context=context, initializer=_begin, initargs=(sent, places, begun)
            ) as pool:
                submit = lambda number: pool.submit(chunk, number, sent, str(store.path))
                died = yield from computed(submit, BrokenProcessPool, store, numbers, interrupted, most)
                if died and not begun.is_set():
                    raise RuntimeError(_NONE_BEGAN)
                return died

        return whatever_dies(store, numbers, interrupted, compute, MOST_DEATHS - 1)

    return workers


def chunk(number: int, sent: bytes, path: str) -> tuple[int, int]:
    """Compute and store a chunk in this process, which computes one chunk at a time, and return its counts.
    Chunks that a process stored before it died are not computed again.
    """
    with _one_at_a_time:
        which = sent, path, (Path(path) / "zarr.json").stat().st_mtime_ns
        if which not in _runners:
            _runners.clear()
            _runners[which] = Runner(pickle.loads(sent), Store(path))
        runner = _runners[which]
        receipt = runner.store.receipt(number)
        return receipt.lanes if receipt else runner.run(number)


def whatever_dies(
    store: Store, numbers, interrupted, compute: Callable, attempts: int
) -> Iterator[tuple[int, int]]:
    """Yield the counts of the chunks `numbers`, even if some processes die. Chunks on which processes die
    repeatedly are omitted with a warning.

    - `compute(numbers, alone)`: a generator that yields the counts of samples and of failed samples of each
      chunk. It returns the indices of unfinished chunks if a process died.
    - `attempts`: number of times that each unfinished chunk is tried alone, to exclude other chunks as the
      cause.

    A process may die within a motion if a user's function calls other code, or if memory runs out. Raises
    RuntimeError if this happens in the first block, which every process computes.
    """
    waiting, left_out = list(numbers), []
    while waiting and not interrupted():
        for number in (yield from compute(waiting, False)):
            deaths = 0
            while deaths < attempts and not interrupted() and (yield from compute([number], True)):
                deaths += 1
            if deaths == attempts:
                left_out.append(number)
                if store.read_grid() is None:
                    raise RuntimeError(f"{_died(store, [0])}; every process computes these first. {_ADVICE}")
        waiting = [number for number in waiting if number not in left_out and store.receipt(number) is None]
    if left_out:
        said = (
            f"{_died(store, sorted(left_out))}; these samples are omitted; all others are stored, and the "
            f"same call tries the omitted ones again. {_ADVICE}"
        )
        warn(said)


_ADVICE = (
    "Is there enough memory? Take fewer processes, `jj.build(scene, memory=...)`, or a smaller `chunk`; or "
    "simulate these samples one by one, each in its own process, to see why"
)


def _died(store: Store, numbers: list[int]) -> str:
    return f"processes died {MOST_DEATHS} times on {store.lanes_of(numbers)}"


def sent_to_others(task: Task) -> bytes:
    """Return the task as bytes for another process. Raises ValueError if it cannot be pickled."""
    try:
        return pickle.dumps(task)
    except (pickle.PicklingError, AttributeError, TypeError) as error:
        text = (
            "define scene and outputs at the top level of a module, not as lambdas or inside functions, or"
            " take processes=1 and no `client`"
        )
        raise ValueError(f"this study cannot be sent to other processes ({error}); {text}") from None


def computed(
    submit, deadly: type[Exception], store: Store, numbers, interrupted, most: int
) -> Generator[tuple[int, int], None, list[int]]:
    """Yield the counts of samples and of failed samples of each chunk when it finishes. At most `most`
    chunks run at once. Return the indices of chunks on which a process died.

    `submit(number)`: a future of `concurrent.futures`; `deadly`: the error that reports a dead process.
    """
    left = iter(numbers)
    running: dict[Any, int] = {}
    died: list[int] = []
    while True:
        while (
            not died
            and len(running) < most
            and not interrupted()
            and (number := next(left, None)) is not None
        ):
            try:
                running[submit(number)] = number
            except deadly:  # the pool has a dead process
                died.append(number)
        if not running:
            receipts = {number: store.receipt(number) for number in died}
            # chunks stored before the process died
            yield from (receipt.lanes for receipt in receipts.values() if receipt is not None)
            return [number for number, receipt in receipts.items() if receipt is None]
        for future in wait(running, return_when=FIRST_COMPLETED).done:
            number = running.pop(future)
            try:
                yield future.result()
            except deadly:
                died.append(number)


def _begin(sent: bytes, places, begun) -> None:
    """Start a worker: bind it to its cores, ignore Ctrl-C (which the parent handles), and end it with its
    parent. `begun`: an event that is set when the worker can compute.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if parent := parent_process():
        threading.Thread(target=_end_with, args=(parent.sentinel,), daemon=True).start()
    keep_to_share(*places.get())
    pickle.loads(sent)
    begun.set()


def keep_to_share(place: int, count: int) -> None:
    """Bind this thread, and all threads that it starts, to the cores of process `place` of `count`. Call it
    before JAX starts its threads, one per core.
    """
    if hasattr(os, "sched_getaffinity"):
        cores = sorted(os.sched_getaffinity(0))
    else:
        cores = list(range(os.cpu_count() or 1))
    own = cores[place::count] or cores
    os.environ["JOURDAIN_JAX_THREADS"] = str(len(own))
    with contextlib.suppress(AttributeError, OSError):  # not every system supports this
        os.sched_setaffinity(0, own)


def _end_with(parent: int) -> None:
    """End this process when its parent process, given as a handle of the operating system, ends or
    has ended.
    """
    connection.wait([parent])
    os._exit(1)


def on_cluster(task: Task, client) -> Callable[..., Iterator[tuple[int, int]]]:
    """Return the `workers` argument of `run.run` for a cluster. Raises ValueError if `client` is not a Dask
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
