"""Record of the steps of a motion for reverse mode (`adjoint.py`): one slot per trial step, for all lanes of
a block.

The number of slots is limited by the model's `memory`, which all threads share. On a CPU, the record grows up
to this limit. On a GPU, it has a slot for each trial step that the forward call counted, up to the same
limit. If a motion takes more steps, its lanes run forward again for each window of slots, the last window
first.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

from jourdain_jax.integrate.event_search import LOCATING, RUNNING
from jourdain_jax.integrate.explicit_steps import Method
from jourdain_jax.integrate.implicit_steps import ImplicitMethod
from jourdain_jax.integrate.loop.form import Form
from jourdain_jax.integrate.loop.lanes import Lanes, MachineWriter, copied, each_row, room_of_lanes
from jourdain_jax.integrate.loop.loop import COUNT, NEXT, RECORD, SLOTS, STARTS, TIMES, of_job
from jourdain_jax.kernels.ffi import handed_out, lanes_taken, next_lane, taken_in
from jourdain_jax.kernels.ir import Value

TO_STATES, TO_ENDS, GOALS, FOUND = range(STARTS + 1, STARTS + 5)


class Slot(NamedTuple):
    """Row numbers in a slot. The state comes first, then: the rates `y` at the stages, the time `t`, the
    advance `taken`, the number of times `saved` before, and the rows of a transition (`left`). `all`: total
    number of rows.
    """

    y: int
    t: int
    taken: int
    saved: int
    left: int
    all: int

    @staticmethod
    def of(form: Form, method: Method | ImplicitMethod) -> "Slot":
        y = form.integrated
        t = y * (1 + method.needed)
        return Slot(y, t, t + 1, t + 2, t + 3, t + 3 + len(form.rows.get("left", ())))


class _Rooms(NamedTuple):
    """Memory of a block: for each lane its rows, the index `who` of its sample, the number of saved times and
    the cotangents; the number `tries` of slots used.
    """

    state: Value
    who: Value
    saved: Value
    g: Value
    by_known: Value
    tries: Value


class _Places(NamedTuple):
    """Access to the slots. Functions take the index of a trial step."""

    slots: Value  # number of slots
    free: Callable[[Value], Value]  # returns the place to write a slot
    keep: Callable[[Value], None]  # completes the writing of a slot
    kept: Callable[[Value], Value]  # returns the place to read a slot
    lost: Callable[[], Value]  # returns whether memory is exhausted


def write_record(w: MachineWriter, form: Form, method: Method, asked: int, memory: int, job: Value) -> None:
    """Write code that runs the forward and backward passes of all lanes until no sample is left."""
    slot, g, by_known = Slot.of(form, method), w.room(form.integrated), w.room(max(asked, 1))
    who, saved, tries = w.room(w.lanes, "i64"), w.room(), w.room(type="i64")
    rooms = _Rooms(room_of_lanes(w, form), who, saved, g, by_known, tries)
    lanes, end, count = Lanes(w, form, rooms.state), w.room(type="i64"), rooms.tries
    places = _on_gpu(w, slot, job) if w.device else _on_cpu(w, slot, memory)
    with w.repeated() as leave:
        leave(~w.together(lanes_taken(w, job, NEXT) < w.load(job, COUNT, "i64")) | places.lost())
        _take(w, job, rooms.who)
        w.store(w.literal(2**62, "i64"), end)
        with w.repeated() as done:
            _write_start(w, form, job, rooms)
            with w.repeated() as ended:
                code, number = lanes["code"], w.load(count, type="i64")
                on_its_way = w.any(code.equals(RUNNING) | code.equals(LOCATING))
                ended(~w.together(on_its_way & (number < w.load(end, type="i64"))))
                here = places.free(number)
                ended(places.lost())
                _write_try(w, form, slot, job, rooms, here)
                places.keep(number)
            done(places.lost())
            with w.when(w.load(end, type="i64").equals(2**62)):
                _write_ends(w, form, asked, job, rooms)
            first = w.load(count, type="i64") - places.slots
            w.store(w.where(first > 0, first, 0), end)
            with w.repeated() as at_start:
                number = w.load(count, type="i64") - 1
                at_start(~w.together(number >= w.load(end, type="i64")))
                _write_try_back(w, form, slot, job, rooms, places.kept(number))
            done(~w.together(w.load(end, type="i64") > 0))
        leave(places.lost())
        _write_found(w, form, asked, job, rooms)
    if not w.device:
        with w.when(places.lost()):
            _give_nan(w, form, asked, job, rooms.who)
        w.external("free", "void", places.kept(w.literal(0, "i64")))


def prepare(w: MachineWriter, form: Form, method: Method, memory: int) -> None:
    """Write the parts of the module that the record needs. `memory`: its size in bytes."""
    if w.device:
        w.record = Slot.of(form, method).all, memory
    else:
        _write_more_room(w)


def _write_more_room(w: MachineWriter) -> None:
    """Write `more_room(old, bytes)`, which allocates twice as many bytes and copies the old contents. It
    returns null if there is not enough memory.
    """
    with w.function("more_room", "ptr", {"old": "ptr", "bytes": "i64"}, attributes="noinline") as (old, size):
        new = w.external("aligned_alloc", "ptr", w.literal(64, "i64"), size * 2)
        there = w.converted("ptrtoint", new, "i64").differs(0)
        with w.when(there):
            w.external("memcpy", "ptr", new, old, size)
        w.external("free", "void", old)
        w.give(new)


def _on_cpu(w: MachineWriter, slot: Slot, memory: int) -> _Places:
    """Return access to slots that fit into a third of each thread's memory. The limit is a third, because a
    full record is copied to a record of twice its size, and both exist at the same time.
    """
    size = slot.all * w.lanes * 8
    most = max(memory // (3 * size * w.threads), 1)
    # the record begins with 64 slots, and doubles when full
    slots, first = w.literal(most, "i64"), w.literal(min(64, most) * size, "i64")
    record, bytes_there = w.room(type="ptr"), w.room(type="i64")
    w.store(first, bytes_there)
    w.store(w.external("aligned_alloc", "ptr", w.literal(64, "i64"), first), record)

    def kept(number: Value) -> Value:
        return w.at(w.load(record, type="ptr"), w.binary("srem", number, slots) * slot.all)

    def free(number: Value) -> Value:
        with w.when((number < slots) & ((number + 1) * size > w.load(bytes_there, type="i64"))):
            w.store(
                w.call("more_room", "ptr", w.load(record, type="ptr"), w.load(bytes_there, type="i64")),
                record,
            )
            w.store(w.load(bytes_there, type="i64") * 2, bytes_there)
        return kept(number)

    return _Places(
        slots,
        free,
        lambda number: None,
        kept,
        lambda: w.converted("ptrtoint", w.load(record, type="ptr"), "i64").equals(0),
    )


def _on_gpu(w: MachineWriter, slot: Slot, job: Value) -> _Places:
    """Return access to the slots of a thread. Numbers of neighbouring threads are interleaved in memory."""
    here = w.room(slot.all)
    block, size, own, blocks = (
        w.converted("zext", w.external(f"llvm.nvvm.read.ptx.sreg.{name}.x", "i32"), "i64")
        for name in ("ctaid", "ntid", "tid", "nctaid")
    )
    thread, threads = block * size + own, blocks * size
    record, slots = w.at(w.load(job, RECORD, "ptr"), thread), w.load(job, SLOTS, "i64")

    def place(number: Value, row: int | Value) -> Value:
        return w.at(record, (w.binary("srem", number, slots) * slot.all + row) * threads)

    def keep(number: Value) -> None:
        w.each(range(slot.all), lambda row: w.store(w.load(here, row), place(number, row)))

    def kept(number: Value) -> Value:
        w.each(range(slot.all), lambda row: w.store(w.load(place(number, row)), here, row))
        return here

    return _Places(slots, lambda number: here, keep, kept, lambda: w.literal(0, "i1"))


def _take(w: MachineWriter, job: Value, who: Value) -> None:
    """Write code that stores the indices of the next samples of the batch in `who`, -1 if there is none."""
    with w.each_lane() as lane:
        number = next_lane(w, job, NEXT)
        w.store(w.where(number < w.load(job, COUNT, "i64"), number, -1), who, lane)


def _write_start(w: MachineWriter, form: Form, job: Value, rooms: "_Rooms") -> None:
    """Write code that sets all lanes to their starts."""
    with w.counted(form.all) as row:
        w.store(1.0, rooms.state, row)
    with w.each_lane() as lane:
        w.run("begin", job, rooms.state, rooms.who, lane)
    w.store(0.0, rooms.saved)
    w.run("note", job, rooms.state, rooms.who, rooms.saved)
    w.store(w.literal(0, "i64"), rooms.tries)


def _write_try(w: MachineWriter, form: Form, slot: Slot, job: Value, rooms: "_Rooms", here: Value) -> None:
    """Write code that makes a trial step and records it in the slot `here`."""
    lanes = Lanes(w, form, rooms.state)
    copied(w, form.integrated, rooms.state, here)
    w.store(lanes["t"], here, slot.t)
    w.store(w.load(rooms.saved), here, slot.saved)
    w.run("step", rooms.state, w.at(here, slot.y))
    w.store(lanes["taken"], here, slot.taken)
    if form.goes_on:
        copied(w, len(form.rows["left"]), w.at(rooms.state, form.rows["left"].start), w.at(here, slot.left))
    w.run("note", job, rooms.state, rooms.who, rooms.saved)
    w.store(w.load(rooms.tries, type="i64") + 1, rooms.tries)


def _write_ends(w: MachineWriter, form: Form, asked: int, job: Value, rooms: "_Rooms") -> None:
    """Write code that initialises the cotangents of a block with the cotangents of its end states."""
    g = rooms.g
    each_row(w, asked, rooms.by_known, lambda i: 0.0)
    each_row(w, form.integrated, g, lambda i: 0.0)
    with w.each_lane() as lane:
        number = w.load(rooms.who, lane, "i64")
        with w.when(number >= 0):
            taken_in(w, form.integrated, of_job(w, job, TO_ENDS, form.ends, number), g, lane)
    # the saved states at unreached times are the last state
    all_times = w.spread(w.converted("sitofp", w.load(job, TIMES, "i64"), "double"))
    w.run("added", job, rooms.who, w.load(rooms.saved), all_times, g)
    if form.has_events:
        w.run("event_back", job, rooms.state, rooms.who, g, rooms.by_known)


def _write_try_back(
    w: MachineWriter, form: Form, slot: Slot, job: Value, rooms: "_Rooms", here: Value
) -> None:
    """Write code that pulls cotangents back through the trial step in the slot `here`."""
    before = w.load(here, slot.saved)
    w.run("added", job, rooms.who, before, w.load(rooms.saved), rooms.g)
    w.store(before, rooms.saved)
    if form.goes_on:
        with w.when(w.any(w.load(here, slot.left).differs(0.0))):
            w.run("reset_back", job, rooms.state, rooms.who, w.at(here, slot.left), rooms.g, rooms.by_known)
    with w.when(w.any(w.load(here, slot.taken).differs(0.0))):
        w.run("step_back", rooms.state, here, rooms.g, rooms.by_known)
    w.store(w.load(rooms.tries, type="i64") - 1, rooms.tries)


def _write_found(w: MachineWriter, form: Form, asked: int, job: Value, rooms: "_Rooms") -> None:
    """Write code that stores the results of a block."""
    g = rooms.g
    w.run("added", job, rooms.who, w.number(0.0), w.load(rooms.saved), g)
    with w.each_lane() as lane:
        number = w.load(rooms.who, lane, "i64")
        with w.when(number >= 0):
            numbers = of_job(w, job, FOUND, form.integrated + asked, number)
            handed_out(w, form.integrated, g, lane, numbers)
            handed_out(w, asked, rooms.by_known, lane, numbers.after(form.integrated))


def _give_nan(w: MachineWriter, form: Form, asked: int, job: Value, who: Value) -> None:
    """Write code that stores NaN as results of this block and all remaining samples, because memory is
    exhausted.
    """
    found, each = w.load(job, FOUND, "ptr"), form.integrated + asked

    def lost(number: Value) -> None:
        with w.counted(each) as row:
            w.store(w.literal(math.nan, "double"), found, number * each + row)

    with w.each_lane() as lane:
        number = w.load(who, lane, "i64")
        with w.when(number >= 0):
            lost(number)
    with w.repeated() as leave:
        number = next_lane(w, job, NEXT)
        leave(number >= w.load(job, COUNT, "i64"))
        lost(number)
