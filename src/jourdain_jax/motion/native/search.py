"""Stop events in a step, and the search for one: the formulas of `motion/integrators/event_search.py` for lanes side by side."""

import math

from jourdain_jax.motion.integrators.event_search import Search, advanced, chosen, decided, is_flat
from jourdain_jax.motion.native.functions import Form
from jourdain_jax.motion.native.layout import Lanes, Layout, each_row, for_rows, over_rows
from jourdain_jax.native.ir import Value, Writer


def _of_lanes(p: Lanes, count: int) -> Search:
    """The search in the rows of lanes, for one of so many events."""
    values = p.every("search_c")
    c = tuple(tuple(values[i * count : (i + 1) * count]) for i in range(3))
    step, left, shift = (p[f"search_{name}"] for name in ("step", "left", "shift"))
    return Search(tuple(p.every("search_t")), c, step, left, shift, tuple(p.every("search_slope")))


def monitored(w: Writer, form: Form, p: Lanes, k: tuple[Value, Value], y1: Value, new: dict[str, Value], h: Value, accept: Value) -> dict[str, Value]:
    """The step in which an event may have happened or is being located, or before which one has; changes the state `y1` after it.

    `k`: slopes at its ends; `accept`: it is a step of the motion.
    """
    layout, count, y, t = form.layout, form.layout.events, p.pointer, p["t"]

    def events(t: Value, y: Value, slope: Value) -> list[list[Value]]:
        values, rates = w.room(count), w.room(count)
        w.run("events", p.pointer, t, y, slope, values, rates)
        return [[w.load(place, i) for i in range(count)] for place in (values, rates)]

    c_0, rate_0 = events(t, y, k[0])
    c_1, rate_1 = events(new["t"], y1, k[1])

    def advance(begins: Value, changes: Value) -> tuple[Search, Value]:
        first = w.room()
        w.store(p["event"], first)
        with w.when(w.any(changes)):
            old = _of_lanes(p, count)
            found, event = advanced(w, old, begins, (t, c_0, rate_0), (new["t"], c_1))
            newton = w.where(event.usable & ~event.beyond, -chosen(w, event.first, c_1) / chosen(w, event.first, rate_0), 0.0)
            rows = {"t": found.t, "c": [x for part in found.c for x in part], "step": [found.step], "left": [found.left], "slope": found.slope}
            rows["shift"] = [w.where(event.trying, found.shift, newton)]
            for name, values in rows.items():
                p.put(f"search_{name}", [w.where(changes, a, b) for a, b in zip(values, p.every(f"search_{name}"), strict=True)])
            w.store(w.literal(event.first, w.real), first)
        return _of_lanes(p, count), w.load(first)

    # a motion that starts beyond an event has no motion at all
    sound = over_rows(w, range(layout.y), 0.0, lambda total, i: total + 0.0 * w.load(y, i)).equals(0.0)
    found = decided(w, p, new, h, (c_0, rate_0, c_1, rate_1), accept, sound, (_of_lanes(p, count), advance))

    def state(i: int | Value) -> Value:
        after = w.load(y1, i)
        return w.where(found.stays, w.load(y, i), w.where(found.found, w.fma(found.search.shift, w.load(k[0], i), after), after))

    each_row(w, layout.integrated, y1, state)
    if form.moving:
        _put_tangents(w, form, p, k[0], found.found, new["t"], rate_0, y1)
    return new | found.new | {"taken": w.where(found.stays, 0.0, new["taken"])}


def slope_is_flat(w: Writer, p: Lanes, rate: Value) -> Value:
    """Whether the value of a lane's event has no slope where it falls through zero."""
    return is_flat(w, rate, chosen(w, p["event"], p.every("search_slope")))


def _put_tangents(w: Writer, form: Form, p: Lanes, k: Value, found: Value, t: Value, rate: list[Value], y1: Value) -> None:
    """Where an event is found at the time t in the state `y1`, the tangents of that time, and those of the state there; `k`: the rates.

    Each tangent of time is found in turn, the state being moved by it, with e the directions taken together in it,

        dt = -(dc/dt dt + dc/dy dy + dc/dp dp)/cdot,   y <- y + e dt f(t, y),   t <- t + e dt,   e^2 = 0

    where values, tangents and rates are those before; dt is NaN where c has no slope there.
    """
    layout, count, times = form.layout, form.layout.events, form.layout.rows["dt"]
    with w.when(w.any(found)):
        values, pivots = w.room(count * len(times)), w.room(max(len(form.monitored), 1))
        slope = chosen(w, p["event"], rate)
        usable = found & slope.differs(0.0) & (w.magnitude(slope) < math.inf)
        flat = found & slope_is_flat(w, p, slope)
        for part, row in enumerate(times, 1):
            if part > 1:  # what is known of the rates is of the state as it was
                k = w.room(layout.integrated)
                w.run("rates", p.pointer, t, y1, k, pivots)
            w.run("event_tangents", p.pointer, t, y1, values)
            dc = chosen(w, p["event"], [w.load(values, (part - 1) * count + i) for i in range(count)])
            dt = w.where(flat, math.nan, w.where(usable, -dc / slope, 0.0))
            w.store(w.where(found, dt, w.load(p.pointer, row)), p.pointer, row)
            for other in range(len(times) + 1):
                if not other & part:
                    _move_rows(w, layout, y1, k, (other | part) * layout.y, other * layout.y, dt, usable | flat)


def _move_rows(w: Writer, layout: Layout, y: Value, k: Value, rows: int, rates: int, dt: Value, moves: Value) -> None:
    """Adds the rates that begin with row `rates` of `k`, times `dt`, to those that begin with row `rows` of `y`."""

    def moved(i: int | Value) -> Value:
        before = w.load(y, i + rows)
        return w.where(moves, w.fma(w.load(k, i + rates), dt, before), before)

    for_rows(w, range(layout.y), lambda i: w.store(moved(i), y, i + rows))
