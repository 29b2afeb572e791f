"""Build and compile time of every model, cold and with a warm compile cache.

    python bench/compile_time.py [MODEL ...] [--out bench/results/compile_time.json]

Every model is measured in two fresh processes that share one compile cache: the first fills it ("cold"), the second reads it ("warm
cache"). Columns, in seconds: `structure` probes rank and privileged velocities, `start` finds a consistent start, `simulate` is the first
simulation of the model's example over 1 s, `again` the second one (nothing is compiled). Importing the package is not counted.
"""

import argparse
import json
import os
import platform
import subprocess
import sys
import tempfile
from pathlib import Path

PROBE = """
import json, sys, time
import jax, jax.numpy as jnp
import jourdain_jax as jj
scene = jj.models.MODELS[sys.argv[1]]()
clock, laps = time.perf_counter, {}
def lap(name, f):
    begin = clock(); result = jax.block_until_ready(f()); laps[name] = clock() - begin
    return result
lap("structure", lambda: jj.structure_of(scene))
start = lap("start", lambda: jj.start(scene, **scene.example))
run = lambda: jj.simulate(scene, start, ts=jnp.linspace(0.0, 1.0, 101)).q_end
lap("simulate", run)
lap("again", run)
print(json.dumps(laps))
"""


def measured(name: str, cache: str) -> dict[str, float]:
    """Times of one model in a fresh process."""
    environment = os.environ | {"JAX_COMPILATION_CACHE_DIR": cache, "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0"}
    done = subprocess.run([sys.executable, "-c", PROBE, name], env=environment, capture_output=True, text=True, check=True)
    return json.loads(done.stdout.splitlines()[-1])


def main() -> None:
    """Measure, print a table, write a file."""
    from jourdain_jax.models import MODELS

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("models", nargs="*", default=list(MODELS), metavar="MODEL")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results" / "compile_time.json")
    options = parser.parse_args()
    results = {}
    print(f"{'model':<28}{'structure':>10}{'start':>8}{'simulate':>10}{'again':>9}{'  | warm cache: structure':>26}{'start':>8}{'simulate':>10}")
    for name in options.models:
        with tempfile.TemporaryDirectory() as cache:
            cold, warm = measured(name, cache), measured(name, cache)
        results[name] = {"cold": cold, "warm_cache": warm}
        columns = [f"{cold['structure']:10.2f}{cold['start']:8.2f}{cold['simulate']:10.2f}{cold['again']:9.4f}"]
        columns.append(f"{warm['structure']:26.2f}{warm['start']:8.2f}{warm['simulate']:10.2f}")
        print(f"{name:<28}{''.join(columns)}", flush=True)
    import jax
    import jaxlib

    about = {"jax": jax.__version__, "jaxlib": jaxlib.__version__, "python": platform.python_version(), "cores": os.cpu_count(), "precision": "float64"}
    options.out.parent.mkdir(parents=True, exist_ok=True)
    options.out.write_text(json.dumps({"about": about, "seconds": results}, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
