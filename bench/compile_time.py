"""Build and compile time of every model, cold and with a warm compile cache.

    taskset -c 0 python bench/compile_time.py [MODEL ...] [--quick] [--json FILE]

Every model is measured in two fresh processes that share one cache, empty at first: of JAX's programs, and of our machine code, structures and scalar
programs. The first process fills it ("cold", writing included), the second reads it ("warm cache"). Both find the package as bytecode, as it lies on a
user's machine: a process before them writes it, where PYTHONDONTWRITEBYTECODE is set here too. In seconds of processor time, one after another in each process:

    import      jax, the package and the model, which is made
    structure   probing of rank, privileged velocities and kinds of rows
    lowering    the scalar program, or why there is none
    start       the first consistent start, of the model's example
    first       the first simulation: the example over its own span, 101 times saved
    second      the same again, nothing is compiled
    total       import to first simulation: what one waits for a first result

`--json` writes {"about": ..., "seconds": [{"model", "lowered", "cold": {...}, "warm_cache": {...}}]}. `--quick`: three models.
"""

import argparse
import json
import os
import platform
import subprocess
import sys
import tempfile
from pathlib import Path

LAPS = ("import", "structure", "lowering", "start", "first", "second")
QUICK = ("skate", "tilting-disc", "whipple-bicycle")
PROBE = """
import time
clock, laps = time.process_time, {}
begin = clock()
import json, sys
import jax, jax.numpy as jnp
import jourdain_jax as jj
scene = jj.models.MODELS[sys.argv[1]]()
laps["import"] = clock() - begin

def lap(name, f):
    begin = clock()
    result = f()
    jax.block_until_ready(result)
    laps[name] = clock() - begin
    return result

def lower():
    try:
        return jj.lower(scene) is not None
    except jj.NotLowered:
        return False

lap("structure", lambda: jj.structure_of(scene) and None)
lowered = lap("lowering", lower)
start = lap("start", lambda: jj.start(scene, **scene.example))
run = lambda: jj.simulate(scene, start, ts=jnp.linspace(0.0, scene.example_span, 101))
lap("first", run)
motion = lap("second", run)
motion.raise_if_failed()
print(json.dumps({"lowered": bool(lowered), "laps": laps}))
"""


def measured(name: str, cache: str) -> dict:
    """Times of one model in a fresh process."""
    environment = os.environ | {
        "JAX_COMPILATION_CACHE_DIR": cache,
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
        "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES": "-1",
    }
    environment.pop("PYTHONDONTWRITEBYTECODE", None)
    done = subprocess.run([sys.executable, "-c", PROBE, name], env=environment, capture_output=True, text=True)
    if done.returncode != 0:
        raise RuntimeError(f"measuring `{name}` failed: {done.stderr.strip().splitlines()[-1] if done.stderr.strip() else done.returncode}")
    found = json.loads(done.stdout.splitlines()[-1])
    found["laps"]["total"] = sum(found["laps"][lap] for lap in LAPS[:-1])
    return found


def row(name: str, laps: dict[str, float]) -> str:
    """One line of the table."""
    return f"{name:<40}" + "".join(f"{laps[lap]:>11.4f}" if lap == "second" else f"{laps[lap]:>11.2f}" for lap in (*LAPS, "total"))


def main() -> int:
    """Measure, print a table, write a file; 1 where a model failed."""
    import jax
    import jaxlib

    from jourdain_jax.models import MODELS

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("models", nargs="*", metavar="MODEL", help="names as in `jourdain-jax models` (default: all)")
    parser.add_argument("--quick", action="store_true", help=f"only {', '.join(QUICK)}")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures to this file")
    options = parser.parse_args()
    unknown = [name for name in options.models if name not in MODELS]
    if unknown:
        parser.error(f"no model `{unknown[0]}`; valid names: {', '.join(MODELS)}")
    results, failures = [], 0
    writes = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
    subprocess.run([sys.executable, "-c", "import jourdain_jax"], env=writes, check=True)
    print(f"{'seconds':<40}" + "".join(f"{lap:>11}" for lap in (*LAPS, "total")))
    for name in options.models or (QUICK if options.quick else MODELS):
        try:
            with tempfile.TemporaryDirectory() as cache:
                cold, warm = measured(name, cache), measured(name, cache)
        except RuntimeError as error:
            failures += 1
            print(error, file=sys.stderr, flush=True)
            continue
        results.append({"model": name, "lowered": cold["lowered"], "cold": cold["laps"], "warm_cache": warm["laps"]})
        print(row(name + ("" if cold["lowered"] else " (dense)"), cold["laps"]))
        print(row("  with a warm compile cache", warm["laps"]), flush=True)
    if options.json:
        about = {"jax": jax.__version__, "jaxlib": jaxlib.__version__, "python": platform.python_version(), "cores": os.cpu_count(), "precision": "float64"}
        options.json.write_text(json.dumps({"about": about, "seconds": results}, indent=1) + "\n", encoding="utf-8")
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main())
