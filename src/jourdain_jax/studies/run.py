"""Computation and storage of the missing chunks of a study in sequence, with a progress bar and handling of
Ctrl-C.

The first Ctrl-C finishes the current chunk, the second stops at once. The same call continues after both.
"""

import json
import re
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from platform import python_version

import equinox as eqx
import jax
import numpy as np
from tqdm import tqdm

from jourdain_jax.calculus.compilation import nan_is_a_mark
from jourdain_jax.calculus.lazy_imports import version_of
from jourdain_jax.calculus.reals import real_type
from jourdain_jax.motion.rollout import rollout
from jourdain_jax.motion.trajectories.labels import OF_LANES
from jourdain_jax.scene.arguments import warn
from jourdain_jax.scene.coordinates import parameters_of
from jourdain_jax.studies import memory
from jourdain_jax.studies.outputs import Task
from jourdain_jax.studies.statistics import Grid, Tally
from jourdain_jax.studies.store import Store

PACKAGES = ("jourdain-jax", "jax", "jaxlib", "diffrax", "numpy", "scipy", "zarr", "llvmlite")


@dataclass(frozen=True)
class Lanes:
    """Results of a block of samples: the stored values by column, the ends of motions by the names of
    `OF_LANES`, and all outputs as an array of shape (samples, outputs).

    Ends and outputs are on the device, and may be padded.
    """

    lanes: range
    kept: Mapping[str, np.ndarray]
    ends: Mapping[str, jax.Array]
    outputs: jax.Array


class Runner:
    """Computation and storage of chunks of one task in this process.

    Every process first computes the first block, which determines the grid of the statistics. Its compiled
    programs are used for all other blocks.
    """

    def __init__(self, task: Task, store: Store):
        self.task, self.store = task, store
        if task.memory:
            memory.give_back_at_once()
        self._outputs_of = eqx.filter_jit(eqx.filter_vmap(task.outputs_of_lane))
        self._first = self.run_block(0)
        found = Grid.of(np.asarray(self._first.outputs)[: len(self._first.lanes)]).as_dict()
        kept = store.read_grid() or store.write_grid(found)
        if kept != found:
            warn(
                f"the first {task.block} samples of `{store.path}` have other bits here than where the study "
                "began (another machine, or other versions); results are right, but not bit-equal to those "
                "of one machine"
            )
        self.grid = Grid.from_dict(kept, len(task.outputs))

    def run(self, number: int) -> tuple[int, int]:
        """Compute and store a chunk. Return how many samples it has and how many failed."""
        first, last = self.store.span(number)
        kept, tallies = [], []
        for number_of_block in range(first // self.task.block, -(-last // self.task.block)):
            block = self.run_block(number_of_block) if number_of_block else self._first
            kept.append(block.kept)
            tallies.append(Tally.of_block(self.grid, block.lanes, block.ends, block.outputs))
        values = {name: np.concatenate([columns[name] for columns in kept]) for name in self.store.columns}
        tally = Tally.together(tallies, len(self.task.outputs))
        self.store.write(number, values, tally)
        return last - first, tally.failed.size

    def run_block(self, number: int) -> Lanes:
        """Return the results of all samples of a block."""
        task = self.task
        first = number * task.block
        count = min(task.block, len(task.design) - first)
        index = np.minimum(first + np.arange(task.block), len(task.design) - 1)
        values = task.design._at(
            index, on_device=jax.default_backend() != "cpu" and jax.config.jax_enable_x64
        )
        starts, parameters = task.starts_and_parameters(values)
        rolled = rollout(
            task.scene,
            starts,
            parameters=parameters or None,
            chunk=task.block,
            progress=False,
            **task.span,
            options=task.options,
        ).lanes
        with nan_is_a_mark():
            outputs = self._outputs_of(rolled)
        ends = {name: getattr(rolled, field) for name, (field, *_) in OF_LANES.items()}

        def rows(array, every: int) -> np.ndarray:
            return np.asarray(array if every == 1 else _rows(array, np.arange(-first % every, count, every)))[
                :count
            ]

        found: dict[str, np.ndarray] = {}
        if self.store.columns:
            every = self.store.columns["result"].every
            found = {name: rows(array, every) for name, array in (values | ends).items()} | dict(
                zip(task.outputs, rows(outputs, every).T, strict=True)
            )
        if task.keep_every:
            for names, array in ((task.scene.coordinate_names, rolled.q), (task.scene.speed_names, rolled.u)):
                found |= dict(zip(names, np.moveaxis(rows(array, task.keep_every), -1, 0), strict=True))
        kept = {name: found[name].astype(column.dtype) for name, column in self.store.columns.items()}
        if task.memory:
            memory.check(task.memory)
        return Lanes(range(first, first + count), kept, ends, outputs)


@jax.jit
def _rows(array, index):
    return array[index]


def bounded(
    task: Task, path, chunk: int | None, allowed: int | None, *, here: bool
) -> tuple[Task, int | None]:
    """Return the task with its block size, and the number of samples of its chunks. Blocks have the size used
    in the folder or, in a new folder, a size that keeps a process below `allowed` bytes.

    `here`: whether this process computes. Raises ValueError if blocks or chunks need more.
    """
    begun = Store(path) if Store.is_taken(path) else None
    if begun:
        task = replace(task, largest_block=begun.study["block"])
    if allowed is None:
        return task, chunk
    room = memory.room(allowed, here=here)
    if not begun:
        while task.block > 8 and memory.BLOCKS * task.block * task.bytes_of_lane > 0.5 * room:
            task = replace(task, largest_block=task.block // 2)
        if chunk is None:
            unit = int(np.lcm(task.block, task.stride))
            most = int(0.5 * room / (memory.CHUNKS * max(task.bytes_of_kept_lane, 1.0)))
            chunk = min(_chunk(task, None), max(unit, most // unit * unit))
    lanes = begun.chunk if begun else _chunk(task, chunk)
    if (
        need := memory.BLOCKS * task.block * task.bytes_of_lane
        + memory.CHUNKS * lanes * task.bytes_of_kept_lane
    ) > room:
        text = f"blocks of {task.block} samples and chunks of {lanes} take up to {need / 1e6:.0f} MB"
        text += f", but `memory` leaves only {room / 1e6:.0f} MB for each process"
        raise ValueError(
            f"{text}; give more memory, fewer processes, a smaller `chunk`, fewer times `ts`, "
            "or a larger `keep_every`"
        )
    return replace(task, memory=allowed), chunk


def opened(task: Task, path, chunk: int | None, command: str) -> Store:
    """Return the store of the task's folder, new or existing. Raises ValueError if it holds another study."""
    columns = task.columns()
    if Store.is_taken(path):
        store = Store(path)
    else:
        store = Store.make(path, _study(task, chunk, command), columns, _constants(task), attributes(task))
    _check_same(store, task, chunk)
    return store


def _constants(task: Task) -> dict[str, tuple]:
    if task.keep_every is None:
        return {}
    found = {"time": ("time", np.asarray(task.ts, float), {"units": "s"})}
    if task.stride > 1:
        found["saved_lane"] = (
            "saved_lane",
            np.arange(0, len(task.design), task.stride),
            {"long_name": "sample whose trajectory is kept"},
        )
    return found


def _chunk(task: Task, chunk: int | None) -> int:
    """Return the number of samples of a chunk: a multiple of the block size and of the interval of stored
    trajectories, by default about a thousandth of all samples.
    """
    unit = np.lcm(task.block, task.stride)
    if chunk is None:
        return int(unit * max(1, min(len(task.design) // 1000, 2**20) // unit))
    if isinstance(chunk, bool) or not isinstance(chunk, int | np.integer) or chunk < 1 or chunk % unit:
        raise ValueError(
            f"`chunk` is {chunk!r}, expected a multiple of {unit}, such as {4 * unit}: this study "
            f"computes {unit} samples together"
        )
    return int(chunk)


def versions() -> dict[str, str]:
    """Return the versions of Python and of the packages used in the computation."""
    return {"python": python_version()} | {name: version_of(name) for name in PACKAGES}


def _study(task: Task, chunk: int | None, command: str) -> dict:
    about = {
        "samples": len(task.design),
        "block": task.block,
        "chunk": _chunk(task, chunk),
        "save": task.save,
        "outputs": list(task.outputs),
    }
    return about | {
        "varied": list(task.design.names),
        "sampler": task.design.sampler,
        "identity": task.identity(),
        "versions": versions(),
        "command": command,
    }


def attributes(task: Task) -> dict:
    """Return the attributes of the store, which describe the study."""
    parameters = {
        name: {"value": np.asarray(value).tolist(), "unit": about["unit"]}
        for name, value, about in parameters_of(task.scene)
    }
    return {
        "title": f"study of {type(task.scene).__name__}",
        "scene": f"{type(task.scene).__module__}.{type(task.scene).__qualname__}",
        "parameters": parameters,
        "start": {name: np.asarray(value).tolist() for name, value in task.constants.items()},
        "design": str(task.design),
        "sampler": task.design.sampler,
        "seed": int(task.design.seed),
        "samples": len(task.design),
        "options": {name: _as_text(x) for name, x in task.settled.items()},
        "precision": str(real_type()),
        "versions": versions(),
        "command": " ".join(sys.argv),
        "created": datetime.now(UTC).isoformat(timespec="seconds"),
        "coordinates": " ".join(task.design.names) if task.columns() else "",
    }


def _as_text(x) -> object:
    """Return an option as text, but numbers as numbers. Memory addresses, which differ between processes, are
    omitted.
    """
    if isinstance(x, int | float | np.ndarray | jax.Array):
        return np.asarray(x).tolist()
    return re.sub(r" at 0x[0-9a-f]+", "", repr(x))


def _check_same(store: Store, task: Task, chunk: int | None) -> None:
    held, own = store.study["identity"], task.identity()
    other = [name for name in own if held.get(name) != own[name]]
    if other:
        was, now = store.attributes, json.loads(json.dumps(attributes(task)))
        what = ", ".join(_difference(name, was, now) for name in other)
        raise ValueError(
            f"`{store.path}` contains another study, with different {what}; give a new folder, "
            "or the arguments of that study"
        )
    if chunk is not None and chunk != store.chunk:
        raise ValueError(
            f"`{store.path}` was begun with chunks of {store.chunk} samples, and `chunk` is "
            f"{chunk}; omit `chunk`"
        )
    now = versions()
    changed = [
        f"{name} {held} (now {now[name]})"
        for name, held in store.study["versions"].items()
        if now.get(name) != held
    ]
    if changed:
        warn(
            f"`{store.path}` was begun with other versions: {', '.join(changed)}; new results may differ from"
            " the stored ones in their last digits"
        )


def _difference(part: str, was: dict, now: dict) -> str:
    """Return the name of a differing part of a study, with the differing entries of the scene, its options or
    its start.
    """
    kept = {"scene": "parameters", "options": "options", "start": "start"}.get(part)
    if kept is None:
        return part
    names = [
        f"`{name}`" for name in sorted({*was[kept], *now[kept]}) if was[kept].get(name) != now[kept].get(name)
    ]
    if part == "scene" and not names:
        names = ["its methods"]
    return f"{part} ({', '.join(names)})" if names else part


@contextmanager
def _interruptions() -> Iterator[Callable[[], bool]]:
    """Yield a function that returns whether Ctrl-C was pressed. A second press interrupts as usual."""
    pressed = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield pressed.is_set
        return
    before = signal.getsignal(signal.SIGINT)

    def press(number, frame):
        if pressed.is_set():
            raise KeyboardInterrupt
        pressed.set()

    signal.signal(signal.SIGINT, press)
    try:
        yield pressed.is_set
    finally:
        signal.signal(signal.SIGINT, before)


def run(
    task: Task,
    path,
    *,
    chunk: int | None,
    progress: bool,
    shard: tuple[int, int],
    command: str,
    workers: Callable,
) -> Store:
    """Compute the missing part of a task in the folder `path`.

    `shard`: (k, n) selects the chunks whose index is k - 1 modulo n. `workers(store, numbers, interrupted)`
    yields the counts of samples and of failed samples of each chunk.
    """
    if not Store.is_taken(path):
        memory.check_disk(path, len(task.design) / shard[1] * task.bytes_of_kept_lane)
    store = opened(task, path, chunk, command)
    with store.lock():
        done, torn = store.done()
        if torn:
            some = ", ".join(map(str, torn[:10])) + (" ..." if len(torn) > 10 else "")
            warn(f"{len(torn)} chunks of `{path}` are damaged and are computed again: {some}")
        missing = sorted({*range(shard[0] - 1, store.chunks, shard[1])}.difference(done))
        known = _lanes(store, done)
        bar = tqdm(
            total=known + _lanes(store, missing),
            initial=known,
            unit="sample",
            unit_scale=True,
            disable=not progress,
            smoothing=0.1,
        )
        failed, finished, began = 0, 0, time.monotonic()
        with bar, _interruptions() as interrupted:
            for lanes, wrong in workers(store, missing, interrupted):
                failed, finished = failed + wrong, finished + 1
                bar.update(lanes)
                bar.set_postfix_str(f"{100 * failed / max(1, bar.n - known):.2g} % failed", refresh=False)
            stopped = interrupted() and finished < len(missing)
        if not stopped and store.read_grid() is None:  # damaged, or the share has no chunk
            Runner(task, store)
        if stopped:
            kept = f"{len(done) + finished} of {store.chunks} chunks are kept in `{path}`"
            raise KeyboardInterrupt(
                f"interrupted after {time.monotonic() - began:.0f} s: {kept}; the same "
                "call continues from there"
            )
    return store


def in_this_process(task: Task, store: Store, numbers, interrupted) -> Iterator[tuple[int, int]]:
    """Yield sample counts of the chunks, computed in sequence in this process."""
    runner = None
    for number in numbers:
        if interrupted():
            return
        runner = runner or Runner(task, store)
        yield runner.run(number)


def _lanes(store: Store, numbers) -> int:
    return sum(last - first for first, last in map(store.span, numbers))
