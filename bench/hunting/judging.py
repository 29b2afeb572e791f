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


def search(family: Family, seeds: list[int]) -> list[Record]:
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
            told = f"{ask}; ts to {float(ts[i, -1])!r}; " + ", ".join(
                f"{name}={value!r}" for name, value in numbers[i].items()
            )
            found.append(Record(family.name, seed, dtype, told, outcome, error, said, seconds))
    return sorted(found, key=lambda record: record.seed)


def _truth(family: Family, numbers: list[dict], ts) -> tuple[Truth, np.ndarray]:
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
    truth = family.right(
        {name: np.concatenate(values) for name, values in every.items()}, np.tile(ts, (1 + NUDGES, 1))
    )
    whole = _whole(truth, np.tile(ts, (1 + NUDGES, 1))).reshape(1 + NUDGES, count, ts.shape[1] + 1, -1)
    growth = np.nan_to_num(np.max(np.abs(whole[1:] - whole[0]), axis=0) / NUDGE)
    return truth, growth


def _whole(truth: Truth, ts) -> np.ndarray:
    values = np.concatenate([truth.values, truth.last[:, None]], axis=1)
    t_end = ts[:, -1] if truth.t_end is None else truth.t_end
    times = np.concatenate([np.zeros_like(ts), t_end[:, None]], axis=1)
    return np.concatenate([values, times[..., None]], axis=2)


def places_of(family: Family) -> list[tuple[str, int]]:
    """Where each compared name stands: among the coordinates `q` or the speeds `u`."""
    q, u = (names.entries for names in (family.scene().coordinate_names, family.scene().speed_names))
    return [("q", q.index(name)) if name in q else ("u", u.index(name)) for name in family.names.split()]


def _judged(family: Family, ask: Ask, motion, i: int, numbers, truth: Truth, growth):
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
    wide = lambda grown: np.minimum(family.slack * 2 * count * rtol * (size + grown), MOST * size)
    allowed = wide(np.nan_to_num(np.max(growth[i, :, :-1], axis=0)))
    reached = np.isfinite(expected)
    if truth.event is None and not np.all(reached):
        return UNDECIDED, None, "the reference did not settle"
    if not np.array_equal(np.isfinite(values), reached) and truth.event is None:
        return _wrong(
            motion, np.inf, "values are not finite where the motion exists, or finite after its end"
        )
    both = reached & np.isfinite(values)
    off = np.where(both, np.abs(values - np.where(reached, expected, 0.0)) / allowed, 0.0)
    error = max(
        float(np.max(off, initial=0.0)),
        float(np.max(np.abs(end - truth.last[i]) / allowed)) if np.all(np.isfinite(end)) else np.inf,
    )
    worst = (
        f"`{family.names.split()[int(np.argmax(np.max(off, axis=0)))]}` is off by"
        f" {float(np.max(off * allowed, initial=0.0)):.2e}"
    )
    worst += (
        f", the end {np.array2string(end, precision=6)} for {np.array2string(truth.last[i], precision=6)}"
    )
    if truth.event is not None:
        named = motion.event_names[int(motion.event)] if code == EVENT else ""
        if named != truth.event[i]:
            return _wrong(
                motion,
                np.inf,
                f"ends by `{named}` at {float(motion.t_end):.6g} s instead of `{truth.event[i]}` at"
                f" {truth.t_end[i]:.6g} s",
            )
        scale = abs(truth.t_end[i] - numbers[i].get("t0", 0.0)) + 1e-3
        late = abs(float(motion.t_end) - truth.t_end[i]) / min(
            family.slack * 2 * count * rtol * (scale + growth[i, -1, -1]), MOST * scale
        )
        if late > error:
            error, worst = late, f"ends at {float(motion.t_end)!r} s instead of {float(truth.t_end[i])!r} s"
    elif code == EVENT:
        return _wrong(motion, np.inf, f"ends by an event at {float(motion.t_end):.6g} s")
    if not error > 1.0:
        return RIGHT, error, ""
    return _wrong(motion, error, worst)


def _size(family: Family, numbers, truth: Truth, i: int) -> np.ndarray:
    """What counts as the size of each name: the largest value, or what the family says; at least `size`
    or 1.
    """
    least = 1.0 if family.size is None else np.array(family.size(SimpleNamespace(**numbers[i])))
    return np.maximum(
        np.nanmax(np.abs(truth.values[i]), axis=0, initial=0.0, where=np.isfinite(truth.values[i])), least
    )


def _wrong(motion, error: float, said: str):
    """Wrong, unless the motion warns."""
    try:
        warned = "; ".join(jax.tree.map(jnp.asarray, motion).warnings)
    except Exception as broken:
        warned, said = "", f"{said}; `warnings` raised {type(broken).__name__}"
    return (BY_WARNING, error, f"{warned} ({said})") if warned else (WRONG, error, said)
