"""Relations whose signs are watched: the formulas of `motion/integrators/crossings.py` for lanes side by side."""

import math

from jourdain_jax.motion.integrators.crossings import Crossings, Watched, noted, unless_zero
from jourdain_jax.motion.integrators.crossings import watched as watched_by
from jourdain_jax.motion.native.functions import Form
from jourdain_jax.motion.native.layout import Lanes
from jourdain_jax.native.ir import Value, Writer


def of_lanes(p: Lanes) -> Crossings:
    """The signs so far."""
    return Crossings(tuple(p.every("last")), p["crossing_by"], p["crossings"], p["together"])


def write_begin(w: Writer, form: Form, p: Lanes) -> None:
    """The signs at the start of a motion, in lanes that have tried no step."""
    fresh = (p["accepted"] + p["rejected"]).equals(0.0)
    with w.when(w.any(fresh)):
        now = unless_zero(w, _values(w, form, p, p["t"], p.pointer), [w.number(0.0)] * len(form.watched))
        p.put("last", [w.where(fresh, new, old) for new, old in zip(now, p.every("last"), strict=True)])
        p["crossing_by"] = w.where(fresh, p["direction"] * math.inf, p["crossing_by"])


def _values(w: Writer, form: Form, p: Lanes, t: Value, y: Value) -> list[Value]:
    values = w.room(len(form.watched))
    w.run("relations", p.pointer, t, y, values)
    return [w.load(values, i) for i in range(len(form.watched))]


def watched(w: Writer, form: Form, p: Lanes, t1: Value, step: Value, y1: Value, fits: Value) -> Watched:
    """What a step to the state `y1` crosses; `fits`: it would be accepted."""
    layout = form.layout

    def between(once: Value, share: Value, now: tuple[Value, ...]) -> list[Value]:
        found = w.room(len(now))
        for i, x in enumerate(now):
            w.store(x, found, i)
        with w.when(w.any(once)):
            y, part = w.room(layout.integrated), w.where(once, share, 0.0)
            for i in range(layout.coordinates + layout.speeds):
                start = w.load(p.pointer, i)
                w.store(w.fma(part, w.load(y1, i) - start, start), y, i)
            for i, x in enumerate(unless_zero(w, _values(w, form, p, w.fma(part, step, p["t"]), y), now)):
                w.store(x, found, i)
        return [w.load(found, i) for i in range(len(now))]

    return watched_by(w, of_lanes(p), _values(w, form, p, t1, y1), len(form.relations), between, fits, step, p["last_goal"])


def note(w: Writer, p: Lanes, step: Watched, t1: Value, moving: Value, counts: Value) -> None:
    """The signs after a step to `t1`, in lanes that are `moving`, and in which it `counts` or not."""
    old, new = of_lanes(p), noted(w, of_lanes(p), step, t1, p["direction"], counts)
    p.put("last", [w.where(moving, *pair) for pair in zip(new.last, old.last, strict=True)])
    for name, *pair in (("crossing_by", new.by, old.by), ("crossings", new.count, old.count), ("together", new.together, old.together)):
        p[name] = w.where(moving, *pair)
