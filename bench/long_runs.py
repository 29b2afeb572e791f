"""Long runs of nonholonomic scenes: energy and integrals against time, for each structure-preserving solver and for Tsit5 and Dopri8 at equal cost.

    python bench/long_runs.py [--quick] [--steps 100000] [--json FILE] [--out bench/results]

Every structure-preserving method takes the same number of steps of one length. Tsit5 and Dopri8 get the tightest tolerance (of 1e-3, ..., 1e-13) with
which they need no more processor time than the implicit midpoint rule. Prints a table, writes it as JSON and as Markdown (`long_runs.md`), and draws
`long_runs.png`: the largest error so far against time. `--quick`: 2,000 steps and fewer methods, under two minutes.
"""

import argparse
import json
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import partial
from importlib.metadata import version
from pathlib import Path

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from long_runs_scenes import ChaoticOscillator, ContactOscillator, GaugeTwin, Transmission

import jourdain_jax as jj

METHODS = {
    "implicit midpoint": jj.ImplicitMidpoint,
    "DLA, midpoint": jj.DiscreteLagrangeDAlembert,
    "DLA, trapezoidal": partial(jj.DiscreteLagrangeDAlembert, "trapezoidal"),
    "discrete gradient": jj.DiscreteGradient,
}
EXPLICIT = {"Tsit5": diffrax.Tsit5(), "Dopri8": diffrax.Dopri8()}
DLA = ("DLA, midpoint", "DLA, trapezoidal")
SAVED = 1000  # times, besides the start
TOLERANCES = [10.0**-k for k in range(3, 14)]


@dataclass(frozen=True)
class Problem:
    """A scene, a step (s), its integral besides the energy, and which structure-preserving methods are run."""

    name: str
    scene: jj.Scene
    step: float
    integral: str | None
    methods: tuple[str, ...] = tuple(METHODS)
    explicit: tuple[str, ...] = tuple(EXPLICIT)


PROBLEMS = [
    Problem("contact oscillator", ContactOscillator(), 0.2, "driver"),
    Problem("its gauge twin", GaugeTwin(), 0.2, "driver", DLA, ()),  # for the others it is the contact oscillator
    Problem("transmission", Transmission(), 0.2, "driver"),
    Problem("Chaplygin sleigh", jj.models.ChaplyginSleigh(), 0.1, "heading and slide"),
    Problem("chaotic oscillator", ChaoticOscillator(), 0.2, None),
]
QUICK = [
    PROBLEMS[0],
    Problem("its gauge twin", GaugeTwin(), 0.2, "driver", DLA[:1], ()),
    Problem("transmission", Transmission(), 0.2, "driver", ("implicit midpoint", "discrete gradient"), ("Dopri8",)),
]


@dataclass(frozen=True)
class Outcome:
    """Errors of one run: the largest over all, the first tenth and the last tenth of it; seconds of processor time."""

    problem: str
    method: str
    step: float | None  # s; None: adaptive
    tolerance: float | None
    steps: int
    result: str
    energy: tuple[float, float, float]  # relative
    integral: tuple[float, float, float] | None  # absolute
    seconds: float


def timed(run: Callable) -> tuple[jj.Trajectory, float]:
    """A motion and the processor time it took, without compilation: the less of two runs."""
    run()
    seconds = []
    for _ in range(2):
        begin = time.process_time()
        motion = jax.block_until_ready(run())
        seconds.append(time.process_time() - begin)
    return motion, min(seconds)


def errors(values) -> np.ndarray:
    """Change since the start."""
    values = np.asarray(values)
    return np.abs(values - values[0])


def extremes(error: np.ndarray) -> tuple[float, float, float]:
    """The largest error over all, the first tenth and the last tenth of a run."""
    tenth = len(error) // 10
    return float(error.max()), float(error[: tenth + 1].max()), float(error[-tenth:].max())


def tolerance_for(run: Callable, seconds: float) -> float:
    """The tightest tolerance that costs no more than `seconds`; the loosest where none does."""
    for tolerance in reversed(TOLERANCES):
        if timed(partial(run, tolerance))[1] <= seconds:
            return tolerance
    return TOLERANCES[0]


def outcome(problem: Problem, method: str, motion: jj.Trajectory, seconds: float, step: float | None, tolerance: float | None):
    """The row of a run, and its errors against time."""
    balance = np.asarray(motion.energies().balance)
    energy = errors(balance) / abs(balance[0])
    integral = None if problem.integral is None else errors(_integral_of(motion, problem.integral))
    row = Outcome(
        problem.name, method, step, tolerance, int(motion.accepted), motion.message, extremes(energy), None if integral is None else extremes(integral), seconds
    )
    return row, (np.asarray(motion.ts), energy, integral)


def _integral_of(motion: jj.Trajectory, name: str) -> np.ndarray:
    """The integral against time; that of the sleigh in a form that has no jump where its turn rate has died away to round-off of either sign."""
    if not isinstance(motion.scene, jj.models.ChaplyginSleigh):
        return np.asarray(motion.invariants()[name])
    sleigh, heading = motion.scene, np.asarray(motion["heading"])
    k = np.sqrt(float(sleigh.inertia / sleigh.mass + sleigh.offset**2))
    forward = np.asarray(motion["x_rate"]) * np.cos(heading) + np.asarray(motion["y_rate"]) * np.sin(heading)
    return float(sleigh.offset) * heading - k * np.arctan2(forward, k * np.asarray(motion["heading_rate"]))


def runs(problem: Problem, steps: int) -> list:
    """All runs of a problem: rows and errors against time."""
    scene, saved = problem.scene, min(SAVED, steps // 20)
    start = jj.start(scene, **scene.example)
    span = problem.step * steps
    found = []

    def with_step(method, ts):
        return jj.simulate(scene, start, ts=ts, solver=method(step=problem.step), max_steps=2 * steps)

    def with_tolerance(solver, ts, tolerance):
        tolerance = jnp.asarray(tolerance)
        return jj.simulate(scene, start, ts=ts, rtol=tolerance, atol=tolerance, solver=solver, max_steps=100 * steps)

    ts = jnp.linspace(0.0, span, saved + 1)
    for name in problem.methods:
        motion, seconds = timed(partial(with_step, METHODS[name], ts))
        found.append(outcome(problem, name, motion, seconds, problem.step, None))
        print(_line(found[-1][0]), flush=True)
    for name in problem.explicit:
        # one saved time only: the steps between saved times are to be the method's own
        own = jnp.array([span / 20])
        allowed = found[0][0].seconds / 20  # of the implicit midpoint rule, which comes first
        tolerance = tolerance_for(partial(with_tolerance, EXPLICIT[name], own), allowed)
        motion, seconds = timed(partial(with_tolerance, EXPLICIT[name], ts, tolerance))
        found.append(outcome(problem, name, motion, seconds, None, tolerance))
        print(_line(found[-1][0]), flush=True)
    return found


def _line(row: Outcome) -> str:
    how = f"h = {row.step:g}" if row.tolerance is None else f"tol = {row.tolerance:.0e}"
    integral = "" if row.integral is None else f"  integral {row.integral[0]:.1e} ({row.integral[1]:.1e}, {row.integral[2]:.1e})"
    energy = f"energy {row.energy[0]:.1e} ({row.energy[1]:.1e}, {row.energy[2]:.1e})"
    ended = "" if row.result == "reached the end of its span" else f"  {row.result}"
    return f"{row.problem:20s} {row.method:18s} {how:12s} {row.steps:7d} steps {row.seconds:7.2f} s  {energy}{integral}{ended}"


def table(rows: list[Outcome]) -> str:
    """The table of the documentation, in Markdown."""
    lines = ["| scene | solver | h or tolerance | s | energy, relative | integral |", "|---|---|---|---|---|---|"]
    for row in rows:
        how = f"h = {row.step:g} s" if row.tolerance is None else f"{row.tolerance:.0e}"
        errors = ["" if e is None else f"{e[0]:.0e} ({e[1]:.0e}, {e[2]:.0e})" for e in (row.energy, row.integral)]
        ended = "" if row.result == "reached the end of its span" else f"; {row.result}"
        lines.append(f"| {row.problem} | {row.method} | {how} | {row.seconds:.2g} | {errors[0]}{ended} | {errors[1]} |")
    return "\n".join(lines) + "\n"


def draw(found: dict, path: Path) -> None:
    """Largest error so far against time: a row per problem, energy and integral side by side."""
    import matplotlib.pyplot as plt

    colours = dict(zip((*METHODS, *EXPLICIT), ("#0072b2", "#d55e00", "#e69f00", "#009e73", "#999999", "#000000"), strict=True))
    figure, axes = plt.subplots(len(found), 2, figsize=(10, 2.5 * len(found) + 0.7), squeeze=False, sharex="all")
    for (name, rows), (left, right) in zip(found.items(), axes, strict=True):
        for row, (ts, energy, integral) in rows:
            for axis, error in ((left, energy), (right, integral)):
                if error is not None:
                    worst = np.maximum(np.maximum.accumulate(error[1:]), 1e-17)
                    axis.loglog(ts[1:], worst, color=colours[row.method], ls="--" if row.method in EXPLICIT else "-", lw=1.6)
        left.set_ylabel(f"{name}\nrelative error")
        left.set_title("energy", fontsize=10)
        if _integral(name) is None:
            right.set_axis_off()
        else:
            right.set(ylabel="error", xlabel="t (s)")
            right.set_title(f"integral: {_integral(name)}", fontsize=10)
            right.tick_params(labelbottom=True)
        for axis in (left, right):
            axis.grid(alpha=0.3)
            axis.set_ylim(1e-17, 10)
        left.set_xlabel("t (s)")
        left.tick_params(labelbottom=True)
    handles = [plt.Line2D([], [], color=colour, ls="--" if name in EXPLICIT else "-", lw=1.6) for name, colour in colours.items()]
    labels = [name if name in METHODS else f"{name}, at most the cost of midpoint" for name in colours]
    figure.legend(handles, labels, loc="upper center", ncol=3, frameon=False)
    figure.tight_layout(rect=(0, 0, 1, 1 - 0.75 / figure.get_figheight()))
    figure.savefig(path, dpi=130)


def _integral(problem: str) -> str | None:
    return next(p.integral for p in PROBLEMS if p.name == problem)


def main() -> None:
    """Run, print, draw, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--steps", type=int, default=None)
    parser.add_argument("--json", type=Path, default=None)
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results")
    options = parser.parse_args()
    steps = (2_000 if options.quick else 100_000) if options.steps is None else options.steps
    found = {problem.name: runs(problem, steps) for problem in (QUICK if options.quick else PROBLEMS)}
    options.out.mkdir(parents=True, exist_ok=True)
    draw(found, options.out / "long_runs.png")
    (options.out / "long_runs.md").write_text(table([row for rows in found.values() for row, _ in rows]), encoding="utf-8")
    versions = {name: version(name) for name in ("jax", "diffrax")}
    document = {"versions": versions, "steps": steps, "runs": [asdict(row) for rows in found.values() for row, _ in rows]}
    path = options.out / "long_runs.json" if options.json is None else options.json
    path.write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
