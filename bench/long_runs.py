"""Long runs of nonholonomic scenes: energy and integrals against time, for each structure-preserving solver
and for Tsit5 and Dopri8 at equal cost.

    python bench/long_runs.py [--quick] [--json FILE] [--out bench/results]

Every structure-preserving method takes the same number of steps of one length. Tsit5 and Dopri8 get the
tightest tolerance (of 1e-3, ..., 1e-13) with which they need no more processor time than the implicit
midpoint rule. Writes a list of {"figure", "model", "value", "required", "met"} and a table (`long_runs.md`),
and draws `long_runs.png`: the largest error so far against time. `--quick`: 2,000 steps and fewer methods,
under two minutes.
"""

from dataclasses import dataclass, replace
from functools import partial

import diffrax
import jax.numpy as jnp
import numpy as np
from figures import HERE, figure, main, markdown, seconds_of
from long_runs_scenes import ChaoticOscillator, ContactOscillator, GaugeTwin, Transmission

import jourdain_jax as jj

METHODS = {
    "implicit midpoint": jj.ImplicitMidpoint,
    "DLA, midpoint": jj.DiscreteLagrangeDAlembert,
    "DLA, trapezoidal": partial(jj.DiscreteLagrangeDAlembert, "trapezoidal"),
    "discrete gradient": jj.DiscreteGradient,
}
EXPLICIT = {"Tsit5": diffrax.Tsit5(), "Dopri8": diffrax.Dopri8()}
COLOURS = ("#0072b2", "#d55e00", "#e69f00", "#009e73", "#999999", "#000000")
COLOURS = dict(zip((*METHODS, *EXPLICIT), COLOURS, strict=True))
ERRORS = ("energy", "integral")
DLA = ("DLA, midpoint", "DLA, trapezoidal")
SAVED = 1000  # times, besides the start
TOLERANCES = [10.0**-k for k in range(3, 14)]


@dataclass(frozen=True, eq=False)
class Problem:
    """A scene, a step (s), its integral besides the energy, and which structure-preserving methods are
    run.
    """

    name: str
    scene: jj.Scene
    step: float
    integral: str | None
    methods: tuple[str, ...] = tuple(METHODS)
    explicit: tuple[str, ...] = tuple(EXPLICIT)


PROBLEMS = (
    Problem("contact oscillator", ContactOscillator(), 0.2, "driver"),
    # for the others it is the contact oscillator
    Problem("its gauge twin", GaugeTwin(), 0.2, "driver", DLA, ()),
    Problem("transmission", Transmission(), 0.2, "driver"),
    Problem("Chaplygin sleigh", jj.models.ChaplyginSleigh(), 0.1, "heading and slide"),
    Problem("chaotic oscillator", ChaoticOscillator(), 0.2, None),
)
QUICK = (
    PROBLEMS[0],
    replace(PROBLEMS[1], methods=DLA[:1]),
    replace(PROBLEMS[2], methods=("implicit midpoint", "discrete gradient"), explicit=("Dopri8",)),
)


@dataclass(frozen=True)
class Run:
    """Errors of one run against time, of the energy (relative) and of the integral (absolute), with the
    largest over all, the first and the last tenth.
    """

    method: str
    how: str  # step or tolerance
    motion: jj.Trajectory
    errors: dict
    seconds: float  # of processor time

    @property
    def ended(self):
        """Where it failed, how it ended."""
        return "" if self.motion.message == "reached the end of its span" else f"; {self.motion.message}"

    def extremes(self, of):
        """The largest error over all, the first tenth and the last tenth of a run."""
        error = self.errors[of]
        tenth = len(error) // 10
        return float(error.max()), float(error[: tenth + 1].max()), float(error[-tenth:].max())


def timed(run):
    """A motion and the processor time it took, without compilation: the less of two runs."""
    run()
    (motion, first), (_, second) = seconds_of(run), seconds_of(run)
    return motion, min(first, second)


def errors(values):
    """Change since the start."""
    values = np.asarray(values)
    return np.abs(values - values[0])


def tolerance_for(run, seconds):
    """The tightest tolerance that costs no more than `seconds`; the loosest where none does."""
    for tolerance in reversed(TOLERANCES):
        if timed(partial(run, tolerance))[1] <= seconds:
            return tolerance
    return TOLERANCES[0]


def outcome(problem, method, how, call) -> Run:
    """A run, timed, and its errors."""
    motion, seconds = timed(call)
    balance = np.asarray(motion.energies().balance)
    found = {"energy": errors(balance) / abs(balance[0])}
    found |= {"integral": errors(_integral_of(motion, problem.integral))} if problem.integral else {}
    return Run(method, how, motion, found, seconds)


def _integral_of(motion: jj.Trajectory, name):
    """The integral against time; that of the sleigh in a form that has no jump where its turn rate has died
    away to round-off of either sign.
    """
    if not isinstance(motion.scene, jj.models.ChaplyginSleigh):
        return np.asarray(motion.invariants()[name])
    sleigh, heading = motion.scene, np.asarray(motion["heading"])
    k = np.sqrt(float(sleigh.inertia / sleigh.mass + sleigh.offset**2))
    forward = np.asarray(motion["x_rate"]) * np.cos(heading) + np.asarray(motion["y_rate"]) * np.sin(heading)
    return float(sleigh.offset) * heading - k * np.arctan2(forward, k * np.asarray(motion["heading_rate"]))


def runs(problem, steps):
    """All runs of a problem."""
    scene, span, allowed = problem.scene, problem.step * steps, 0.0
    start = jj.start(scene, **scene.example)

    def with_tolerance(solver, ts, tolerance):
        how = {"rtol": jnp.asarray(tolerance), "atol": jnp.asarray(tolerance), "max_steps": 100 * steps}
        return jj.simulate(scene, start, ts=ts, solver=solver, **how)

    ts = jnp.linspace(0.0, span, min(SAVED, steps // 20) + 1)
    for name in problem.methods:
        solver = METHODS[name](step=problem.step)
        call = partial(jj.simulate, scene, start, ts=ts, solver=solver, max_steps=2 * steps)
        found = outcome(problem, name, f"h = {problem.step:g} s", call)
        allowed = allowed or found.seconds / 20  # of the implicit midpoint rule, which comes first
        yield found
    for name in problem.explicit:
        # one saved time only: the steps between saved times are to be the method's own
        run = partial(with_tolerance, EXPLICIT[name])
        tolerance = tolerance_for(partial(run, jnp.array([span / 20])), allowed)
        yield outcome(problem, name, f"{tolerance:.0e}", partial(run, ts, tolerance))


def table(found):
    """The table of the documentation, in Markdown."""
    head = ("scene", "solver", "h or tolerance", "s", "energy, relative", "integral")
    rows, shown = [], "{:.0e} ({:.0e}, {:.0e})"
    for problem, each in found.items():
        for run in each:
            energy, integral = (shown.format(*run.extremes(of)) if of in run.errors else "" for of in ERRORS)
            how = (problem.name, run.method, run.how, f"{run.seconds:.2g}")
            rows.append((*how, energy + run.ended, integral))
    return "\n".join(markdown(head, rows)) + "\n"


def draw(found, path):
    """Largest error so far against time: a row per problem, energy and integral side by side."""
    import matplotlib.pyplot as plt

    looks = {}
    for name, colour in COLOURS.items():
        explicit = name in EXPLICIT
        label = name + ", at most the cost of midpoint" * explicit
        looks[name] = {"color": colour, "ls": "--" if explicit else "-", "lw": 1.6, "label": label}
    size = (10, 2.5 * len(found) + 0.7)
    figure, axes = plt.subplots(len(found), 2, figsize=size, squeeze=False, layout="constrained")
    for (problem, each), pair in zip(found.items(), axes, strict=True):
        for axis, of in zip(pair, ERRORS, strict=True):
            for run in each:
                if of in run.errors:
                    worst = np.maximum(np.maximum.accumulate(run.errors[of][1:]), 1e-17)
                    axis.loglog(run.motion.ts[1:], worst, **looks[run.method])
            axis.grid(alpha=0.3)
            axis.set(xlabel="t (s)", ylim=(1e-17, 10), ylabel="error")
        pair[0].set_ylabel(f"{problem.name}\nrelative error")
        pair[0].set_title("energy", fontsize=10)
        pair[1].set_title(f"integral: {problem.integral}", fontsize=10)
        if problem.integral is None:
            pair[1].set_axis_off()
    handles = [plt.Line2D([], [], **look) for look in looks.values()]
    figure.legend(handles=handles, loc="outside upper center", ncol=3, frameon=False)
    figure.savefig(path, dpi=130)


def long_runs(quick, out):
    """Errors and seconds of every run; the table and the picture."""
    found = {}
    for problem in QUICK if quick else PROBLEMS:
        found[problem] = []
        for run in runs(problem, 2_000 if quick else 100_000):
            found[problem].append(run)
            how = f"{run.method}, {run.how}{run.ended}"
            for of in run.errors:
                for where, error in zip(("", ", first tenth", ", last tenth"), run.extremes(of), strict=True):
                    yield figure(f"largest error of {of}{where}, {how}", problem.name, error)
            yield figure(f"seconds, {how}", problem.name, run.seconds)
            yield figure(f"steps, {how}", problem.name, int(run.motion.accepted))
    (out / "long_runs.md").write_text(table(found), encoding="utf-8")
    draw(found, out / "long_runs.png")


if __name__ == "__main__":
    main(__doc__, (long_runs,), out=HERE / "results")
