"""Identification of a steer-by-wire bicycle from 57 runs, whose data are in `notebooks/data`: parts `windows`
and `logs` of `identification.py`.
"""

import contextlib
import csv
import gzip
import resource
import runpy
import time

import matplotlib as mpl
import numpy as np
from figures import HERE, figure, fresh, seconds_of

import jourdain_jax as jj
from jourdain_jax.identification import Fit, unbounded
from jourdain_jax.models import WhippleBicycle

NOTEBOOKS = HERE.parent / "notebooks"
MODEL = "steer-by-wire bicycle"


class SteerByWire(WhippleBicycle):
    """A Whipple bicycle whose steer motor gives `gain` times what is commanded, with damping of steer and
    lean.
    """

    steer_damping: object = jj.parameter(0.3, non_negative=True)
    lean_damping: object = jj.parameter(1.0, non_negative=True)
    gain: object = jj.parameter(1.0)

    def loads(self, motion):
        lean = motion.inputs.lean_torque - self.lean_damping * motion.u.lean_rate
        steer = self.gain * motion.inputs.steer_torque - self.steer_damping * motion.u.steer_rate
        return jj.gravity(motion, self.g), jj.generalized_force(motion, lean_rate=lean, steer_rate=steer)


# nominal parameters of the authors' models; the front frame turns the motor with it, whose inertia is a first
# guess
NOMINAL = {
    "w": 1.036, "c": 0.0803, "lam": float(np.deg2rad(18.2)), "rR": 0.3498, "mR": 10.12, "IRxx": 0.1040,
    "IRyy": 0.1641, "xB": 0.462, "zB": -0.698, "mB": 20.9,
    "IBxx": 1.64, "IByy": 2.0, "IBzz": 1.94, "IBxz": 0.654, "xH": 0.944, "zH": -0.595, "mH": 0.6, "IHxx": 0.1,
    "IHyy": 0.1, "IHzz": 0.1, "IHxz": -0.00044,
    "rF": 0.3498, "mF": 1.780, "IFxx": 0.0644, "IFyy": 0.1289,
}  # fmt: skip
FREE = dict.fromkeys(("gain", "steer_damping", "lean_damping", "IBxz", "zB", "c")) | {
    "IBxx": jj.bounds(0.2, 8.0),
    "IBzz": jj.bounds(0.2, 8.0),
    "IHzz": jj.bounds(0.001, 1.0),
}


SIGMA = {"lean_rate": 0.03, "steer_rate": 0.1}  # rad/s
# of the start: the column of the data, and the scale of its uncertainty
UNKNOWN = {"lean": ("lean_angle", 0.1), "lean_rate": ("lean_rate", 0.3)}
UNKNOWN |= {"steer": ("fork_angle", 0.1), "steer_rate": ("fork_rate", 0.5)}


def experiments() -> list[jj.Experiment]:
    """The 57 windows: lean rate and steer rate, the command as input, and an unknown start each."""
    with gzip.open(NOTEBOOKS / "data" / "steer_by_wire" / "windows.csv.gz", "rt") as file:
        rows = list(csv.DictReader(file))
    runs, ts = [], 0.01 * np.arange(100)
    for k in range(0, len(rows), 100):
        column = {name: np.array([float(row[name]) for row in rows[k : k + 100]]) for name in rows[0]}
        start = {name: column[source][0] for name, (source, _) in UNKNOWN.items()}
        start["rear_spin_rate"] = column["speed"].mean() / NOMINAL["rR"]
        values = {"lean_rate": column["lean_rate"], "steer_rate": column["fork_rate"]}
        how = {"unknown_start": {name: unbounded(scale) for name, (_, scale) in UNKNOWN.items()}}
        how["inputs"] = {"steer_torque": jj.Sampled(ts, column["command_fork"])}
        runs.append(jj.Experiment(ts, values, SIGMA, start=start, **how))
    return runs


def fitted(runs: list[jj.Experiment], **options) -> Fit:
    """A fit of some runs."""
    return jj.fit(SteerByWire(**NOMINAL), runs, FREE, rtol=1e-6, atol=1e-6, **options)


def time_of_a_step(count):
    """Processor time of a warm fit of the first runs for each step that it tries, s; fits of other runs try
    other numbers of steps.
    """
    runs = experiments()[:count]
    for _ in range(2):  # the first one compiles
        found, seconds = seconds_of(lambda: fitted(runs, max_iterations=20))
    return seconds / int(found.steps)


def told():
    """The numbers of `windows`, for a process of its own; 3 s to import all are counted in."""
    runs = experiments()
    found, cold = seconds_of(lambda: fitted(runs), time.perf_counter)
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    again, warm = seconds_of(lambda: fitted(runs), time.perf_counter)
    for line in str(found).split("\n"):
        if "run " not in line and not line.strip()[:2].isdigit():
            print(line)
    ratio = time_of_a_step(32) / time_of_a_step(8)
    told = {"cold": cold + 3.0, "warm": warm, "memory": memory, "ratio": ratio}
    return told | {"steps": int(found.steps), "converged": float(again.converged)}


def windows(quick):
    """57 runs with 9 + 228 unknowns, in a fresh process."""
    found = fresh("import identification_logs, json; print(json.dumps(identification_logs.told()))")
    yield figure("57 windows, cold, s", MODEL, found["cold"], 60)
    yield figure("57 windows, warm, s", MODEL, found["warm"], 40)
    yield figure("57 windows, memory, GiB", MODEL, found["memory"], 3)
    yield figure("57 windows, converged", MODEL, found["converged"], least=1)
    yield figure("57 windows, steps", MODEL, found["steps"])
    yield figure("a step at 32 runs over one at 8", MODEL, found["ratio"], 4.5)


def logs(quick):
    """Odd and even windows, each half by itself, as the notebook on them has it: how far apart, how well each
    predicts the other, whether bodies can be.
    """
    mpl.use("agg")
    with contextlib.chdir(NOTEBOOKS):
        begin = time.process_time()
        told = runpy.run_path("06_steer_by_wire.py")
    halves, rms, out = told["halves"].values(), told["rms"], told["out"].values()
    for rate, most in (("lean", 0.027), ("steer", None)):
        worst = max(rms(left[f"{rate}_rate"]) for left in out)
        yield figure(f"{rate}-rate rms on held-out windows, rad/s", MODEL, worst, most)
    yield figure("lean-rate rms by the authors' numbers, rad/s", MODEL, rms(told["plain"]["lean_rate"]))
    impossible = sum(len(half.impossible) for half in halves)
    yield figure("bodies that cannot be, of both halves", MODEL, impossible, 0)
    what = "halves differ by, standard errors (from how runs differ)"
    yield figure(what, MODEL, max(told["apart"].values()), 3)
    for rate in ("lean", "steer"):
        correlation = max(told["neighbours"](left[f"{rate}_rate"]) for left in out)
        yield figure(f"correlation of neighbouring residuals of {rate} rate", MODEL, correlation)
    yield figure("halves converged, of two", MODEL, sum(bool(half.converged) for half in halves), least=2)
    yield figure("steps, the most of both", MODEL, max(int(half.steps) for half in halves), 50)
    what = "frequency of weave from 3 m/s on, off that of damped exponentials, rad/s"
    ours, theirs = told["from_3"][:, :2].T
    yield figure(what, MODEL, ours.max())
    yield figure("the same by the authors' numbers, the least", MODEL, theirs.min())
    yield figure("processor time of the notebook, s", MODEL, time.process_time() - begin)
