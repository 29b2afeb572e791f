"""Studies of many motions: how many per second, what storage and interruption cost, memory, and whether bits
depend on how a study is run.

    python bench/ensembles.py [--quick] [--json FILE] [--only NAME ...]

The motions: two seconds of a rolling disc with random lean, yaw, lean and spin rates, some of which fall, at
a tolerance of 1e-6; end values, result codes and steps are stored. Every measurement runs in a fresh process,
and a program is compiled before the clock starts.

    rate        discs per second, storage included: of wall time, and of processor time where other programs
                share the machine
    storage     share of processor time for the writing of chunks
    busy        steps of all lanes over steps of the lanes of a vector, with and without replacement of lanes
                that end
    memory      growth of the largest resident memory from fewer to more lanes; and the largest under a stated
                bound
    processes   wall time of one process on one core over that of two processes on two, and over that of two
                workers of a Dask cluster on this machine
    bits        arrays and statistics that differ from a plain run: with other chunks, by two processes,
                interrupted
    kills       share of lanes computed again, and missing or repeated lanes, of a long run that is killed 20
                times at random
    indices     largest error of Sobol' indices of Ishigami's function over their stated limits

The JSON is a list of {"figure", "model", "value", "required", "met"}. `--quick`: a tenth of the lanes.
"""

import heapq
import json
import os
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import dask
import numpy as np
from distributed import Client, LocalCluster
from figures import HERE, figure, fresh, main

import jourdain_jax as jj
from jourdain_jax.studies import Design, End, EventTime, Happened, Normal, StudyResult, Uniform, sobol_indices
from jourdain_jax.studies.run import Runner
from jourdain_jax.studies.store import Store

MODEL, SPAN, TOLERANCE = "tilting-disc", 2.0, 1e-6
WIDTH = 8  # lanes of a vector
OUTPUTS = {
    "final lean": End("lean", "rad"),
    "final yaw": End("yaw", "rad"),
    "fell": Happened("fallen"),
    "fall time": EventTime("fallen"),
}


def run(lanes, path, memory=None, **options) -> StudyResult:
    """A study of so many discs with random starts in a folder."""
    start = {"lean": Uniform(-0.6, 0.6), "yaw_rate": Normal(0.0, 0.5)}
    start |= {"lean_rate": Normal(0.0, 0.3), "spin_rate": Uniform(-9.0, 0.0)}
    study = jj.Study(jj.build(jj.models.TiltingDisc(), memory=memory), start=start, samples=lanes, seed=1)
    options |= {"t1": SPAN, "rtol": TOLERANCE, "atol": TOLERANCE, "outputs": OUTPUTS}
    return study.run(path, progress=False, **options)


def timed(lanes, folder, **options):
    """Seconds of a run after one that compiled its program: by the clock, of the processor, of the processor
    within writing.
    """
    # a bound counts compilers once more in a process that has compiled
    if options.get("processes", 1) == 1 and "memory" not in options:
        run(4096, folder / "warm", **options)
    within, write = [0.0], Store.write

    def watched(self, *what):
        began = time.thread_time()  # threads of XLA that wait for work are not writing
        write(self, *what)
        within[0] += time.thread_time() - began

    Store.write = watched
    clock, processor = time.perf_counter(), time.process_time()
    run(lanes, folder / "timed", **options)
    seconds = {"wall": time.perf_counter() - clock, "processor": time.process_time() - processor}
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    return seconds | {"writing": within[0], "peak": peak}


def logged(lanes, folder, log) -> StudyResult:
    """A study that writes a byte for every block that it begins to compute."""
    before = Runner.run_block

    def run_block(*what):
        with open(log, "ab") as file:
            file.write(b".")
        return before(*what)

    Runner.run_block = run_block
    return run(lanes, folder / "timed")


# for a process of its own, on so many cores
CALL = """
import json, os, pathlib, sys
told = json.loads(sys.argv[1])
os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[: told.pop("cores", None)])
import ensembles
call, folder = getattr(ensembles, told.pop("name")), pathlib.Path(told.pop("folder"))
print(json.dumps(call(folder=folder, **told), default=str))
"""


def in_fresh_process(lanes, folder, on_one_core=False, **options):
    """`timed` in a process of its own, on all cores or on one."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    told = {"name": "timed", "lanes": lanes, "folder": str(folder), **options}
    if on_one_core:
        return fresh(CALL, json.dumps(told | {"cores": 1}), JOURDAIN_JAX_THREADS="1")
    return fresh(CALL, json.dumps(told))


def rate(lanes, folder):
    """Rate and storage."""
    found = min((in_fresh_process(lanes, folder / "rate") for _ in range(3)), key=lambda found: found["wall"])
    wall, processor, cores = found["wall"], found["processor"], len(os.sched_getaffinity(0))
    what = f"discs per second of wall time, {cores} cores, storage included"
    yield figure(what, MODEL, lanes / wall, least=25_000)
    yield figure("discs per second of processor time, storage included", MODEL, lanes / processor)
    yield figure("share of processor time spent on storage", MODEL, found["writing"] / processor, 0.05)


def busy(lanes, folder):
    """Busy share, from the steps of every lane."""
    result = run(min(lanes, 20_000), folder / "busy")
    arrays = result.to_xarray()
    steps, block = (arrays["steps"] + arrays["rejected_steps"]).values, result.store.study["block"]
    there = plain = 0
    for first in range(0, len(steps), block):
        own, ends = steps[first : first + block], [0] * WIDTH
        for count in own.tolist():
            heapq.heapreplace(ends, ends[0] + count)
        there += WIDTH * max(ends)
        plain += len(own) * own.max()
    what = "busy share of lanes, by their steps,"
    yield figure(f"{what} ended lanes replaced", MODEL, steps.sum() / there, least=0.9)
    yield figure(f"{what} all waiting for the last", MODEL, steps.sum() / plain)


def memory(lanes, folder):
    """Resident memory."""
    few, many = (in_fresh_process(count, folder / "memory")["peak"] for count in (lanes, 10 * lanes))
    yield figure(f"growth of resident memory from {lanes} to {10 * lanes} lanes, MB", MODEL, many - few, 300)
    ts = np.linspace(0.0, SPAN, 201).tolist()
    found = in_fresh_process(lanes, folder / "memory", keep_every=1, ts=ts, memory="1000MB")
    what = "largest resident memory, MB, of a study that keeps trajectories under memory='1000MB'"
    yield figure(what, MODEL, found["peak"] * 1.048576, 1000)


def processes(lanes, folder):
    """Two processes, each on a core, over one on one core: minutes, since the start and compilation of the
    two, some eight seconds, are included.
    """
    one = in_fresh_process(200 * lanes, folder / "processes", on_one_core=True)["wall"]
    two = in_fresh_process(200 * lanes, folder / "processes", processes=2)["wall"]
    print(f"  one process {one:.1f} s, two {two:.1f} s", flush=True)
    what = "wall time by one process on one core over that by two"
    yield figure(f"{what} processes on two", MODEL, one / two, least=1.8)
    # as docs/ensembles.md advises: no early return of memory
    dask.config.set({"distributed.nanny.pre-spawn-environ": {"OMP_NUM_THREADS": 1}})
    workers = LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None)
    with workers, Client(workers) as client:
        began = time.perf_counter()
        run(200 * lanes, folder / "dask", client=client)
        by_cluster = time.perf_counter() - began
    print(f"  two workers of Dask {by_cluster:.1f} s", flush=True)
    yield figure(f"{what} workers of Dask", MODEL, one / by_cluster, least=1.7)


def bits(lanes, folder):
    """Arrays that differ."""
    lanes = min(lanes, 20_000)
    plain = run(lanes, folder / "bits" / "plain")
    ways = {
        "chunks of 8192": {"chunk": 8192},
        "one chunk": {"chunk": 2048 * -(-lanes // 2048)},
        "two processes": {"processes": 2},
    }
    others = {way: run(lanes, folder / "bits" / way, **options) for way, options in ways.items()}
    run(lanes, folder / "bits" / "in two parts", shard=(2, 2))
    others["the second half first"] = run(lanes, folder / "bits" / "in two parts")
    for way, other in others.items():
        one, two = plain.to_xarray().load(), other.to_xarray().load()
        pairs = [(one[name].values, two[name].values) for name in one.variables]
        for name in ("mean", "covariance", "counts", "extremes"):
            pairs.append((getattr(plain.statistics, name), getattr(other.statistics, name)))
        differ = sum(not np.array_equal(*pair, equal_nan=True) for pair in pairs)
        yield figure(f"arrays that differ: {way}", MODEL, differ, 0)


def kills(lanes, folder):
    """Twenty kills."""
    generator, path = np.random.default_rng(0), folder / "kills"
    lanes *= 100
    log = folder / "blocks"
    log.write_bytes(b"")
    told = json.dumps({"name": "logged", "lanes": lanes, "folder": str(path), "log": str(log)})
    for _ in range(20):
        process = subprocess.Popen([sys.executable, "-c", CALL, told], cwd=HERE)
        before = len(list(path.glob("timed/run/chunks/[0-9]*")))
        while process.poll() is None and len(list(path.glob("timed/run/chunks/[0-9]*"))) <= before:
            time.sleep(1e-3)
        time.sleep(generator.uniform(0.0, 2.0))
        process.send_signal(signal.SIGKILL)
        process.wait()
    result = logged(lanes, path, log)
    again = len(log.read_bytes()) * result.store.study["block"] / lanes - 1.0
    most, lost = 0.02 if lanes >= 10_000_000 else None, len(result) - sum(result.counts.values())
    yield figure("lanes computed again after 20 kills, of all", MODEL, again, most)
    yield figure("lanes missing or repeated after 20 kills", MODEL, lost, 0)


def indices(lanes, folder):
    """Ishigami's function; its indices in closed form."""
    a, b = 7.0, 0.1
    ranges = dict.fromkeys(("x1", "x2", "x3"), Uniform(-np.pi, np.pi))
    design = Design(ranges, sampler="saltelli", samples=5 * 2**14, seed=1)
    x = design.values()
    value = np.sin(x["x1"]) * (1 + b * x["x3"] ** 4) + a * np.sin(x["x2"]) ** 2
    found = sobol_indices(value, design.names)
    one, two, three = 0.5 * (1 + b * np.pi**4 / 5) ** 2, a**2 / 8, b**2 * np.pi**8 * (1 / 18 - 1 / 50)
    first, total = np.array([[one, two, 0.0], [one + three, two, three]]) / (one + two + three)
    off = abs(found.first - first) / found.first_half_width, abs(found.total - total) / found.total_half_width
    what = "largest error of a Sobol' index over its stated limit"
    yield figure(what, "Ishigami's function", np.max(off), 1.0)


def _in_folder(measure):
    def part(quick):
        with tempfile.TemporaryDirectory() as folder:
            yield from measure(10_000 if quick else 100_000, Path(folder))

    return part


if __name__ == "__main__":
    parts = (rate, busy, memory, processes, bits, kills, indices)
    main(__doc__, {part.__name__: _in_folder(part) for part in parts})
