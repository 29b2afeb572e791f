"""Kernels of NVIDIA GPUs: what they return is that of the CPU's machine code to the last bit, and how many motions a second they make.

    python bench/gpu.py [--quick] [--json FILE] [--seconds 240]

Needs a checkout, llvmlite and, for figures, JAX with CUDA. Without a GPU it runs the checks that need none (threads of a GPU one after the other on the CPU;
text for NVIDIA's driver; `ptxas`, where it is installed), writes those rows alone and returns 0. Each check prints a line. Whatever is not done after so many
seconds is named in a last row, and the process ends.

Bits: programs run on the CPU; every call of machine code in them is made once more on the GPU, with the same numbers. Figures: starts are made on the device,
one time is saved, and the end, its code and the counts come back; the best of three calls. `--json` writes a list of {"figure", "model", "value", "required",
"met"}.
"""

import argparse
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jax.interpreters import mlir

import jourdain_jax as jj
from jourdain_jax.motion.native import called
from jourdain_jax.native import ffi, host, nvidia

DISC, BICYCLE = jj.models.TiltingDisc(), jj.models.MODELS["whipple-bicycle"]()
NUMBERS = ("mB", "mR", "mF", "mH", "rR", "rF", "w", "c")  # of a bicycle, by which it is differentiated
ARCHITECTURES = ("sm_75", "sm_80", "sm_90", "sm_100")
TIGHT = {"rtol": 1e-8, "atol": 1e-8}


class Rows:
    """What was found; each row is printed at once."""

    def __init__(self, file: Path | None, seconds: float) -> None:
        self.file, self.rows, self.begin = file, [], time.perf_counter()
        timer = threading.Timer(seconds, self._give_up)
        timer.daemon = True
        timer.start()

    def add(self, figure: str, model: str, value, required=None, least: bool = True) -> None:
        """`required`: the least value, or the most."""
        met = required is None or (value is not None and (value >= required if least else value <= required))
        self.rows.append({"figure": figure, "model": model, "value": value, "required": required, "met": bool(met)})
        shown = f"{value:.4g}" if isinstance(value, float) else value
        print(f"[{time.perf_counter() - self.begin:6.1f} s] {figure}, {model}: {shown}" + ("" if met else f", required {required:g}"), flush=True)

    def tried(self, figure: str, model: str, check: Callable[[], None]) -> None:
        """A check whose error is a row."""
        try:
            check()
        except Exception as error:
            text = f"{type(error).__name__}: {(str(error).splitlines() or [''])[0][:200]}"
            self.rows.append({"figure": figure, "model": model, "value": text, "required": None, "met": False})
            print(f"[{time.perf_counter() - self.begin:6.1f} s] {figure}, {model}: {text}", flush=True)

    def write(self) -> None:
        if self.file:
            self.file.write_text(json.dumps(self.rows, indent=1) + "\n", encoding="utf-8")

    def _give_up(self) -> None:
        self.rows.append({"figure": "all checks in time", "model": "", "value": False, "required": None, "met": False})
        self.write()
        print("time is up", flush=True)
        os._exit(0)


def disc(spin_rate, t1=2.0, scene=DISC, **options):
    options = {"rtol": 1e-6, "atol": 1e-6, "work": False} | options
    return jj.simulate(scene, {"lean": 0.3, "spin_rate": spin_rate}, ts=[t1], **options)


def bicycle(lean_rate, scene=BICYCLE):
    return jj.simulate(scene, {**BICYCLE.upright(4.6), "lean_rate": lean_rate}, ts=[2.0], rtol=1e-6, atol=1e-6, work=False)


def ends(run: Callable) -> Callable:
    def of(x):
        found = run(x)
        return found.q_end, found.t_end, found.result

    return of


def size(found):
    return jnp.sum(found.q_end**2)


DISCS = {
    "values": ends(disc),
    "tangent": lambda x: jax.jacfwd(lambda r: disc(x, scene=DISC.replace(radius=r)).q_end)(0.5),
    "gradient": lambda x: jax.grad(lambda scene: size(disc(x, scene=scene)))(DISC),
    "10 s at 1e-8, Dopri8": ends(lambda x: disc(x, 10.0, **TIGHT)),
    "10 s at 1e-8, Taylor": ends(lambda x: disc(x, 10.0, solver=jj.Taylor(), **TIGHT)),
}
BICYCLES = {
    "values": ends(bicycle),
    "tangent": lambda x: jax.jacfwd(lambda m: bicycle(x, BICYCLE.replace(mB=m)).q_end)(BICYCLE.mB),
    "gradient": lambda x: jax.grad(lambda new: size(bicycle(x, BICYCLE.replace(**new))))({name: getattr(BICYCLE, name) for name in NUMBERS}),
}
SPREAD = {"disc": (-6.0, -3.0), "bicycle": (0.1, 0.5)}
REQUIRED = {
    ("disc", "values"): 1.2e8,
    ("disc", "10 s at 1e-8, Dopri8"): 2e7,
    ("disc", "10 s at 1e-8, Taylor"): 3.5e7,
    ("disc", "tangent"): 6e7,
    ("disc", "gradient"): 5e6,
    ("bicycle", "values"): 1.8e6,
    ("bicycle", "tangent"): 1.5e5,
    ("bicycle", "gradient"): 5e4,
}


def calls_of(f: Callable, lanes: int, of: str) -> list[tuple]:
    """Every call of machine code in `f` of so many spread lanes on the CPU, with its arguments and results."""
    calls: list[tuple] = []

    def lowered(ctx, *values, handler, lanes, threads, shapes, kernel):
        results = [jax.ShapeDtypeStruct(x.shape, x.dtype) for x in ctx.avals_out]
        how = {"handler": handler, "lanes": lanes, "threads": threads, "shapes": shapes, "kernel": kernel}

        def call(*values):
            found = jax.ffi.ffi_call(handler(lanes, threads), results)(*values)
            jax.debug.callback(lambda given, found: calls.append((how, [*map(np.asarray, given)], [*map(np.asarray, found)])), values, found)
            return found

        return mlir.lower_fun(call)(ctx, *values)

    jax.clear_caches()
    mlir.register_lowering(called._call_p, lowered, platform="cpu")
    try:
        with jax.default_device(jax.devices("cpu")[0]):
            jax.block_until_ready(jax.jit(jax.vmap(f))(jnp.linspace(*SPREAD[of], lanes)))
            jax.effects_barrier()
    finally:
        mlir.register_lowering(called._call_p, called.on_cpu, platform="cpu")
        jax.clear_caches()
    return calls


def check_bits(rows: Rows, of: str, name: str, f: Callable, lanes: int) -> None:
    """How many numbers that kernels return differ in a bit from those of the CPU."""
    differ = count = 0
    for how, given, expected in calls_of(f, lanes, of):
        found = jax.jit(lambda *x, how=how: called._call_p.bind(*x, **how))(*given)
        for ours, theirs in zip(found, expected, strict=True):
            differ += int(np.sum(np.asarray(ours).view(np.int64) != theirs.view(np.int64)) - np.sum(np.isnan(ours) & np.isnan(theirs)))
            count += theirs.size
    rows.add(f"numbers of {count} that differ in a bit, {name}", f"{lanes} lanes of a {of}", max(differ, 0), 0, least=False)


def check_speed(rows: Rows, of: str, name: str, f: Callable, lanes: int) -> None:
    low, high = SPREAD[of]
    run = jax.jit(lambda: jax.vmap(f)(low + (high - low) * jnp.arange(lanes) / lanes))
    begin = time.perf_counter()
    jax.block_until_ready(run())
    first = time.perf_counter() - begin
    seconds = [_timed(run) for _ in range(3)]
    rows.add(f"motions a second, {name}", f"{lanes:g} lanes of a {of}", lanes / min(seconds), REQUIRED.get((of, name)) if lanes >= 1e5 else None)
    rows.add(f"first call, s, {name}", f"{lanes:g} lanes of a {of}", first)


def _timed(run: Callable, *arguments) -> float:
    begin = time.perf_counter()
    jax.block_until_ready(run(*arguments))
    return time.perf_counter() - begin


def check_alone(rows: Rows, of: str, name: str, f: Callable, x: float, required: float | None, first_within: float | None) -> None:
    run, begin = jax.jit(f), time.perf_counter()
    jax.block_until_ready(run(x))
    rows.add(f"compiled and run, s, {name}", f"one {of}", time.perf_counter() - begin, first_within, least=False)
    rows.add(f"time, ms, {name}", f"one {of}", 1e3 * min(_timed(run, x) for _ in range(20)), required, least=False)


def check_failures(rows: Rows) -> None:
    """A lane that is no number leaves the others alone; what does not fit into memory is an error, after which all goes on."""
    x = jnp.linspace(-6.0, -3.0, 1000)
    run = jax.jit(jax.vmap(DISCS["values"]))
    good, bad = run(x), run(x.at[500].set(jnp.nan))
    others = jnp.arange(1000) != 500
    rows.add("lanes beside a failed one that changed", "1000 discs", int(jnp.sum(jnp.any(good[0] != bad[0], axis=1) & others)), 0, least=False)
    rows.add("code of a lane that is no number", "disc", int(bad[2][500]), 1)
    try:
        jax.block_until_ready(jax.jit(lambda: jax.vmap(DISCS["values"])(jnp.zeros(2_000_000_000)))())
        said = "nothing"
    except Exception as error:
        said = "RESOURCE_EXHAUSTED" if "RESOURCE_EXHAUSTED" in str(error) else str(error)[:200]
    rows.add("too many lanes are refused", "disc", said)
    rows.add("lanes that changed after that", "1000 discs", int(jnp.sum(jnp.any(run(x)[0] != good[0], axis=1))), 0, least=False)


def check_without(rows: Rows, quick: bool) -> None:
    """What needs no GPU."""
    if reason := host.reason_against() or nvidia.reason_against_text():
        rows.add("text for GPUs is made", "", reason)
        return
    sys.path.insert(0, str(Path(__file__).parent.parent / "tests"))
    for of, kinds in {"disc": DISCS, "bicycle": BICYCLES}.items():
        for name in ("values", "gradient") if quick and of == "disc" else () if quick else kinds:
            rows.tried(f"on the CPU, {name}", of, lambda of=of, name=name, f=kinds[name]: _check_twin(rows, of, name, f))


def _check_twin(rows: Rows, of: str, name: str, f: Callable) -> None:
    import gpu_twin

    run = lambda: [np.asarray(x) for x in jax.tree.leaves(jax.jit(jax.vmap(f))(jnp.linspace(*SPREAD[of], 7)))]  # noqa: E731
    expected = run()
    with gpu_twin.by_twins("at once", 9) as texts:
        found = run()
    rows.add(
        f"arrays that differ, threads of a GPU on the CPU, {name}",
        f"7 lanes of a {of}",
        sum(not np.array_equal(*x) for x in zip(found, expected, strict=True)),
        0,
        least=False,
    )
    text = max(texts, key=len)
    for architecture in ARCHITECTURES:
        ptx = nvidia.text_for(text, architecture)
        rows.add(f"undefined functions for {architecture}, {name}", of, len(re.findall(r"^\.extern", ptx, re.M)), 0, least=False)
        if architecture == "sm_90" and (ptxas := _ptxas()):
            _check_ptxas(rows, of, name, ptx, ptxas)


def _ptxas() -> str | None:
    """Of the wheel `nvidia-cuda-nvcc`, or of a toolkit."""
    found = [str(file) for folder in sys.path for file in Path(folder).glob("nvidia/*/bin/ptxas")]
    return found[0] if found else shutil.which("ptxas")


def _check_ptxas(rows: Rows, of: str, name: str, ptx: str, ptxas: str) -> None:
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "kernel.ptx"
        file.write_text(ptx)
        said = subprocess.run([ptxas, "-arch=sm_90", "-v", str(file), "-o", str(file.with_suffix(".cubin"))], capture_output=True, text=True, check=True).stderr
    for what, pattern in {
        "registers": r"Used (\d+) registers",
        "bytes of stack": r"(\d+) bytes stack frame",
        "bytes spilled": r"(\d+) bytes spill stores",
    }.items():
        rows.add(f"{what} for sm_90, {name}", of, max(map(int, re.findall(pattern, said)), default=0))


def check_with(rows: Rows, quick: bool) -> None:
    """What needs a GPU."""
    rows.add("device", f"jax {jax.__version__}", str(jax.devices()[0].device_kind))
    kinds = {"disc": DISCS, "bicycle": BICYCLES}
    for of, few in (("disc", 10_000), ("bicycle", 2_000)):
        for name in ("values", "tangent", "gradient"):
            if of == "disc" or name == "values" or not quick:
                rows.tried("bits", of, lambda of=of, name=name, few=few: check_bits(rows, of, name, kinds[of][name], few))
    rows.tried("time", "one disc", lambda: check_alone(rows, "disc", "values", DISCS["values"], -4.0, 1.0, 3.0))
    rows.tried("time", "one disc", lambda: check_alone(rows, "disc", "gradient", DISCS["gradient"], -4.0, 3.0, None))
    for lanes in (10**6, 10**7):
        rows.tried("speed", "disc", lambda lanes=lanes: check_speed(rows, "disc", "values", DISCS["values"], lanes))
    for name in list(DISCS)[1:]:
        rows.tried("speed", "disc", lambda name=name: check_speed(rows, "disc", name, DISCS[name], 10**6))
    rows.tried("failures", "disc", lambda: check_failures(rows))
    rows.tried("speed", "bicycle", lambda: check_speed(rows, "bicycle", "values", BICYCLES["values"], 10**5))
    rows.tried("speed", "bicycle", lambda: check_speed(rows, "bicycle", "tangent", BICYCLES["tangent"], 10**5))
    rows.tried("speed", "bicycle", lambda: check_speed(rows, "bicycle", "gradient", BICYCLES["gradient"], 10**5 if not quick else 20_000))
    rows.tried("time", "one bicycle", lambda: check_alone(rows, "bicycle", "values", BICYCLES["values"], 0.3, None, 8.0))


def main() -> None:
    """Run, print, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="fewer checks")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures to this file")
    parser.add_argument("--seconds", type=float, help="after which the process ends (default: 240 with --quick, otherwise 600)")
    options = parser.parse_args()
    rows = Rows(options.json, options.seconds or (240 if options.quick else 600))
    reason = ffi.reason_against() if jax.default_backend() == "gpu" else "JAX's default backend is no GPU"
    if reason:
        print(f"no GPU: {reason}")
        check_without(rows, options.quick)
    else:
        check_with(rows, options.quick)
    rows.write()


if __name__ == "__main__":
    main()
