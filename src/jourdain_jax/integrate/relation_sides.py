"""Determine the sides of relations (`lowering/sides.py`) at the start, and when a number leaves zero."""

from jourdain_jax.integrate.loop.form import Form
from jourdain_jax.integrate.loop.lanes import Lanes, Number, StepWriter, each_row
from jourdain_jax.integrate.loop.transitions import slowest


def first_sides(w: StepWriter, form: Form, p: Lanes) -> None:
    """Set the sides of relations at the start of a motion, in lanes that have not yet tried a step.

    A number that is zero, or an integer for `floor` and `ceil`, gets the side on which it is after the time
    d = eps^(1/4) span, by the midpoint rule.
    """
    fresh, t, first = w.equal(p["accepted"] + p["rejected"], 0.0), p["t"], form.stated
    d = w.eps**0.25 * p["last_goal"]

    def begin() -> None:
        f, y, pivots = w.room(form.integrated), w.room(form.integrated), w.room(max(len(form.monitored), 1))
        values, ahead, rates = (w.room(form.events) for _ in range(3))
        shares = w.table([0.0, 0.5, 1.0])

        def stage(i: Number, _: tuple) -> tuple:
            time = w.fma(d, shares[i], t)
            each_row(
                w,
                form.integrated,
                y,
                lambda row: w.fma(d * shares[i], w.load(f, row), w.load(p.pointer, row)),
            )
            w.run("rates", p.pointer, time, y, f, pivots)
            w.run("events", p.pointer, time, y, f, ahead, rates)
            each_row(w, form.events, values, lambda k: w.at_first(i, w.load(ahead, k), w.load(values, k)))
            return ()

        each_row(w, form.integrated, f, lambda row: 0.0)
        w.over_stages(3, stage, ())
        rows = list(form.rows["mode"])[form.modes :]
        for k, (row, whole) in enumerate(zip(rows, form.sides, strict=True), first):
            x, later = w.load(values, k), w.load(ahead, k)
            off = x - w.intrinsic("floor", x + 0.5) if whole else x
            # `x` is round-off relative to its change
            x = w.where(w.magnitude(off) <= w.eps**0.35 * w.magnitude(later - x), later, x)
            side = w.where(x > 0.0, 1.0, w.where(x < 0.0, -1.0, 0.0))
            side = w.where(w.equal(x, x), 2.0 * w.intrinsic("floor", x) + 1.0, 0.0) if whole else side
            w.store(w.where(fresh, side, w.load(p.pointer, row)), p.pointer, row)

    w.if_any(fresh, begin)


def leaving(w: StepWriter, form: Form, p: Lanes, found: list[list[Number]]) -> list[list[Number]]:
    """Return the values and rates of events. For a relation whose number rests at zero, the value is the
    distance to the threshold at which the number leaves zero.
    """
    c, rate = (list(part) for part in found)
    sides = p.every("mode")[form.modes :]
    for k, (side, whole) in enumerate(zip(sides, form.sides, strict=True), form.stated):
        if whole:
            continue
        rests, x = w.equal(side, 0.0), c[k]
        c[k] = w.where(rests, slowest(w, p) - w.magnitude(x), x)
        falling = w.where(w.equal(x, 0.0), -w.magnitude(rate[k]) * p["direction"], -rate[k])
        rate[k] = w.where(rests & ~(x < 0.0), falling, rate[k])
    return [c, rate]


def on_their_way(
    w: StepWriter, c_0: list, c_1: list, sunk: list, sinks: list, forward: Number
) -> tuple[list, list]:
    """Return `sinks` and `c_1`, corrected for values that still rise from zero at the end of a `forward`
    step: they do not sink, and count as positive. The step may be very short, because a saved time may lie
    within round-off of the event.
    """
    rising = [forward & ~(a > 0.0) & ~below & (b > a) for a, b, below in zip(c_0, c_1, sunk, strict=True)]
    c_1 = [w.where(rises & ~(b > 0.0), 1.0, b) for b, rises in zip(c_1, rising, strict=True)]
    return [x & ~rises for x, rises in zip(sinks, rising, strict=True)], c_1
