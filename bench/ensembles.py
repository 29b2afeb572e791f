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
from collections.abc import Callable
from pathlib import Path

import dask
import numpy as np
from distributed import Client, LocalCluster
from figures import HERE, Figures, figure, main

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


def run(lanes: int, path, memory=None, **options) -> StudyResult:
    """A study of so many discs with random starts in a folder."""
    start = {
        "lean": Uniform(-0.6, 0.6),
        "yaw_rate": Normal(0.0, 0.5),
        "lean_rate": Normal(0.0, 0.3),
        "spin_rate": Uniform(-9.0, 0.0),
    }
    study = jj.Study(jj.build(jj.models.TiltingDisc(), memory=memory), start=start, samples=lanes, seed=1)
    return study.run(
        path, t1=SPAN, rtol=TOLERANCE, atol=TOLERANCE, outputs=OUTPUTS, progress=False, **options
    )


def timed(lanes: int, folder: Path, **options) -> dict:
    """Seconds of a run after one that compiled its program: by the clock, of the processor, of the processor
    within writing.
    """
    if (
        options.get("processes", 1) == 1 and "memory" not in options
    ):  # a bound counts compilers once more in a process that has compiled
        run(4096, folder / "warm", **options)
    within, write = [0.0], Store.write

    def watched(self, *what):
        began = time.thread_time()  # threads of XLA that wait for work are not writing
        write(self, *what)
        within[0] += time.thread_time() - began

    Store.write = watched
    clock, processor = time.perf_counter(), time.process_time()
    run(lanes, folder / "timed", **options)
    found = {
        "wall": time.perf_counter() - clock,
        "processor": time.process_time() - processor,
        "writing": within[0],
    }
    return found | {"peak": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024}


def logged(lanes: int, folder: Path, log: Path) -> StudyResult:
    """A study that writes a byte for every block that it begins to compute."""
    before = Runner.run_block

    def run_block(*what):
        with open(log, "ab") as file:
            file.write(b".")
        return before(*what)

    Runner.run_block = run_block
    return run(lanes, folder / "timed")


CALL = """
import ensembles, json, pathlib, sys
told = json.loads(sys.argv[2])
folder = pathlib.Path(told.pop("folder"))
print(json.dumps(getattr(ensembles, sys.argv[1])(folder=folder, **told), default=str))
"""


def call(name: str, lanes: int, folder: Path, **options) -> list[str]:
    """The command that calls a function of this file in a process of its own."""
    return [sys.executable, "-c", CALL, name, json.dumps({"lanes": lanes, "folder": str(folder), **options})]


def in_fresh_process(lanes: int, folder: Path, on_one_core: bool = False, **options) -> dict:
    """`timed` in a process of its own, on all cores or on one."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    cores = os.sched_getaffinity(0)
    begin = lambda: os.sched_setaffinity(0, {min(cores)} if on_one_core else cores)
    environment = os.environ | ({"JOURDAIN_JAX_THREADS": "1"} if on_one_core else {})
    done = subprocess.run(
        call("timed", lanes, folder, **options),
        cwd=HERE,
        env=environment,
        check=True,
        stdout=subprocess.PIPE,
        text=True,
        preexec_fn=begin,
    )
    return json.loads(done.stdout.splitlines()[-1])


def rate(lanes: int, folder: Path) -> Figures:
    """Rate and storage."""
    found = min((in_fresh_process(lanes, folder / "rate") for _ in range(3)), key=lambda found: found["wall"])
    cores = len(os.sched_getaffinity(0))
    yield figure(
        f"discs per second of wall time, {cores} cores, storage included",
        MODEL,
        lanes / found["wall"],
        least=25_000,
    )
    yield figure("discs per second of processor time, storage included", MODEL, lanes / found["processor"])
    yield figure(
        "share of processor time spent on storage", MODEL, found["writing"] / found["processor"], 0.05
    )


def busy(lanes: int, folder: Path) -> Figures:
    """Busy share, from the steps of every lane."""
    result = run(min(lanes, 20_000), folder / "busy")
    arrays = result.to_xarray()
    steps, block = (arrays["steps"] + arrays["rejected_steps"]).values, result.store.study["block"]
    there = plain = 0
    for first in range(0, len(steps), block):
        ends = [0] * WIDTH
        for count in steps[first : first + block].tolist():
            heapq.heapreplace(ends, ends[0] + count)
        there += WIDTH * max(ends)
        plain += len(steps[first : first + block]) * steps[first : first + block].max()
    yield figure(
        "busy share of lanes, by their steps, ended lanes replaced", MODEL, steps.sum() / there, least=0.9
    )
    yield figure("busy share of lanes, by their steps, all waiting for the last", MODEL, steps.sum() / plain)


def memory(lanes: int, folder: Path) -> Figures:
    """Resident memory."""
    few, many = (in_fresh_process(count, folder / "memory")["peak"] for count in (lanes, 10 * lanes))
    yield figure(f"growth of resident memory from {lanes} to {10 * lanes} lanes, MB", MODEL, many - few, 300)
    ts = np.linspace(0.0, SPAN, 201).tolist()
    peak = in_fresh_process(lanes, folder / "memory", keep_every=1, ts=ts, memory="1000MB")["peak"] * 1.048576
    yield figure(
        "largest resident memory, MB, of a study that keeps trajectories under memory='1000MB'",
        MODEL,
        peak,
        1000,
    )


def processes(lanes: int, folder: Path) -> Figures:
    """Two processes, each on a core, over one on one core: minutes, since the start and compilation of the
    two, some eight seconds, are included.
    """
    one = in_fresh_process(200 * lanes, folder / "processes", on_one_core=True)["wall"]
    two = in_fresh_process(200 * lanes, folder / "processes", processes=2)["wall"]
    print(f"  one process {one:.1f} s, two {two:.1f} s", flush=True)
    yield figure(
        "wall time by one process on one core over that by two processes on two", MODEL, one / two, least=1.8
    )
    dask.config.set(
        {"distributed.nanny.pre-spawn-environ": {"OMP_NUM_THREADS": 1}}
    )  # as docs/ensembles.md advises: no early return of memory
    with (
        LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster,
        Client(cluster) as client,
    ):
        began = time.perf_counter()
        run(200 * lanes, folder / "dask", client=client)
        by_cluster = time.perf_counter() - began
    print(f"  two workers of Dask {by_cluster:.1f} s", flush=True)
    yield figure(
        "wall time by one process on one core over that by two workers of Dask",
        MODEL,
        one / by_cluster,
        least=1.7,
    )


def bits(lanes: int, folder: Path) -> Figures:
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
        pairs += [
            (getattr(plain.statistics, name), getattr(other.statistics, name))
            for name in ("mean", "covariance", "counts", "extremes")
        ]
        yield figure(
            f"arrays that differ: {way}",
            MODEL,
            sum(not np.array_equal(*pair, equal_nan=True) for pair in pairs),
            0,
        )


def kills(lanes: int, folder: Path) -> Figures:
    """Twenty kills."""
    generator, path = np.random.default_rng(0), folder / "kills"
    lanes *= 100
    log = folder / "blocks"
    log.write_bytes(b"")
    for _ in range(20):
        process = subprocess.Popen(call("logged", lanes, path, log=str(log)), cwd=HERE)
        before = len(list(path.glob("timed/run/chunks/[0-9]*")))
        while process.poll() is None and len(list(path.glob("timed/run/chunks/[0-9]*"))) <= before:
            time.sleep(1e-3)
        time.sleep(generator.uniform(0.0, 2.0))
        process.send_signal(signal.SIGKILL)
        process.wait()
    result = logged(lanes, path, log)
    again = len(log.read_bytes()) * result.store.study["block"] / lanes - 1.0
    yield figure(
        "lanes computed again after 20 kills, of all", MODEL, again, 0.02 if lanes >= 10_000_000 else None
    )
    yield figure(
        "lanes missing or repeated after 20 kills", MODEL, len(result) - sum(result.counts.values()), 0
    )


def indices(lanes: int, folder: Path) -> Figures:
    """Ishigami's function; its indices in closed form."""
    a, b = 7.0, 0.1
    design = Design(
        dict.fromkeys(("x1", "x2", "x3"), Uniform(-np.pi, np.pi)),
        sampler="saltelli",
        samples=5 * 2**14,
        seed=1,
    )
    x = design.values()
    found = sobol_indices(
        np.sin(x["x1"]) + a * np.sin(x["x2"]) ** 2 + b * x["x3"] ** 4 * np.sin(x["x1"]), design.names
    )
    one, two, three = 0.5 * (1 + b * np.pi**4 / 5) ** 2, a**2 / 8, b**2 * np.pi**8 * (1 / 18 - 1 / 50)
    first, total = (
        np.array([one, two, 0.0]) / (one + two + three),
        np.array([one + three, two, three]) / (one + two + three),
    )
    errors = [
        abs(found.first - first) / found.first_half_width,
        abs(found.total - total) / found.total_half_width,
    ]
    yield figure(
        "largest error of a Sobol' index over its stated limit",
        "Ishigami's function",
        float(np.max(errors)),
        1.0,
    )


def _in_folder(measure) -> Callable[[bool], Figures]:
    def part(quick: bool) -> Figures:
        with tempfile.TemporaryDirectory() as folder:
            yield from measure(10_000 if quick else 100_000, Path(folder))

    return part


if __name__ == "__main__":
    main(
        __doc__,
        {
            measure.__name__: _in_folder(measure)
            for measure in (rate, busy, memory, processes, bits, kills, indices)
        },
    )
