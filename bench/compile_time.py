"""Build and compile time of every model, cold and with a warm compile cache.

    taskset -c 0 python bench/compile_time.py [--quick] [--json FILE] [--only MODEL ...]

Every model is measured in two fresh processes that share one cache, empty at first: of JAX's programs, and of
our machine code, structures and scalar programs. The first process fills it ("cold", writing included), the
second reads it ("warm cache"). Both find the package as bytecode, as it lies on a user's machine: a process
before them writes it, where PYTHONDONTWRITEBYTECODE is set here too. In seconds of processor time, one after
another in each process:

    import      jax, the package and the model, which is made
    structure   probing of rank, privileged velocities and kinds of rows
    lowering    the scalar program, or why there is none
    start       the first consistent start, of the model's example
    first       the first simulation: the example over its own span, 101 times saved
    second      the same again, nothing is compiled
    total       import to first simulation: what one waits for a first result

Writes a list of {"figure", "model", "value", "required", "met"}. `--quick`: three models.
"""

import tempfile
from functools import partial

from figures import figure, fresh, main

from jourdain_jax.models import MODELS

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
lap("lowering", lower)
start = lap("start", lambda: jj.start(scene, **scene.example))
run = lambda: jj.simulate(scene, start, ts=jnp.linspace(0.0, scene.example_span, 101))
lap("first", run)
motion = lap("second", run)
motion.raise_if_failed()
print(json.dumps(laps | {"total": sum(laps.values()) - laps["second"]}))
"""


def times(name, quick):
    """Those of a model, cold and with a warm cache."""
    with tempfile.TemporaryDirectory() as cache:
        caching = {
            "COMPILATION_CACHE_DIR": cache,
            "PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
            "PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES": "-1",
        }
        environment = {f"JAX_{key}": value for key, value in caching.items()} | {
            "PYTHONDONTWRITEBYTECODE": ""
        }
        for what in ("cold", "with a warm compile cache"):
            for lap, seconds in fresh(PROBE, name, **environment).items():
                yield figure(f"{lap}, {what}, s", name, seconds)


if __name__ == "__main__":
    fresh("import jourdain_jax; print(0)", PYTHONDONTWRITEBYTECODE="")
    main(__doc__, {name: partial(times, name) for name in MODELS}, quick=QUICK)
