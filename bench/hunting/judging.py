"""Cases of a family: drawn, asked, and judged against the truth.

A value may be off by `2 (steps + 10) rtol (size + growth)`: so much may add up from what step-size control
lets pass per step (at most 1000 steps count); `growth` is how much the truth amplifies small changes of the
numbers that define it. Five per cent of the size is wrong in any case.
"""

import time
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np

from hunting.asking import Failed, ask_for, tolerance
from hunting.family import Ask, Family, Truth, together
from hunting.record import BY_CODE, BY_WARNING, RIGHT, UNDECIDED, WRONG, Record

NUDGE, NUDGES = 1e-6, 2  # relative change of numbers, and how often they are changed
MOST = 0.05  # of the size of a quantity: wrong in any case
SUCCESS, EVENT = 0, 1


def search(family: Family, seeds) -> list[Record]:
    """Records of the cases with these seeds; those that ask alike run together."""
    single = not jax.config.jax_enable_x64
    dtype, found = "float32" if single else "float64", []
    for ask in family.asks:
        own = [seed for seed in seeds if family.numbers(seed)[0] is ask]
        if not own:
            continue
        begin = time.process_time()
        numbers = [family.numbers(seed, single)[1] for seed in own]
        ts = np.stack([family.saved(ask, one, single) for one in numbers])
        truth, growth = _truth(family, numbers, ts)
        motions = ask_for(family, ask, numbers, ts)
        seconds = (time.process_time() - begin) / len(own)
        for i, seed in enumerate(own):
            outcome, error, said = _judged(family, ask, motions[i], i, numbers, truth, growth)
            values = ", ".join(f"{name}={value!r}" for name, value in numbers[i].items())
            told = f"{ask}; ts to {float(ts[i, -1])!r}; {values}"
            found.append(Record(family.name, seed, dtype, told, outcome, error, said, seconds))
    return sorted(found, key=lambda record: record.seed)


def _truth(family: Family, numbers, ts):
    """The truth, and how much its values (cases, times + 1, names + 1: the end, and the time, too) grow from
    a relative change of 1.
    """
    draw = np.random.default_rng(5)
    rows, count = together(numbers), len(numbers)
    every = {name: [value] for name, value in rows.items()}
    for _ in range(NUDGES):
        for name, value in rows.items():
            off = NUDGE * np.where(draw.uniform(size=count) < 0.5, -1.0, 1.0)
            absolute = off if family.size is None else 0.0
            every[name].append(value if name in family.fixed else value * (1 + off) + absolute)
    stops = np.tile(ts, (1 + NUDGES, 1))
    truth = family.right({name: np.concatenate(values) for name, values in every.items()}, stops)
    whole = _whole(truth, stops).reshape(1 + NUDGES, count, ts.shape[1] + 1, -1)
    growth = np.nan_to_num(np.max(np.abs(whole[1:] - whole[0]), axis=0) / NUDGE)
    return truth, growth


def _whole(truth: Truth, ts):
    values = np.concatenate([truth.values, truth.last[:, None]], axis=1)
    t_end = ts[:, -1] if truth.t_end is None else truth.t_end
    times = np.concatenate([np.zeros_like(ts), t_end[:, None]], axis=1)
    return np.concatenate([values, times[..., None]], axis=2)


def places_of(family: Family):
    """Where each compared name stands: among the coordinates `q` or the speeds `u`."""
    q, u = (names.entries for names in (family.scene().coordinate_names, family.scene().speed_names))
    return [("q", q.index(name)) if name in q else ("u", u.index(name)) for name in family.names.split()]


def _judged(family: Family, ask: Ask, motion, i, numbers, truth: Truth, growth):
    """Outcome, error relative to its bound, and words."""
    if isinstance(motion, Failed):
        return motion.outcome, None, motion.said
    code = int(motion.result)  # a flag is a flag, whether or not there is a reference
    if code not in (SUCCESS, EVENT):
        return BY_CODE, None, f"code {code} at t = {float(motion.t_end):.4g} s"
    places = places_of(family)
    values = np.stack([getattr(motion, kind)[:, k] for kind, k in places], axis=-1)
    end = np.stack([getattr(motion, f"{kind}_end")[k] for kind, k in places])
    rtol = tolerance(ask)
    count = min(int(motion.accepted), 1000) + 10
    expected, size = truth.values[i], _size(family, numbers, truth, i)
    wide = lambda grown, size: np.minimum(family.slack * 2 * count * rtol * (size + grown), MOST * size)
    allowed = wide(np.nan_to_num(np.max(growth[i, :, :-1], axis=0)), size)
    reached = np.isfinite(expected)
    if truth.event is None and not np.all(reached):
        return UNDECIDED, None, "the reference did not settle"
    if not np.array_equal(np.isfinite(values), reached) and truth.event is None:
        said = "values are not finite where the motion exists, or finite after its end"
        return _wrong(motion, np.inf, said)
    off = np.abs(values - expected) / allowed
    off = np.where(np.isfinite(off), off, 0.0)
    last, t_end = truth.last[i], float(motion.t_end)
    at_end = np.max(np.abs(end - last) / allowed) if np.all(np.isfinite(end)) else np.inf
    error = float(max(np.max(off, initial=0.0), at_end))
    name = family.names.split()[int(np.argmax(np.max(off, axis=0)))]
    worst = f"`{name}` is off by {float(np.max(off * allowed, initial=0.0)):.2e}, the end {end} for {last}"
    if truth.event is not None:
        named, right = motion.event_names[int(motion.event)] if code == EVENT else "", float(truth.t_end[i])
        if named != truth.event[i]:
            said = f"ends by `{named}` at {t_end:.6g} s instead of `{truth.event[i]}` at {right:.6g} s"
            return _wrong(motion, np.inf, said)
        scale = abs(right - numbers[i].get("t0", 0.0)) + 1e-3
        late = abs(t_end - right) / wide(growth[i, -1, -1], scale)
        if late > error:
            error, worst = late, f"ends at {t_end!r} s instead of {right!r} s"
    elif code == EVENT:
        return _wrong(motion, np.inf, f"ends by an event at {t_end:.6g} s")
    if not error > 1.0:
        return RIGHT, error, ""
    return _wrong(motion, error, worst)


def _size(family: Family, numbers, truth: Truth, i):
    """What counts as the size of each name: the largest value, or what the family says; at least `size`
    or 1.
    """
    least = 1.0 if family.size is None else np.array(family.size(SimpleNamespace(**numbers[i])))
    return np.maximum(np.nanmax(np.abs(truth.values[i]), axis=0, initial=0.0), least)


def _wrong(motion, error, said):
    """Wrong, unless the motion warns."""
    try:
        warned = "; ".join(jax.tree.map(jnp.asarray, motion).warnings)
    except Exception as broken:
        warned, said = "", f"{said}; `warnings` raised {type(broken).__name__}"
    return (BY_WARNING, error, f"{warned} ({said})") if warned else (WRONG, error, said)
