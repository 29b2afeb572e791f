"""Time per evaluation of a right-hand side per lane of a batch: inside a compiled loop, as a solver calls it."""

import time
from collections.abc import Callable

import jax

_STEP = 1e-6  # s, so short that the states stay where they start


def seconds_per_evaluation(rates: Callable, state, lanes: int, evaluations: int = 20, repeats: int = 60) -> float:
    """Fastest of some repeats, in seconds per lane.

    **Arguments:** `rates(state)`, of the whole batch, with the structure of `state`; `evaluations` per compiled loop of explicit Euler steps
    (the step itself, one multiplication and one addition per state, is part of the time).
    """

    @jax.jit
    def loop(state):
        return jax.lax.fori_loop(0, evaluations, lambda _, y: jax.tree.map(lambda y, rate: y + _STEP * rate, y, rates(y)), state)

    return fastest(lambda: jax.block_until_ready(loop(state)), repeats) / (lanes * evaluations)


def fastest(run: Callable, repeats: int) -> float:
    """Wall time of the fastest of some runs after a first one that compiles, s."""
    run()
    laps = []
    for _ in range(repeats):
        begin = time.perf_counter()
        run()
        laps.append(time.perf_counter() - begin)
    return min(laps)


def least_processor_time(runs: dict[str, Callable], repeats: int) -> dict[str, float]:
    """Processor time of each run, s: the least of some repeats, in turn, after a first one that compiles."""
    for run in runs.values():
        run()
    laps: dict[str, list[float]] = {name: [] for name in runs}
    for _ in range(repeats):
        for name, run in runs.items():
            begin = time.process_time()
            run()
            laps[name].append(time.process_time() - begin)
    return {name: min(values) for name, values in laps.items()}
