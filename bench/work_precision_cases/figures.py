"""The figures of issue 4 for the tilting disc: ratios of times at equal accuracy, each pair measured again in turns in this run."""

import time
from collections.abc import Callable, Iterator

from work_precision_cases import peer_sympy
from work_precision_cases.curve import Prepared
from work_precision_cases.problems import PROBLEMS

DISC = "tilting-disc"
OURS = ("Tsit5", "Dopri8")
ACCURATE = 1e-6
SECONDS, TURN = 2.0, 0.02


def cheapest(entries: list[dict], methods: Callable[[str], bool], error: float) -> dict | None:
    """The fastest single trajectory of the disc with at most this error."""
    fitting = [e for e in entries if e.get("problem") == DISC and e["batch"] == 1 and e["error"] is not None and e["error"] <= error and methods(e["method"])]
    return min(fitting, key=lambda e: e["seconds"], default=None)


def in_turns(runs: list[Callable[[], object]], seconds: float = SECONDS) -> list[float]:
    """The fastest of runs taken in turns, s: at least two rounds, and as many as fit in `seconds`; short runs are repeated within their turn."""
    best = [float("inf")] * len(runs)
    begin, rounds = time.perf_counter(), 0
    while rounds < 2 or time.perf_counter() - begin < seconds:
        rounds += 1
        for i, run in enumerate(runs):
            turn = before = time.perf_counter()
            while before - turn < TURN:
                run()
                after = time.perf_counter()
                best[i], before = min(best[i], after - before), after
    return best


def _ratio(name: str, required: float, theirs: dict | None, ours: dict | None, ready: dict[str, Prepared], missing: str) -> dict:
    if theirs is None or ours is None:
        return {"figure": name, "value": None, "required": required, "met": False, "how": missing}
    (their_time, our_time) = in_turns([lambda: ready[theirs["method"]].run(theirs["setting"]), lambda: ready[ours["method"]].run(ours["setting"])])
    how = (
        f"single trajectory, warm, in turns: {theirs['method']} at {theirs['setting']:.1e} (error {theirs['error']:.1e}) {1e3 * their_time:.4g} ms; "
        f"simulate, {ours['method']}, compiled once by the user's jit, at {ours['setting']:.1e} (error {ours['error']:.1e}) {1e3 * our_time:.4g} ms"
    )
    value = their_time / our_time
    return {"figure": name, "value": value, "required": required, "met": value >= required, "how": how}


def _without_python(theirs: dict, ours: dict, ready: dict[str, Prepared]) -> dict:
    """A bound from below on what SymPy's C could do in a compiled loop."""
    alone = peer_sympy.evaluations_alone(PROBLEMS[DISC], theirs["rhs_evaluations"])
    their_time, our_time = in_turns([alone, lambda: ready[ours["method"]].run(ours["setting"])])
    name = "disc at error 1e-6: evaluations of SymPy's C alone, in one loop of C, time / ours"
    how = f"{theirs['rhs_evaluations']:.0f} evaluations {1e3 * their_time:.4g} ms, without any integrator; ours {1e3 * our_time:.4g} ms"
    return {"figure": name, "value": their_time / our_time, "required": None, "met": None, "how": how}


def figures(entries: list[dict], ready: dict[str, Prepared]) -> Iterator[dict]:
    """Records {"figure", "value", "required", "met", "how"}. `ready`: prepared methods of the disc by name."""

    def ours(error):
        return cheapest(entries, lambda name: name in OURS, error)

    def peer(start):
        return lambda name: name.startswith(start)

    exudyn = cheapest(entries, peer("Exudyn"), ACCURATE)
    yield _ratio("disc at error 1e-6: Exudyn's time / ours", 100, exudyn, ours(ACCURATE), ready, "Exudyn is not installed or did not reach it")
    sympy = cheapest(entries, lambda name: name.startswith("SymPy") and "DOP853" in name, ACCURATE)
    yield _ratio("disc at error 1e-6: SymPy to C with DOP853, time / ours", 1, sympy, ours(ACCURATE), ready, "SymPy, SciPy or a C compiler is missing")
    if sympy is not None:
        yield _without_python(sympy, ours(ACCURATE), ready)
    reached = [e for e in entries if e.get("problem") == DISC and e["method"].startswith("MuJoCo") and e["error"] is not None and e["setting"] >= 1.99e-5]
    best = min(reached, key=lambda e: e["error"], default=None)
    name = "disc at the best error of MuJoCo at h >= 2e-5 s: its time / ours"
    yield _ratio(name, 1000, best, best and ours(best["error"]), ready, "MuJoCo is not installed")
    heyoka = cheapest(entries, peer("heyoka"), ACCURATE)
    lost = _ratio("disc at error 1e-6: heyoka's time / ours", 0, heyoka, ours(ACCURATE), ready, "heyoka is not installed")
    yield lost | {"required": None, "met": None}
    called = cheapest(entries, peer("simulate, as it comes"), ACCURATE)
    python = _ratio("disc at error 1e-6: `simulate` called from Python, time / under jit", 0, called, ours(ACCURATE), ready, "not measured")
    yield python | {"required": None, "met": None}
