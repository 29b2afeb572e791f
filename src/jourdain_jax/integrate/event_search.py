"""Find the first event within a step and its time, by shorter trial steps from the last state before the
event.

The same code runs on JAX arrays and as machine code (`w`, `integrate/loop/step.py`). Values of events are
lists.

An event happens where its value falls through zero. At the start of a motion, a value may be zero up to
round-off. The motion continues if a first step h makes the value positive, by its rate or a higher
derivative:

    |c_0| <= noise c_0'   or   |c_0|, |h c_0'| <= noise/h |c(h) - c_0|,   noise = eps^0.6 span

c_0: value at the start; c_0': its rate; c(h): value after the step; span: time from start to end. If the
value is not positive after the step, the step is halved, down to `noise`, so that the search skips the zero
at the start. The event happens at the start if the value is negative there or if no step makes it positive.

Let t_b be the last time before the event, and t_a a time after it. At t_b all event values are positive or
rise from zero; at t_a at least one value is not positive. NaN counts as not positive. Among the values that
are not positive at t_a, the search follows the one whose secant from t_b reaches zero first. The first trial
uses the cubic through values and rates at both ends; later trials use Chandrupatla's method (inverse
quadratic interpolation if safe, otherwise bisection). If a trial finds an earlier event, the search follows
that event. If a value stays zero after the event, that end of the bracket counts as negative, and the bracket
is halved.

Trial times have no derivatives. Close to the event, Newton shifts follow,

    t <- t - c/cdot,   y <- y + (shift of t) f

unless c is NaN after the event. `put_tangents` then sets the tangents of the event's time and state.

Source: T. R. Chandrupatla, Advances in Engineering Software 28 (1997) 145-149.
"""

import math
from typing import Any, NamedTuple

from jourdain_jax.integrate import result_codes
from jourdain_jax.integrate.event_values import (
    Values,
    ahead,
    any_of,
    at_start,
    chosen,
    cubic,
    falls_through,
    first_event,
    is_flat,
    is_level,
    lowest,
    may_fall,
    no_event,
    reach_of_noise,
    trial,
    until_back,
)
from jourdain_jax.integrate.loop.form import Form
from jourdain_jax.integrate.loop.lanes import Lanes, Number, StepWriter, each_row
from jourdain_jax.integrate.loop.transitions import (
    SLOWLY,
    Happened,
    goes_on,
    is_left,
    is_side,
    pass_event,
    slowest,
)
from jourdain_jax.integrate.relation_sides import leaving, on_their_way

RUNNING, LOCATING = -1, -2  # code: a running motion, and one that locates an event
MOST_STEPS = 72  # numerics
DIFFERENTIABLE = 2  # numerics


def _each(w, condition, a: Values, b: Values) -> tuple:
    return tuple(w.where(condition, x, y) for x, y in zip(a, b, strict=True))


class Search(NamedTuple):
    """Bounds of the event's time: three times with the values of all events there. They are the last trial, a
    time on the other side of the event, and an earlier bound."""

    t: Values
    c: Any
    step: Any  # length of the step with the event
    left: Any  # remaining steps; 0: found
    shift: Any  # the next step, signed
    slope: Values  # magnitude of the mean rate of the values over that step

    @property
    def trying(self):
        """Return whether the search makes trial steps; otherwise it makes Newton shifts."""
        return self.left > DIFFERENTIABLE + 1.0


def search_of(form: Form, p: Lanes) -> Search:
    """Return the search that the rows of the lanes store."""
    values, count = p.every("search_c"), form.events
    c = tuple(values[i * count : (i + 1) * count] for i in range(3))
    step, left, shift = (p[f"search_{name}"] for name in ("step", "left", "shift"))
    return Search(p.every("search_t"), c, step, left, shift, p.every("search_slope"))


def _follow(
    w: StepWriter, form: Form, p: Lanes, begins: Number, changes: Number, start: tuple, end: tuple
) -> Number:
    """Advance the search in the lanes where it `changes`, by a step with its `start` and `end` (time, values
    of all events, rates). `begins`: whether the search begins with this step. Return the index of the event
    that the search follows.
    """
    old, (t_0, c_0, rate_0), (t_1, c_1, rate_1) = search_of(form, p), start, end
    # narrowed bracket: the trial time, a time on the other side of the event, and one of the previous two
    same = ~(no_event(c_1) ^ no_event(old.c[0]))
    narrowed_t = t_1, w.where(same, old.t[1], old.t[0]), w.where(same, old.t[0], old.t[1])
    narrowed_c = c_1, _each(w, same, old.c[1], old.c[0]), _each(w, same, old.c[0], old.c[1])
    t = _each(w, begins, (t_1, t_0, math.inf), _each(w, old.trying, narrowed_t, old.t))
    fresh_c = c_1, c_0, [math.nan] * len(c_1)
    c = [
        _each(w, begins, a, _each(w, old.trying, b, kept))
        for a, b, kept in zip(fresh_c, narrowed_c, old.c, strict=True)
    ]
    step = w.where(begins, w.magnitude(t_1 - t_0), old.step)
    left = w.where(begins, float(MOST_STEPS), w.larger(old.left - 1.0, 0.0))
    is_before = no_event(c[0])
    before, after = _each(w, is_before, c[0], c[1]), _each(w, is_before, c[1], c[0])
    first = first_event(w, before, after)
    guess = 1.0 - falls_through(w, t_1 - t_0, *(chosen(w, first, x) for x in (c_0, rate_0, c_1, rate_1)))
    tried, near = trial(w, t, [chosen(w, first, x) for x in c], step, left <= DIFFERENTIABLE + 3.0, guess)
    trying = begins | old.trying
    left = w.where(trying & near, DIFFERENTIABLE + 1.0, left)
    slack = math.sqrt(w.eps) * step
    value, rate = chosen(w, first, c_1), chosen(w, first, rate_0)
    # stay within the bracket; a value that was zero shortly before belongs to another event
    to = t_1 - value / rate
    usable = (
        (old.left > 0.0)
        & (to > w.smaller(t[0], t[1]) - slack)
        & (to < w.larger(t[0], t[1]) + slack)
        & (w.magnitude(rate) < math.inf)
    )
    slope = []
    for a, b, kept in zip(c_0, c_1, old.slope, strict=True):
        mean = w.magnitude((b - a) / (t_1 - t_0))
        slope.append(w.where(begins, w.where(mean < math.inf, mean, 0.0), kept))
    # its value beyond the event may be NaN
    newton = w.where(usable & ~w.is_nan(chosen(w, first, after)), -value / rate, 0.0)
    shift = w.where(trying, w.where(near, 0.0, tried - t_0), newton)
    c = [x for part in c for x in part]
    rows = {"t": t, "c": c, "step": [step], "left": [left], "shift": [shift], "slope": slope}
    for name, values in rows.items():
        p.put(f"search_{name}", _each(w, changes, values, p.every(f"search_{name}")))
    return first


def monitored(
    w: StepWriter,
    form: Form,
    p: Lanes,
    k: tuple[Number, Number],
    y1: Number,
    new: dict[str, Number],
    h: Number,
    accept: Number,
) -> dict[str, Number]:
    """Return the result of a step `h` that may contain an event, or in which an event is being located, and
    update the state `y1` after it. `k`: rates at its ends; `new`: time, step size, code and counts after it;
    `accept`: whether it is an accepted step of the motion (not a trial)."""
    count, y, t = form.events, p.pointer, p["t"]

    def events(t: Number, y: Number, slope: Number) -> list[list[Number]]:
        values, rates = w.room(count), w.room(count)
        w.run("events", p.pointer, t, y, slope, values, rates)
        return [[w.load(place, i) for i in range(count)] for place in (values, rates)]

    def armed(found: list[list[Number]]) -> list[list[Number]]:
        """Exclude ignored events, and events whose value has not left zero since the event last happened."""
        if not form.goes_on:
            return found
        found = leaving(w, form, p, found)
        over = [w.literal(stops and not form.stopping, w.truth) for stops in form.stops]
        disarmed = [(off > 0.0) | passed for off, passed in zip(p.every("disarmed"), over, strict=True)]
        return [
            [w.where(off, value, x) for x, off in zip(part, disarmed, strict=True)]
            for part, value in zip(found, (1.0, 0.0), strict=True)
        ]

    def between(share: float) -> list[list[Number]]:
        """Return values and rates at a `share` of the step, by the cubic of states and rates at its ends."""
        state, slope = w.room(form.y), w.room(form.y)

        def put(i: int | Number) -> None:
            a, b, slope_a, slope_b = (w.load(x, i) for x in (y, y1, *k))
            m, A, B = cubic(h, a, slope_a, b, slope_b)
            w.store(a + share * (m + share * (A + share * B)), state, i)
            w.store((m + share * (2.0 * A + 3.0 * share * B)) / h, slope, i)

        w.each(range(form.y), put)
        if form.projects:  # quaternions on the cubic are shorter than one
            w.run("project", p.pointer, t + share * h, state)
        return events(t + share * h, state, slope)

    at_begin, at_end = events(t, y, k[0]), events(new["t"], y1, k[1])
    begin, end = armed(at_begin), armed(at_end)
    locating = w.equal(p["code"], LOCATING)
    # most steps are far from events: for them `new` holds
    names = ["t", "h", "code", "accepted", "rejected", "event", "taken"]
    names += ["crossings", "passed", "begun"] if form.goes_on else []
    near = locating | any_of(may_fall(w, h, form.goes_on, *begin, *end))
    if form.goes_on:
        near = near | any_of(off > 0.0 for off in p.every("disarmed"))
    kept = w.room(len(names))
    for i, name in enumerate(names):
        w.store(new[name] if name in new else p[name], kept, i)

    def look_closer() -> None:
        (c_0, rate_0), (c_1, rate_1) = begin, end
        # a motion that starts beyond an event ends at once; a NaN state is not an event
        sound = w.equal(w.sum_of_squares(range(form.y), lambda i: 0.0 * w.load(y, i)), 0.0)
        fresh = w.equal(p["accepted"], p["begun"] if form.goes_on else 0.0) & ~locating & sound
        noise, dip = reach_of_noise(w, p["last_goal"]), w.room()
        lasts = w.magnitude(h) > noise
        w.store(1.0, dip)

        def seek_dips() -> None:
            if form.goes_on:
                # values that are positive by round-off after an event, or at the start, do not dip: near a
                # triple zero, as after a lift-off, the cubic dips by its own error
                level = [
                    fresh & is_level(w, a, slope, b, h, noise)
                    for a, slope, b in zip(*at_begin, at_end[0], strict=True)
                ]

                def with_rises(found: list[list[Number]]) -> list[list[Number]]:
                    """Reverse the sign of values that have not left zero since their event. A value that
                    rises and falls again within one step is then found as a new event.
                    """
                    return [
                        [
                            w.where(x > 0.0, -c, w.where(rests, kept, c_armed))
                            for x, c, rests, c_armed in zip(
                                p.every("disarmed"), values, level, now, strict=True
                            )
                        ]
                        for values, now, kept in zip(found, armed(found), (1.0, 0.0), strict=True)
                    ]

                share = lowest(w, h, *map(with_rises, (at_begin, between(0.5), at_end)))
                soon = between(2.0**-10)[1]
                back = until_back(w, h, p["direction"], noise, at_begin, soon, at_end[0])
                share = w.smaller(share, w.where(fresh, back, 1.0))
            else:
                share = lowest(w, h, at_begin, None, at_end)
            w.store(w.where(lasts, share, 1.0), dip)

        w.if_any(accept, seek_dips)
        share = w.load(dip)
        sunk, sinks = at_start(w, c_0, rate_0, c_1, h, p["direction"], p["last_goal"])
        returns = w.literal(0, w.truth)  # a value that may have left zero falls through it within the step
        was_trying = search_of(form, p).trying
        if form.goes_on:
            sinks, c_1 = on_their_way(w, c_0, c_1, sunk, sinks, ~locating | was_trying)
            zero = [w.number(0.0)] * count  # of a disarmed value, all else is round-off
            _, below = at_start(w, zero, at_begin[1], at_end[0], h, p["direction"], p["last_goal"])
            off = p.every("disarmed")
            returns = fresh & any_of((x > 0.0) & b for x, b in zip(off, below, strict=True))
        # the step began in a mode that had ended; a failed step does not show whether a value is level
        sunk_now = fresh & any_of(x & (accept | w.is_nan(0.0 * r)) for x, r in zip(sunk, rate_0, strict=True))
        sinks = [x & ~sunk_now for x in sinks]
        again = (any_of(sinks) | returns) & lasts
        dips = accept & ((share < 1.0) | again)
        share = w.where(again, ahead(w, h, c_0, rate_0, c_1, rate_1, sinks), share)
        # the trial passed a second zero of a value that rises from zero: use a shorter step
        restarts = locating & again
        happened = accept & ~dips & ~no_event(c_1)
        changes = happened | (locating & ~restarts)
        first = _follow(w, form, p, happened, changes, (t, c_0, rate_0), (new["t"], c_1, rate_1))
        search = search_of(form, p)
        # trials start at the last state before the event; a step over a dip of a value is repeated up to the
        # lowest value
        found, back = locating & ~restarts & w.equal(search.left, 0.0), changes & search.trying
        over = sunk_now | (accept & ~again & any_of(sinks))  # at the start
        shortens = dips | restarts
        stays = back | shortens | over

        def state(i: int | Number) -> Number:
            after = w.load(y1, i)
            return w.where(
                stays, w.load(y, i), w.where(found, w.fma(search.shift, w.load(k[0], i), after), after)
            )

        each_row(w, form.integrated, y1, state)
        which = float(count - 1)
        for i in reversed(range(count - 1)):
            which = w.where(sunk[i] | sinks[i], i, which)
        code = w.where(
            happened, LOCATING, w.where(found, result_codes.EVENT, w.where(locating, LOCATING, new["code"]))
        )
        code, tried = w.where(restarts, RUNNING, code), w.where(dips, 1.0, 0.0)
        shorter = share * w.magnitude(h)
        p["bound"] = w.where(shortens, shorter, p["bound"])  # of Taylor series, whose steps have no `h`
        changed = {
            "t": w.where(found, new["t"] + search.shift, w.where(stays, p["t"], new["t"])),
            "h": w.where(over, p["h"], w.where(shortens, shorter, w.where(locating, p["h"], new["h"]))),
            "code": w.where(over, result_codes.EVENT, code),
            "accepted": w.where(over, p["accepted"], new["accepted"] - tried),
            "rejected": w.where(over, p["rejected"], new["rejected"] + w.where(shortens, 1.0, 0.0)),
            "event": w.where(over, which, w.where(changes & (happened | was_trying), first, p["event"])),
            "taken": w.where(stays, 0.0, new["taken"]),
        }
        ends = found
        if form.goes_on:
            goes = goes_on(w, form, changed["event"]) & (found | over)
            # rounding may put an event just beyond its step; it then happens at the end of the step
            now, a, b = (x * p["direction"] for x in (changed["t"], *search.t[:2]))
            changed["t"] = p["direction"] * w.where(found, w.smaller(now, w.larger(a, b)), now)
            follows = over & (p["passed"] + p["crossings"] > 0.0)
            at_once = follows & ~goes  # at the same time as a transition before it
            ends = at_once | (found & ~goes)
            p.put("search_slope", [w.where(at_once, math.inf, x) for x in p.every("search_slope")])
            left = [~stays & is_left(w, x, rate, noise) for x, rate in zip(*at_end, strict=True)]
            p.put("disarmed", [w.where(gone, 0.0, x) for gone, x in zip(left, off, strict=True)])
            rate, slope = (chosen(w, changed["event"], x) for x in (rate_0, p.every("search_slope")))
            side = is_side(w, form, changed["event"])  # numbers of several relations may vanish together
            flat = ~side & (over | is_flat(w, rate, slope))
            quiet = side & (w.magnitude(rate * p["last_goal"]) <= slowest(w, p))
            passing = Happened(changed["event"], changed["t"], flat, quiet, goes, noise)
            stuck, repeats = w.room(), follows & any_of(sinks)
            w.store(0.0, stuck)
            w.if_any(goes, lambda: pass_event(w, form, p, y1, passing, stuck))
            passed, why = p["passed"] + w.where(goes & ~side, 1.0, 0.0), w.load(stuck)
            too_many = repeats | (why > 0.0) | (passed > float(form.transitions))
            others = w.where(repeats, float(result_codes.ZENO), float(result_codes.TOO_MANY_TRANSITIONS))
            why = w.where(why > 0.0, why, others)
            changed["code"] = w.where(goes, w.where(too_many, why, RUNNING), changed["code"])
            changed["crossings"] = p["crossings"] + w.where(goes & side, 1.0, 0.0)
            # crossings count as trial steps, which limits their number
            changed["rejected"] += w.where(goes & side & over, 1.0, 0.0)
            # the value falls back before it has left zero beyond round-off
            hides = any_of(
                w.equal(x, SLOWLY) & ~gone & ~(slope * p["direction"] > 0.0)
                for x, gone, slope in zip(off, left, at_end[1], strict=True)
            )
            changed["code"] = w.where(hides & accept & ~dips, float(result_codes.ZENO), changed["code"])
            changed |= {"passed": passed, "begun": w.where(goes, changed["accepted"], p["begun"])}
            changed["event"] = w.where(goes, -1.0, changed["event"])
        if form.moving:
            put_tangents(w, form, p, k[0], ends, new["t"], rate_0, y1)
        for i, name in enumerate(names):
            w.store(changed[name], kept, i)

    w.seldom(near, look_closer)
    return new | {name: w.load(kept, i) for i, name in enumerate(names)}


def slope_is_flat(w: StepWriter, p: Lanes, rate: Number) -> Number:
    """Return whether the value of a lane's event has zero slope where it falls through zero."""
    return is_flat(w, rate, chosen(w, p["event"], p.every("search_slope")))


def put_tangents(
    w: StepWriter, form: Form, p: Lanes, k: Number, found: Number, t: Number, rate: list[Number], y1: Number
) -> None:
    """Store the tangents of the time t of an event and of the state `y1` there. `k`: the rates. Each tangent
    of time shifts the state along its directions e. Values and rates are those before the event. If the value
    has zero slope, the tangents are NaN.

        dt = -(dc/dt dt + dc/dy dy + dc/dp dp)/cdot,   y <- y + e dt f(t, y),   t <- t + e dt,   e^2 = 0"""
    count, times = form.events, form.rows["dt"]

    def put() -> None:
        k_now = k
        values, pivots = w.room(count * len(times)), w.room(max(len(form.monitored), 1))
        slope = chosen(w, p["event"], rate)
        usable = found & w.differs(slope, 0.0) & (w.magnitude(slope) < math.inf)
        flat = found & slope_is_flat(w, p, slope)
        for part, row in enumerate(times, 1):
            if part > 1:  # rates at the shifted state
                k_now = w.room(form.integrated)
                w.run("rates", p.pointer, t, y1, k_now, pivots)
            w.run("event_tangents", p.pointer, t, y1, values)
            dc = chosen(w, p["event"], [w.load(values, (part - 1) * count + i) for i in range(count)])
            dt = w.where(flat, math.nan, w.where(usable, -dc / slope, 0.0))
            w.store(w.where(found, dt, w.load(p.pointer, row)), p.pointer, row)
            for other in range(len(times) + 1):
                if not other & part:
                    _move_rows(w, form, y1, k_now, (other | part) * form.y, other * form.y, dt, usable | flat)

    w.if_any(found, put)


def _move_rows(
    w: StepWriter, form: Form, y: Number, k: Number, rows: int, rates: int, dt: Number, moves: Number
) -> None:
    """Add `dt` times rows of `k`, from row `rates` on, to rows of `y`, from row `rows` on."""

    def moved(i: int | Number) -> Number:
        before = w.load(y, i + rows)
        return w.where(moves, w.fma(w.load(k, i + rates), dt, before), before)

    w.each(range(form.y), lambda i: w.store(moved(i), y, i + rows))
