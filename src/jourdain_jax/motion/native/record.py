"""The record of steps of a motion's way forth, by which its cotangents go back (`back.py`): one slot for each try of a step, for all lanes of a block.

On a CPU the record grows with the steps. A GPU has memory for so many slots for each thread; of motions that take more, the lanes go forth again for each
window of slots, the last one first.
"""

import math
from typing import NamedTuple

from jourdain_jax.motion.integrators.event_search import LOCATING, RUNNING
from jourdain_jax.motion.integrators.explicit_steps import Method
from jourdain_jax.motion.native.layout import Form, Lanes, copied, each_row, for_rows
from jourdain_jax.motion.native.loop import COUNT, NEXT, OWN, STARTS, TIMES
from jourdain_jax.native.ffi import FIRST_OF_SCRATCH, handed_out, lanes_taken, next_lane, taken_in
from jourdain_jax.native.ir import Value, Writer

TO_STATES, TO_ENDS, GOALS, FOUND = range(STARTS + 1, STARTS + 5)
FIRST_SLOTS = 64  # for which there is memory at first; then twice as many, and so on


class Slot(NamedTuple):
    """Rows of a slot: those of a state come first, then those of its slopes; `all`: how many there are."""

    y: int
    t: int
    taken: int
    saved: int
    all: int

    @staticmethod
    def of(form: Form, method: Method) -> "Slot":
        y = form.integrated
        t = y * (1 + method.needed)
        return Slot(y, t, t + 1, t + 2, t + 3)


class _Rooms(NamedTuple):
    """Memory of a block: its lanes and their numbers in the batch, of each how many times are saved, its cotangents, and how many slots there are."""

    state: Value
    who: Value
    saved: Value
    g: Value
    by_known: Value
    tries: Value

    @staticmethod
    def of(w: Writer, form: Form, asked: int) -> "_Rooms":
        rows = form.all, form.integrated, max(asked, 1)
        state, g, by_known = (w.room(count) for count in rows)
        return _Rooms(state, w.room(w.lanes, "i64"), w.room(), g, by_known, w.room(type="i64"))


def write_record(w: Writer, form: Form, method: Method, asked: int, job: Value) -> None:
    """Lanes side by side, forth and back, until none is left; inside a function."""
    if w.device:
        _write_windows(w, form, method, asked, job)
    else:
        _write_blocks(w, form, method, asked, job)


def prepare(w: Writer, form: Form, method: Method) -> None:
    """What the record needs in the module."""
    if w.device:
        # 4096 of a thread of a GPU
        w.scratch = Slot.of(form, method).all, 4096
    else:
        _write_more_room(w)


def _write_more_room(w: Writer) -> None:
    """`more_room(old, bytes)`: twice as many bytes, the first of them as before; null where there are none."""
    with w.function("more_room", "ptr", {"old": "ptr", "bytes": "i64"}, attributes="noinline") as (old, size):
        new = w.external("aligned_alloc", "ptr", w.literal(64, "i64"), size * 2)
        there = w.converted("ptrtoint", new, "i64").differs(0)
        with w.when(there):
            w.external("memcpy", "ptr", new, old, size)
        w.external("free", "void", old)
        w.give(new)


def _write_blocks(w: Writer, form: Form, method: Method, asked: int, job: Value) -> None:
    """Lanes side by side, forth and back, until none is left."""
    slot = Slot.of(form, method)
    size = slot.all * w.lanes * 8
    rooms = _Rooms.of(w, form, asked)
    state, who, count = rooms.state, rooms.who, rooms.tries
    record, bytes_there, lanes = w.room(type="ptr"), w.room(type="i64"), Lanes(w, form, state)
    w.store(w.literal(FIRST_SLOTS * size, "i64"), bytes_there)
    w.store(w.external("aligned_alloc", "ptr", w.literal(64, "i64"), w.literal(FIRST_SLOTS * size, "i64")), record)

    def has_room() -> Value:
        return w.converted("ptrtoint", w.load(record, type="ptr"), "i64").differs(0)

    with w.repeated() as leave:
        leave(w.load(job, NEXT, "i64") >= w.load(job, COUNT, "i64"))
        leave(~has_room())
        _take(w, job, who)
        _write_start(w, form, job, rooms)
        with w.repeated() as ended:
            code, number = lanes["code"], w.load(count, type="i64")
            ended(~w.any(code.equals(RUNNING) | code.equals(LOCATING)))
            with w.when((number + 1) * size > w.load(bytes_there, type="i64")):
                w.store(w.call("more_room", "ptr", w.load(record, type="ptr"), w.load(bytes_there, type="i64")), record)
                w.store(w.load(bytes_there, type="i64") * 2, bytes_there)
            ended(~has_room())
            _write_try(w, form, slot, job, rooms, w.at(w.load(record, type="ptr"), number * slot.all))
        leave(~has_room())
        _write_ends(w, form, asked, job, rooms)
        with w.repeated() as at_start:
            at_start(w.load(count, type="i64") <= 0)
            _write_try_back(w, slot, job, rooms, w.at(w.load(record, type="ptr"), (w.load(count, type="i64") - 1) * slot.all))
        _write_found(w, form, asked, job, rooms)
    with w.when(~has_room()):
        _give_nan(w, form, asked, job, who)
    w.external("free", "void", w.load(record, type="ptr"))


def _write_windows(w: Writer, form: Form, method: Method, asked: int, job: Value) -> None:
    """As `_write_blocks`, on a GPU: the lanes of a warp, in memory for so many of the last slots; the numbers of its threads stand side by side."""
    slot, rooms = Slot.of(form, method), _Rooms.of(w, form, asked)
    lanes, here, end = Lanes(w, form, rooms.state), w.room(slot.all), w.room(type="i64")
    (thread, threads), count = w.thread(), rooms.tries
    record = w.at(w.load(job, NEXT, "ptr"), thread + FIRST_OF_SCRATCH)
    slots = w.binary("sdiv", w.load(job, OWN, "i64") - FIRST_OF_SCRATCH, threads * slot.all)

    def place(number: Value, row: int | Value) -> Value:
        return w.at(record, (w.binary("srem", number, slots) * slot.all + row) * threads)

    with w.repeated() as leave:
        leave(~w.together(lanes_taken(w, job, NEXT) < w.load(job, COUNT, "i64")))
        _take(w, job, rooms.who)
        w.store(w.literal(2**62, "i64"), end)
        with w.repeated() as done:
            _write_start(w, form, job, rooms)
            with w.repeated() as ended:
                code, number = lanes["code"], w.load(count, type="i64")
                on_its_way = w.any(code.equals(RUNNING) | code.equals(LOCATING))
                ended(~w.together(on_its_way & (number < w.load(end, type="i64"))))
                _write_try(w, form, slot, job, rooms, here)
                for_rows(w, range(slot.all), lambda row, number=number: w.store(w.load(here, row), place(number, row)))
            with w.when(w.load(end, type="i64").equals(2**62)):
                _write_ends(w, form, asked, job, rooms)
            first = w.load(count, type="i64") - slots
            w.store(w.where(first > 0, first, 0), end)
            with w.repeated() as at_start:
                number = w.load(count, type="i64") - 1
                at_start(~w.together(number >= w.load(end, type="i64")))
                for_rows(w, range(slot.all), lambda row, number=number: w.store(w.load(place(number, row)), here, row))
                _write_try_back(w, slot, job, rooms, here)
            done(~w.together(w.load(end, type="i64") > 0))
        _write_found(w, form, asked, job, rooms)


def _take(w: Writer, job: Value, who: Value) -> None:
    """The next lanes of the batch; -1 where there is none."""
    with w.counted(0, w.lanes) as lane:
        number = next_lane(w, job, NEXT)
        w.store(w.where(number < w.load(job, COUNT, "i64"), number, -1), who, lane)


def _write_start(w: Writer, form: Form, job: Value, rooms: "_Rooms") -> None:
    """All lanes at their starts."""
    with w.counted(0, form.all) as row:
        w.store(1.0, rooms.state, row)
    with w.counted(0, w.lanes) as lane:
        w.run("begin", job, rooms.state, rooms.who, lane)
    w.store(0.0, rooms.saved)
    w.run("note", job, rooms.state, rooms.who, rooms.saved)
    w.store(w.literal(0, "i64"), rooms.tries)


def _write_try(w: Writer, form: Form, slot: Slot, job: Value, rooms: "_Rooms", here: Value) -> None:
    """A step that is tried, and its slot `here`."""
    lanes = Lanes(w, form, rooms.state)
    copied(w, form.integrated, rooms.state, here)
    w.store(lanes["t"], here, slot.t)
    w.store(w.load(rooms.saved), here, slot.saved)
    w.run("step", rooms.state, w.at(here, slot.y))
    w.store(lanes["taken"], here, slot.taken)
    w.run("note", job, rooms.state, rooms.who, rooms.saved)
    w.store(w.load(rooms.tries, type="i64") + 1, rooms.tries)


def _write_ends(w: Writer, form: Form, asked: int, job: Value, rooms: "_Rooms") -> None:
    """Cotangents of the states at the end of a block."""
    g = rooms.g
    each_row(w, asked, rooms.by_known, lambda i: 0.0)
    each_row(w, form.integrated, g, lambda i: 0.0)
    ends = w.load(job, TO_ENDS, "ptr")
    with w.counted(0, w.lanes) as lane:
        number = w.load(rooms.who, lane, "i64")
        with w.when(number >= 0):
            taken_in(w, form.integrated, w.at(ends, number * form.ends, "double"), g, lane)
    # what was not reached repeats the last state
    all_times = w.spread(w.converted("sitofp", w.load(job, TIMES, "i64"), "double"))
    w.run("added", job, rooms.who, w.load(rooms.saved), all_times, g)
    if form.has_events:
        w.run("event_back", job, rooms.state, rooms.who, g, rooms.by_known)


def _write_try_back(w: Writer, slot: Slot, job: Value, rooms: "_Rooms", here: Value) -> None:
    """Back over the try in a slot."""
    before = w.load(here, slot.saved)
    w.run("added", job, rooms.who, before, w.load(rooms.saved), rooms.g)
    w.store(before, rooms.saved)
    with w.when(w.any(w.load(here, slot.taken).differs(0.0))):
        w.run("step_back", rooms.state, here, rooms.g, rooms.by_known)
    w.store(w.load(rooms.tries, type="i64") - 1, rooms.tries)


def _write_found(w: Writer, form: Form, asked: int, job: Value, rooms: "_Rooms") -> None:
    """The results of a block."""
    g = rooms.g
    w.run("added", job, rooms.who, w.number(0.0), w.load(rooms.saved), g)
    found, each = w.load(job, FOUND, "ptr"), form.integrated + asked
    with w.counted(0, w.lanes) as lane:
        number = w.load(rooms.who, lane, "i64")
        with w.when(number >= 0):
            place = w.at(found, number * each, "double")
            handed_out(w, form.integrated, g, lane, place)
            handed_out(w, asked, rooms.by_known, lane, w.at(place, form.integrated, "double"))


def _give_nan(w: Writer, form: Form, asked: int, job: Value, who: Value) -> None:
    """Where no memory is left: NaN for this block and for all lanes that are left."""
    found, each = w.load(job, FOUND, "ptr"), form.integrated + asked

    def lost(number: Value) -> None:
        with w.counted(0, each) as row:
            w.store(w.literal(math.nan, "double"), found, number * each + row)

    with w.counted(0, w.lanes) as lane:
        number = w.load(who, lane, "i64")
        with w.when(number >= 0):
            lost(number)
    with w.repeated() as leave:
        number = next_lane(w, job, NEXT)
        leave(number >= w.load(job, COUNT, "i64"))
        lost(number)
