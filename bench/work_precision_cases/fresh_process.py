"""What a fresh process costs: peak memory, and the time to a first trajectory stage by stage."""

import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator

import compile_time

_MEMORY = {
    "import numpy": "import numpy",
    "import jax": "import jax; jax.numpy.zeros(1).block_until_ready()",
    "simulate the disc": "import jourdain_jax as jj; jj.simulate(jj.models.TiltingDisc(), ts=[10.0]).q_end.block_until_ready()",
    "10,000 discs by rollout": (
        "import jourdain_jax as jj; from work_precision_cases import batches; from work_precision_cases.problems import PROBLEMS; "
        "p = PROBLEMS['tilting-disc']; batches.by_rollout(p)(batches.starts(p, 10_000))(1e-8)"
    ),
    "gradient of the disc, reverse": (
        "import jax, jourdain_jax as jj; from work_precision_cases import gradients; from work_precision_cases.problems import PROBLEMS; "
        "p = PROBLEMS['tilting-disc']; jax.jit(gradients.ways(p)['reverse mode'])(1e-8, gradients.values(p)).block_until_ready()"
    ),
    "simulate the bicycle": "import jourdain_jax as jj; jj.simulate(jj.models.WhippleBicycle(), ts=[5.0]).q_end.block_until_ready()",
    "the disc by dense autodiff and diffrax": (
        "import jourdain_jax; from work_precision_cases import peer_diffrax; from work_precision_cases.problems import PROBLEMS; "
        "peer_diffrax.by_dense(PROBLEMS['tilting-disc']).run(1e-8)"
    ),
    "the disc by SymPy to C": (
        "import numpy as np; from work_precision_cases import kane, peer_sympy; import types; import scipy.integrate; "
        "scene = types.SimpleNamespace(mass=1.0, radius=0.5, gravity=9.81); e = kane.tilting_disc(scene); "
        "f, _ = peer_sympy.callback(peer_sympy.compiled(peer_sympy.c_source(e)), 8); "
        "scipy.integrate.ode(f).set_integrator('dop853', rtol=1e-8, atol=1e-8, nsteps=10**6)"
        ".set_initial_value(np.array([0, 0, 0, .3, 0, .2, -3., .5]), 0.0).integrate(10.0)"
    ),
    "import mujoco": "import mujoco",
    "import exudyn": "import exudyn",
}
_QUICK = ("import jax",)
# What getrusage says on Linux includes the parent from which the process was forked.
_REPORT = """
import pathlib, resource, sys
status = pathlib.Path("/proc/self/status")
if status.exists():
    print(next(line.split()[1] for line in status.read_text().splitlines() if line.startswith("VmHWM")))
else:
    print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // (1024 if sys.platform == "darwin" else 1))
"""


def memory(quick: bool, say: Callable[[str], None]) -> Iterator[dict]:
    """Peak resident memory of fresh processes, in MB."""
    path = os.pathsep.join(sys.path)
    for what in _QUICK if quick else _MEMORY:
        done = subprocess.run([sys.executable, "-c", _MEMORY[what] + _REPORT], env=os.environ | {"PYTHONPATH": path}, capture_output=True, text=True)
        if done.returncode:
            say(f"  memory, {what}: not measured: {done.stderr.strip().splitlines()[-1]}")
            continue
        megabytes = int(done.stdout.split()[-1]) / 1024
        say(f"  {what:42s} {megabytes:7.0f} MB")
        yield {"memory": what, "peak_rss_mb": megabytes}


def cold(say: Callable[[str], None]) -> Iterator[dict]:
    """Seconds of every stage up to a first trajectory, without and with a warm compile cache; see `compile_time.py`."""
    for model in ("tilting-disc", "chaplygin-sleigh", "whipple-bicycle"):
        with tempfile.TemporaryDirectory() as cache:
            for state in ("cold", "warm cache"):
                laps = compile_time.measured(model, cache)["laps"]
                say(f"  {model}, {state}: " + ", ".join(f"{name} {seconds:.3g} s" for name, seconds in laps.items()))
                yield {"cold": model, "cache": state, "seconds": laps}
