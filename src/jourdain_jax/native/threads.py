"""Lanes of a batch among threads: this one, and others that it starts and waits for."""

from jourdain_jax.native.ffi import FIRST_OF_SCRATCH, Given, product, write_handler
from jourdain_jax.native.ir import Value, Writer

NEXT, COUNT, IN, OUT = range(4)  # words of a job of rows: the number of the next row, how many there are, pointers to those given and to those returned


def start_counting(w: Writer, job: Value, word: int) -> None:
    """No lane is taken: a word of a job counts them, or on a GPU points to what does."""
    w.store(w.own[0] if w.device else w.literal(0, "i64"), job, word)


def next_lane(w: Writer, job: Value, word: int) -> Value:
    """The number of the next lane, which is taken."""
    return w.counted_up(w.load(job, word, "ptr"), 0) if w.device else w.counted_up(job, word)


def lanes_taken(w: Writer, job: Value, word: int) -> Value:
    """How many lanes are taken; there may be fewer."""
    return w.load(w.load(job, word, "ptr"), type="i64") if w.device else w.load(job, word, "i64")


def share(w: Writer, job: Value, count: Value) -> None:
    """Calls the module's `loop(job)` in as many threads as the writer says, in fewer where lanes are few."""
    threads = w.threads
    loop, nothing, others, started = Value(w, "ptr", "@loop"), Value(w, "ptr", "null"), w.room(threads, "i64"), w.room(type="i64")
    w.store(w.literal(0, "i64"), started)
    how = w.room(16, "i64")  # a `pthread_attr_t`, which takes up to 64 bytes
    if threads > 1:
        w.external("pthread_attr_init", "i32", how)
        # 2**23 bytes for each thread, as the first one has in most systems; macOS gives others 512 kB
        w.external("pthread_attr_setstacksize", "i32", how, w.literal(2**23, "i64"))
    for more in range(1, threads):
        # 8 times as many lanes as side by side make it worth while to start another thread, which takes some 30 us
        with w.when(count >= (more + 1) * 8 * w.lanes):
            number = w.load(started, type="i64")
            failed = w.external("pthread_create", "i32", w.at(others, number, "i64"), how, loop, job)
            w.store(number + w.where(failed.equals(0), w.literal(1, "i64"), 0), started)
    w.call("loop", "ptr", job)
    if threads > 1:
        with w.counted(0, w.load(started, type="i64")) as number:
            w.external("pthread_join", "i32", w.load(others, number, "i64"), nothing)


def write_rows(w: Writer, given: int, returned: int) -> None:
    """A handler that takes rows of `given` numbers to rows of `returned` ones, lanes side by side, by the module's `row(given, returned)`.

    On a GPU a pointer to the thread's own part of the call's memory (`Writer.scratch`) comes after what is given.
    Places for which no row is left work out the last one once more.
    """
    with w.function("loop", "ptr", {"job": "ptr"}, attributes="noinline") as (job,):
        state, found, who = w.room(given + w.device), w.room(returned), w.room(w.lanes, "i64")
        rows, results, count = w.load(job, IN, "ptr"), w.load(job, OUT, "ptr"), w.load(job, COUNT, "i64")
        if w.device and w.scratch[0]:
            own = w.at(w.load(job, NEXT, "ptr"), w.thread()[0] * w.scratch[0] + FIRST_OF_SCRATCH, "double")
            w.store(own, state, given)
        with w.repeated() as leave:
            leave(~w.together(lanes_taken(w, job, NEXT) < count))
            with w.counted(0, w.lanes) as lane:
                number = next_lane(w, job, NEXT)
                w.store(number, who, lane)
                last = w.where(number < count, number, count - 1)
                with w.counted(0, given) as row:
                    w.store(w.load(rows, last * given + row, "double"), state, row * w.lanes + lane)
            w.run("row", state, found)
            with w.counted(0, w.lanes) as lane:
                number = w.load(who, lane, "i64")
                with w.when(number < count), w.counted(0, returned) as row:
                    w.store(w.load(found, row * w.lanes + lane, "double"), results, number * returned + row)
        w.give(Value(w, "ptr", "null"))

    def body(arguments: list[Given], results: list[Value]) -> None:
        job, count = w.room(4, "i64"), w.room(type="i64")
        w.store(product(w, arguments[0], 1), count)
        start_counting(w, job, NEXT)
        w.store(w.load(count, type="i64"), job, COUNT)
        w.store(arguments[0].data, job, IN)
        w.store(results[0], job, OUT)
        share(w, job, w.load(count, type="i64"))

    write_handler(w, 1, 1, body)
