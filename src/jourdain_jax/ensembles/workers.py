"""Several processes that compute the chunks of one study; each is started afresh (never forked from one in which JAX runs) and has its share of the cores.

A worker that dies takes nothing with it: chunks that were under way are given to a new worker, one at a time. A chunk on which workers died three times is left
out, and named at the end, when all others are done.
"""

import contextlib
import os
import pickle
import signal
import threading
import time
from collections.abc import Callable, Generator, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import get_context

from jourdain_jax.ensembles.run import Runner
from jourdain_jax.ensembles.store import Store
from jourdain_jax.ensembles.task import Task

MOST_DEATHS = 3  # of workers on one chunk
_LOOK = 2.0  # s, between two looks whether the parent lives

_runner: list[Runner] = []  # of this worker


def in_processes(task: Task, count: int) -> Callable[..., Iterator[tuple[int, int]]]:
    """What `run` takes as its workers; ValueError where the task cannot be sent to another process."""
    sent = sent_to_others(task)

    def workers(task: Task, store: Store, numbers: list[int], interrupted: Callable[[], bool]) -> Iterator[tuple[int, int]]:
        waiting, bad = list(numbers), []
        while waiting and not interrupted():
            suspects = yield from _until_a_worker_dies(sent, store, waiting, count, interrupted)
            for number in suspects:
                for _ in range(MOST_DEATHS - 1):  # alone, so that no other chunk is blamed
                    if interrupted() or not (yield from _until_a_worker_dies(sent, store, [number], 1, interrupted)):
                        break
                else:
                    bad.append(number)
            waiting = [number for number in waiting if number not in bad and store.receipt(number) is None]
        if bad:
            raise RuntimeError(left_out(store, bad))

    return workers


def sent_to_others(task: Task) -> bytes:
    """The task as it is sent to another process; ValueError where it cannot be."""
    try:
        return pickle.dumps(task)
    except (pickle.PicklingError, AttributeError, TypeError) as error:
        text = "define scene and outputs at the top level of a module, not as lambdas or inside functions, or take processes=1 and no `client`"
        raise ValueError(f"this study cannot be sent to other processes ({error}); {text}") from None


def left_out(store: Store, numbers: list[int]) -> str:
    """What is said of chunks on which workers died again and again."""
    lanes = ", ".join(f"{first} to {last - 1}" for first, last in map(store.span, numbers[:5])) + (" ..." if len(numbers) > 5 else "")
    return (
        f"workers died {MOST_DEATHS} times on lanes {lanes} of `{store.path}`; all other chunks are kept. Simulate these lanes alone with "
        "`result.lane(k).simulate()`, in a process of its own, to see which it is"
    )


def _until_a_worker_dies(sent: bytes, store: Store, numbers: list[int], count: int, interrupted) -> Generator[tuple[int, int], None, list[int]]:
    """Run chunks; returns the numbers of those that were under way when a worker died, empty where none did."""
    context = get_context("spawn")
    places = context.Queue()
    for place in range(count):
        places.put((place, count))
    left = iter(numbers)
    running: dict[Future, int] = {}
    with ProcessPoolExecutor(count, mp_context=context, initializer=_begin, initargs=(sent, str(store.path), places)) as pool:
        try:
            while True:
                while len(running) < count and not interrupted() and (number := next(left, None)) is not None:
                    running[pool.submit(_chunk, number)] = number
                if not running:
                    return []
                for future in wait(running, return_when=FIRST_COMPLETED).done:
                    yield future.result()
                    del running[future]
        except BrokenProcessPool:
            suspects = []
            for number in running.values():
                receipt = store.receipt(number)
                if receipt is None:
                    suspects.append(number)
                else:  # kept before the worker died
                    yield receipt.last - receipt.first, receipt.arrays["failed"].size
            return suspects


def _begin(sent: bytes, path: str, places) -> None:
    """Start a worker: its cores, no Ctrl-C (which is for the parent), an end with the parent's."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    keep_to_share(*places.get())
    threading.Thread(target=_end_with, args=(os.getppid(),), daemon=True).start()
    _runner.append(Runner(pickle.loads(sent), Store(path)))


def keep_to_share(place: int, count: int) -> None:
    """Keep this thread, and all that it starts, to the cores of process number `place` of `count`; before JAX begins, for its threads are then one per core."""
    with contextlib.suppress(AttributeError, OSError):  # not every system knows cores
        cores = sorted(os.sched_getaffinity(0))
        own = cores[place::count] or cores
        os.sched_setaffinity(0, own)
        os.environ["JOURDAIN_JAX_THREADS"] = str(len(own))


def _end_with(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(_LOOK)
    os._exit(1)


def _chunk(number: int) -> tuple[int, int]:
    return _runner[0].run(number)
