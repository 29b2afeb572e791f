"""Lanes on which processes die again and again: they are found by halves, noted in the store, and skipped.

A process may die within a motion where a user's function calls other code, or where memory runs out. A skipped lane has the result code `PROCESS_DIED` and no
values; another lane is computed in its place, since all blocks run the same program.
"""

import warnings
from collections.abc import Callable, Generator, Iterator

from jourdain_jax.ensembles.store import Store
from jourdain_jax.scene.tracebacks import users_level

MOST_DEATHS = 3  # of processes on one chunk, before it is searched for the lane
MOST_SKIPPED = 8  # lanes of one chunk

Done = tuple[int, int]  # of a chunk: its lanes, and how many of them failed


def without_deadly_lanes(store: Store, numbers, interrupted, compute: Callable, survives: Callable[[int, int], bool], attempts: int) -> Iterator[Done]:
    """Compute the chunks `numbers`, whatever becomes of the processes that do; RuntimeError at the end where some chunks could not be.

    - `compute(numbers, alone)`: a generator that yields `Done` for each chunk and returns the numbers of chunks that were under way when a process died.
    - `survives(first, last)`: whether a process survives lanes `first` to `last` - 1.
    - `attempts`: how often a chunk on which a process died is tried alone, so that no other is suspected, before it is searched for the lane.
    """
    waiting, bad, before = list(numbers), [], store.skipped()
    while waiting and not interrupted():
        for number in (yield from compute(waiting, False)):
            if not (yield from _alone(store, number, interrupted, compute, survives, attempts)):
                bad.append(number)
        waiting = [number for number in waiting if number not in bad and store.receipt(number) is None]
    _say_skipped(store, before)
    if bad:
        raise RuntimeError(_left_out(store, bad))


def _alone(store: Store, number: int, interrupted, compute, survives, attempts: int) -> Generator[Done, None, bool]:
    """Compute one chunk without the lanes on which processes die; whether that was done, or interrupted."""
    for _ in range(1 + MOST_SKIPPED):
        for _ in range(attempts):
            if interrupted() or not (yield from compute([number], True)):
                return True
        if not _note_deadly_lane(store, number, survives):
            return False
        attempts = 1
    return False


def _note_deadly_lane(store: Store, number: int, survives: Callable[[int, int], bool]) -> bool:
    """Find a lane on which processes that compute chunk `number` die, by halves, and note it; whether there was one.

    Every process also computes the first block, which is looked at where no
    chunk was finished.
    """
    places = [store.span(number)] if store.receipts() else [(0, min(store.study["block"], store.lanes)), store.span(number)]
    for first, last in places:
        if survives(first, last):
            continue
        while last - first > 1:
            middle = (first + last) // 2
            first, last = (middle, last) if survives(first, middle) else (first, middle)
        if not survives(first, last):
            store.skip(first)
            return True
    return False


def _say_skipped(store: Store, before: tuple[int, ...]) -> None:
    """A warning that names the lanes that were skipped, but for those that were before."""
    if new := [lane for lane in store.skipped() if lane not in before]:
        named = ", ".join(map(str, new))
        warnings.warn(
            f"processes died again and again on the lanes {named} of `{store.path}`, which are skipped; simulate them alone with "
            "`result.lane(k).simulate()`, in a process of its own, to see why",
            stacklevel=users_level(),
        )


def _left_out(store: Store, numbers: list[int]) -> str:
    """What is said of chunks on which processes died, but on no one lane."""
    lanes = ", ".join(f"{first} to {last - 1}" for first, last in map(store.span, numbers[:5])) + (" ..." if len(numbers) > 5 else "")
    return (
        f"workers died {MOST_DEATHS} times on lanes {lanes} of `{store.path}`, and no single lane is the cause; all other chunks are kept. Is there enough "
        "memory? Take fewer processes, `memory=`, or a smaller `chunk`"
    )
