"""Interpolate sampled inputs linearly, in machine code:

    f(t) = f_k + (t - t_k)/(t_{k+1} - t_k) (f_{k+1} - f_k),   t_k <= t < t_{k+1}
    df/dt = (f_{k+1} - f_k)/(t_{k+1} - t_k)

f is constant before the first sample and after the last.

Tables have the shape (tables, inputs, 2, samples): for each sampled input the times since the start, padded
with infinity, then the values. Knots, the times at which steps must end (`integrate/input_knots.py`), have
the shape (rows, knots). Samples of a batch may share tables and knots: if there are T tables, sample i of N
uses table i T / N.
"""

from jourdain_jax.integrate.loop.form import Form
from jourdain_jax.integrate.loop.lanes import Lanes, MachineWriter
from jourdain_jax.kernels.ffi import Given, last_size, product
from jourdain_jax.kernels.ir import Value

# words of a job: pointers to tables and knots, numbers of tables and rows of knots, samples per table, knots
# per row
WORDS_OF_SAMPLES = 6  # code
_TABLES, _KNOTS, _TABLE_COUNT, _KNOT_COUNT, _SAMPLES, _KNOTS_EACH = range(WORDS_OF_SAMPLES)


def store_samples(w: MachineWriter, words: Value, given: list[Given]) -> None:
    """Write code that stores the locations of tables and knots in the words of a job."""
    tables, knots = given
    for word, value in (
        (_TABLES, tables.data),
        (_KNOTS, knots.data),
        (_TABLE_COUNT, product(w, tables, 3)),
        (_KNOT_COUNT, product(w, knots, 1)),
        (_SAMPLES, last_size(w, tables)),
        (_KNOTS_EACH, last_size(w, knots)),
    ):
        w.store(value, words, word)


def begin_samples(
    w: MachineWriter, form: Form, words: Value, count: Value, lanes: Lanes, lane: Value, number: Value
) -> None:
    """Write code that assigns the table and the knots of sample `number` (of `count`) to a lane."""
    size = w.load(words, _SAMPLES, "i64")

    def share(of: int) -> Value:
        return w.binary("sdiv", number * w.load(words, of, "i64"), count)

    table = w.at(
        w.load(words, _TABLES, "ptr"), share(_TABLE_COUNT) * size * (2 * len(form.sampled)), "double"
    )
    knot = w.at(
        w.load(words, _KNOTS, "ptr"), share(_KNOT_COUNT) * w.load(words, _KNOTS_EACH, "i64"), "double"
    )
    for name, value in (("table", table), ("samples", size), ("knot", knot)):
        lanes.set(name, lane, value)


def pass_knot(w: MachineWriter, lanes: Lanes, lane: Value) -> None:
    """Write code that advances a lane to its next knot."""
    lanes.set("knot", lane, w.at(lanes.of("knot", lane, "ptr"), 1, "double"))


def write_sampled_inputs(w: MachineWriter, form: Form, with_slopes: bool) -> None:
    """Write `sampled_inputs(state, t, values)`, which stores the values of all sampled inputs of each lane at
    the time t since the start, and then their rates df/dt if `with_slopes`.
    """
    with w.procedure("sampled_inputs", "state t:real values") as (state, t, values):
        lanes, times, low, high = Lanes(w, form, state), w.room(), w.room(type="i64"), w.room(type="i64")
        w.store(t, times)
        with w.each_lane() as lane:
            now, count = w.load(times, lane, "double"), lanes.of("samples", lane, "i64")
            for i in range(len(form.sampled)):
                ts = w.at(lanes.of("table", lane, "ptr"), count * (2 * i), "double")
                fs = w.at(ts, count, "double")
                w.store(w.literal(0, "i64"), low)
                w.store(count - 1, high)
                with w.repeated() as leave:
                    a, b = w.load(low, type="i64"), w.load(high, type="i64")
                    leave((b - a) <= 1)
                    middle = w.binary("sdiv", a + b, 2)
                    after = w.load(ts, middle, "double") <= now
                    w.store(w.where(after, middle, a), low)
                    w.store(w.where(after, b, middle), high)
                k = w.load(low, type="i64")
                t_k, f_k = w.load(ts, k, "double"), w.load(fs, k, "double")
                span, rise = w.load(ts, k + 1, "double") - t_k, w.load(fs, k + 1, "double") - f_k
                there = (now - t_k) / span
                share = w.smaller(w.larger(there, 0.0), 1.0)
                w.store(f_k + share * rise, w.at(values, i * w.lanes + lane, "double"))
                if with_slopes:
                    w.store(
                        w.where(there.equals(share), rise / span, 0.0),
                        w.at(values, (len(form.sampled) + i) * w.lanes + lane, "double"),
                    )


def looked_up(w: MachineWriter, form: Form, state: Value, t: Value, with_slopes: bool) -> list[Value]:
    """Return the values of all sampled inputs at the time t since the start, then their rates if
    `with_slopes`.
    """
    count = len(form.sampled) * (1 + with_slopes)
    values = w.room(count)
    w.run("sampled_inputs", state, t, values)
    return [w.load(values, i) for i in range(count)]
