"""Relations whose signs are watched, as in `motion/integrators/crossings.py`, for lanes side by side."""

import math
from typing import NamedTuple

from jourdain_jax.motion.integrators.crossings import LONGER, RESOLVED
from jourdain_jax.motion.native.functions import Form
from jourdain_jax.motion.native.layout import Lanes
from jourdain_jax.native.ir import Value, Writer


class Watched(NamedTuple):
    """A step as relations see it."""

    last: list[Value]
    changes: Value
    refused: Value
    falls: Value
    to_event: Value


def write_begin(w: Writer, form: Form, p: Lanes) -> None:
    """The signs at the start of a motion, in lanes that have tried no step."""
    fresh = (p["accepted"] + p["rejected"]).equals(0.0)
    with w.when(w.any(fresh)):
        now = _values(w, form, p, p["t"], p.pointer, [w.number(0.0)] * len(form.watched))
        p.put("last", [w.where(fresh, new, old) for new, old in zip(now, p.every("last"), strict=True)])
        p["crossing_by"] = w.where(fresh, p["direction"] * math.inf, p["crossing_by"])


def _values(w: Writer, form: Form, p: Lanes, t: Value, y: Value, otherwise: list[Value]) -> list[Value]:
    values = w.room(w.real, len(form.watched))
    w.call("relations", "void", p.pointer, t, y, values)
    found = [w.load(w.real, values, i) for i in range(len(form.watched))]
    return [w.where((x > 0.0) | (x < 0.0), x, other) for x, other in zip(found, otherwise, strict=True)]


def _apart(a: Value, b: Value) -> Value:
    return ((a > 0.0) & (b < 0.0)) | ((a < 0.0) & (b > 0.0))


def _resolved(w: Writer, p: Lanes) -> Value:
    return RESOLVED * w.magnitude(p["last_goal"])


def reach(w: Writer, form: Form, p: Lanes, h: Value) -> Value:
    """The step `h`, or as far as one may go."""
    if not form.relations:
        return h
    return w.smaller(h, w.larger(0.5 * ((p["crossing_by"] - p["t"]) * p["direction"]), _resolved(w, p)))


def watched(w: Writer, form: Form, p: Lanes, t1: Value, step: Value, y1: Value, fits: Value) -> Watched:
    """What a step to the state `y1` crosses; `fits`: it would be accepted."""
    before, relations, layout = p.every("last"), len(form.relations), form.layout
    now, count, share = _values(w, form, p, t1, y1, before), w.number(0.0), w.number(0.0)
    for a, b in zip(before[:relations], now, strict=False):
        crossed = _apart(a, b)
        count, share = count + w.where(crossed, 1.0, w.number(0.0)), share + w.where(crossed, a / (a - b), 0.0)
    once, hidden = count.equals(1.0), w.room(w.real, 2)
    for k in range(2):
        w.store(w.number(0.0), hidden, k)
    with w.when(w.any(once)):
        y = w.room(w.real, layout.integrated)
        for i in range(layout.coordinates + layout.speeds):
            start = w.load(w.real, p.pointer, i)
            w.store(w.fma(w.where(once, share, 0.0), w.load(w.real, y1, i) - start, start), y, i)
        between = _values(w, form, p, w.fma(w.where(once, share, 0.0), step, p["t"]), y, now)
        for i, (a, b, x) in enumerate(zip(before, now, between, strict=True)):
            found = once & _apart(x, a) & _apart(x, b)
            w.store(w.where(found, 1.0, w.load(w.real, hidden, int(i >= relations))), hidden, int(i >= relations))
    count = w.fma(w.load(w.real, hidden, 0), 2.0, count)
    falls = fits & (w.load(w.real, hidden, 1) > 0.0)
    refused = falls | (fits & (count > 0.0) & (w.magnitude(step) > LONGER * _resolved(w, p)))
    return Watched(now, count, refused, falls, share * w.magnitude(step))


def note(w: Writer, p: Lanes, step: Watched, t1: Value, moving: Value, counts: Value) -> None:
    """The signs after a step to `t1`, in lanes that are `moving`, and in which it `counts` or not."""
    direction, by, together = p["direction"], p["crossing_by"], p["together"]
    counts = moving & counts
    passed = counts & ((step.changes > 0.0) | ((t1 - by) * direction >= 0.0))
    p["crossing_by"] = w.where(moving & step.refused, t1, w.where(passed, direction * math.inf, by))
    p.put("last", [w.where(counts, new, old) for new, old in zip(step.last, p.every("last"), strict=True)])
    p["crossings"] = p["crossings"] + w.where(counts, step.changes, 0.0)
    p["together"] = w.where(counts & (step.changes > 1.0) & together.equals(math.inf), t1, together)
