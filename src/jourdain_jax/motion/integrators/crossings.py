"""Relations of loads, poses, rows and stop events, watched over each step: numbers whose signs decide between branches (`lowering/relations.py`).

A step at whose end some sign is another one than at its start is refused, and from then on steps go half of the way that is left to where it ended,

    h <= max((t_refused - t)/2, resolved),       resolved = span/1000

until one of them, which is no longer than that, passes the change. Zero has the sign of what was before; what is no number changes none.

Where one number k changes its sign in a step, all are also looked at where it vanishes, on the line between the states at the ends,

    y* = y_0 + s (y_1 - y_0),   t* = t_0 + s h,   s = k_0/(k_0 - k_1)

so that |x - a| < w is met although it holds at neither end: that counts as two changes more. After the relations come the values of stop events, if
relations decide these: one that is not positive at y* makes the step end there.

`w` is the writer of a step (`motion/native/step.py`), `p` the rows of its lanes: `last` what the numbers were last that was not zero, `crossing_by` the time
by which one is known to change (infinite where none is, with the sign of the motion), `crossings` how many have changed, `together` the end of the first
step in which two or more have (infinite: none).
"""

import math
from typing import NamedTuple

from jourdain_jax.motion.native.layout import Form, Lanes, Number, StepWriter

# Of the span. Measured, a mass that passes brake strips of 0.03 to 30 % of half of its way, at a tolerance of 1e-8: 88 to 131 tried steps with 1/1,000 and
# 1/10,000, errors of 3e-8; with 1/100 strips of less than 0.2 % are passed in one step, and flagged. Without any, strips of 10 % are stepped over.
RESOLVED = 1e-3
LONGER = 1.01  # times that: a step that ends at a time asked for may be longer than the one that was meant


class Watched(NamedTuple):
    """A step as relations see it."""

    last: list[Number]
    count: Number  # of changes
    refused: Number
    falls: Number  # whether a stop event has happened where the one relation that changes does
    to_event: Number  # the step that ends there


def reach(w: StepWriter, p: Lanes) -> Number:
    """Return how long a step may be."""
    return w.larger(0.5 * ((p["crossing_by"] - p["t"]) * p["direction"]), RESOLVED * w.magnitude(p["last_goal"]))


def first_signs(w: StepWriter, form: Form, p: Lanes) -> None:
    """Take the signs at the start of a motion, in lanes that have tried no step."""
    fresh = w.equal(p["accepted"] + p["rejected"], 0.0)

    def begin() -> None:
        now = _unless_zero(w, _values(w, form, p, p["t"], p.pointer), [w.number(0.0)] * len(form.watched))
        p.put("last", [w.where(fresh, new, old) for new, old in zip(now, p.every("last"), strict=True)])
        p["crossing_by"] = w.where(fresh, p["direction"] * math.inf, p["crossing_by"])

    w.if_any(fresh, begin)


def watched(w: StepWriter, form: Form, p: Lanes, t1: Number, h: Number, y1: Number, fits: Number) -> Watched:
    """Return what a step `h` to the state `y1` crosses; `fits`: it would be accepted."""
    last, relations, long = p.every("last"), len(form.relations), w.magnitude(p["last_goal"])
    now = _unless_zero(w, _values(w, form, p, t1, y1), last)
    crossed = [_apart(a, b) for a, b in zip(last, now, strict=True)][:relations]
    count = _counted(w, crossed)
    shares = [w.where(is_crossed, a / (a - b), 0.0) for is_crossed, a, b in zip(crossed, last, now, strict=False)]
    share, once = sum(shares, start=0.0), w.equal(count, 1.0)
    between = w.room(len(now))
    for i, x in enumerate(now):
        w.store(x, between, i)

    def look() -> None:
        y, part = w.room(form.integrated), w.where(once, share, 0.0)
        for i in range(form.q_and_v):
            start = w.load(p.pointer, i)
            w.store(w.fma(part, w.load(y1, i) - start, start), y, i)
        for i, x in enumerate(_unless_zero(w, _values(w, form, p, w.fma(part, h, p["t"]), y), now)):
            w.store(x, between, i)

    w.if_any(once, look)
    hidden = [once & _apart(x := w.load(between, i), a) & _apart(x, b) for i, (a, b) in enumerate(zip(last, now, strict=True))]
    falls = fits & (_counted(w, hidden[relations:]) > 0.0)
    count = count + w.where(_counted(w, hidden[:relations]) > 0.0, 2.0, 0.0)
    refused = falls | (fits & (count > 0.0) & (w.magnitude(h) > LONGER * (RESOLVED * long)))
    return Watched(now, count, refused, falls, share * w.magnitude(h))


def note_signs(w: StepWriter, p: Lanes, step: Watched, t1: Number, moving: Number, counts: Number) -> None:
    """Note the signs after a step to `t1`, in lanes that are `moving`, and in which it `counts` or not."""
    direction, by, together = p["direction"], p["crossing_by"], p["together"]
    passed = counts & ((step.count > 0.0) | ((t1 - by) * direction >= 0.0))
    first = counts & (step.count > 1.0) & w.equal(together, math.inf)
    p.put("last", [w.where(moving & counts, new, old) for new, old in zip(step.last, p.every("last"), strict=True)])
    new = {"crossing_by": w.where(step.refused, t1, w.where(passed, direction * math.inf, by)), "together": w.where(first, t1, together)}
    for name, value in (new | {"crossings": p["crossings"] + w.where(counts, step.count, 0.0)}).items():
        p[name] = w.where(moving, value, p[name])


def _values(w: StepWriter, form: Form, p: Lanes, t: Number, y: Number) -> list[Number]:
    """The numbers in a state."""
    values = w.room(len(form.watched))
    w.run("relations", p.pointer, t, y, values)
    return [w.load(values, i) for i in range(len(form.watched))]


def _unless_zero(w: StepWriter, values: list[Number], otherwise: list[Number]) -> list[Number]:
    """The values, and what is otherwise where one has no sign."""
    return [w.where((x > 0.0) | (x < 0.0), x, other) for x, other in zip(values, otherwise, strict=True)]


def _apart(a: Number, b: Number) -> Number:
    """Whether their signs differ."""
    return ((a > 0.0) & (b < 0.0)) | ((a < 0.0) & (b > 0.0))


def _counted(w: StepWriter, found: list[Number]) -> Number:
    return sum((w.where(x, 1.0, 0.0) for x in found), start=0.0)
